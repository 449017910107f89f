"""Sets of Wang tiles: squares of texels that go on in one another where the colours of their sides are the same.

leung2007tileable, section 5.3: each texel of the exemplar that some tile shows is kept once, in the BTFel table; tiles
are pictures of numbers in it. One table serves whatever lies over the exemplar's texels: BTF, MDF, colours.

Sides are coloured in the order north, east, south, west, or, in a set of coloured corners (lagae2006alternative), the
corners north-west, north-east, south-east, south-west. Sides on which tiles meet one above the other (north, south)
have colours of their own; so do those on which they meet side by side (east, west).

A file (.tiles) holds the BTFel numbers in two bytes, or four.

Test: tests/data/test_tile_set.py
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Int
from torch import Tensor

from torchmeso.data import store
from torchmeso.data.quilting_map import MOST, SMALL, QuiltingMap
from torchmeso.errors import ConfigError, ShapeError, check_shape

Marks = Literal["edges", "corners"]

MOST_COLOURS = 16
"""Of a side or a corner."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TileSet:
    """Tiles that match.

    Attributes:
        index: (T, w, w) int32 number of a BTFel; row 0 at the top.
        texels: (N,) int32 texel of the exemplar of each BTFel, row * width + column, each once.
        source: height and width of the exemplar.
        colours: (T, 4) int32 of north, east, south, west, or of the corners from north-west clockwise.
        marks: what is coloured.
    """

    index: Int[Tensor, "T w w"]
    texels: Int[Tensor, "N"]
    source: tuple[int, int]
    colours: Int[Tensor, "T 4"]
    marks: Marks = "edges"

    def __post_init__(self) -> None:
        """Raise ShapeError unless tiles, table and colours fit."""
        check_shape("tiles.index", self.index, (-1, -1, -1))
        tiles, height, width = self.index.shape
        check_shape("tiles.colours", self.colours, (tiles, 4))
        check_shape("tiles.texels", self.texels, (-1,))
        if min(tiles, height) < 1 or height != width or max(self.source) > MOST or min(self.source) < 1:
            raise ShapeError(
                f"tiles.index: expected squares of texels from an exemplar of at most {MOST} rows and columns, got "
                f"{tuple(self.index.shape)} from {self.source[1]} x {self.source[0]}"
            )
        for name, x, end in (
            ("index", self.index, len(self.texels)),
            ("texels", self.texels, self.source[0] * self.source[1]),
            ("colours", self.colours, MOST_COLOURS),
        ):
            if x.dtype != torch.int32 or int(x.min()) < 0 or int(x.max()) >= end:
                raise ShapeError(
                    f"tiles.{name}: expected int32 from 0 to {end - 1}, got {x.dtype} from {int(x.min())} to "
                    f"{int(x.max())}"
                )

    @property
    def side(self) -> int:
        """Texels along a side of a tile, w."""
        return self.index.shape[1]

    @property
    def share(self) -> float:
        """Return the share of the exemplar's texels that some tile shows."""
        return len(self.texels) / (self.source[0] * self.source[1])

    def shown(self) -> Int[Tensor, "T w w"]:
        """Return the exemplar's texel at each place of each tile."""
        return self.texels[self.index.long()]

    def find(self, colours: Int[Tensor, "*batch 4"]) -> Int[Tensor, "*batch"]:
        """Return the tile of these colours, int64.

        Raises:
            ConfigError: the set has none.
        """
        code = torch.tensor([MOST_COLOURS**k for k in range(4)])
        table = torch.full((MOST_COLOURS**4,), -1)
        table[(self.colours.long() * code).sum(-1)] = torch.arange(len(self.colours))
        found = table[(colours.long() * code).sum(-1)]
        if bool((found < 0).any()):
            missing = colours[found < 0][0].tolist()
            raise ConfigError(f"tiles: expected a tile of every combination asked for, got none of colours {missing}")
        return found

    def lay(self, tiles: Int[Tensor, "rows columns"], *, tileable: bool = False) -> QuiltingMap:
        """Return the texture that an arrangement of tiles makes, as a map of the exemplar's texels."""
        shown = self.shown()[tiles.long()]
        index = shown.movedim(2, 1).flatten(2).flatten(0, 1)
        return QuiltingMap(index=index.contiguous(), source=self.source, tileable=tileable)


def of_texels(
    shown: Int[Tensor, "T w w"], source: tuple[int, int], colours: Int[Tensor, "T 4"], marks: Marks = "edges"
) -> TileSet:
    """Return a set of tiles whose places show these texels of the exemplar."""
    texels, index = shown.flatten().unique(return_inverse=True)
    return TileSet(
        index=index.reshape(shown.shape).int(), texels=texels.int(), source=source, colours=colours.int(), marks=marks
    )


def save(tiles: TileSet, path: str | Path, **meta: object) -> None:
    """Write a set of tiles (.tiles), with what `meta` says about how it was made.

    Raises:
        StorageError: the disk is full, or the place cannot be written to.
    """
    index = tiles.index.to(torch.int16) if len(tiles.texels) <= SMALL else tiles.index
    tensors = {"tiles.index": index, "tiles.texels": tiles.texels, "tiles.colours": tiles.colours.to(torch.uint8)}
    about = {"source": list(tiles.source), "marks": tiles.marks, **meta}
    store.write_model(path, tensors, {"kind": "tiles", "tiles": about})


def load(path: str | Path) -> TileSet:
    """Return the set of tiles in a file.

    Raises:
        FormatError: the file is missing, damaged, or holds no tiles.
    """
    model = open_file(path)
    about = model.meta["tiles"]
    with store.reading(path):
        height, width = about["source"]
        return TileSet(
            index=model.read("tiles.index").int(),
            texels=model.read("tiles.texels").int(),
            colours=model.read("tiles.colours").int(),
            source=(height, width),
            marks=about["marks"],
        )


def open_file(path: str | Path) -> store.Model:
    """Return the file of a set of tiles, nothing of it read but what it says about itself.

    Raises:
        FormatError: the file is missing, damaged, or holds no tiles.
    """
    make = "torchmeso synthesize --method wang"
    return store.open_kind(path, "tiles", expected="a set of tiles (.tiles)", make=make)


def describe(path: str | Path) -> dict[str, Any]:
    """Return facts about the set of tiles in a file, by name.

    Raises:
        FormatError: as `load`.
    """
    found, about = load(path), open_file(path).meta["tiles"]
    made = {name: value for name, value in about.items() if name not in ("source", "marks", "kind")}
    return {
        "kind": "tiles",
        "tiles": f"{len(found.index)} of {found.side} x {found.side} texels, coloured {found.marks}",
        "exemplar": f"{found.source[1]} x {found.source[0]} texels, {found.share:.2%} of them referenced",
        "set": about.get("kind", found.marks),
        **made,
    }
