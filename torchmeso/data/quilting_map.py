"""The quilting map: a large texture as a picture of places in a small one.

kawasaki2005quilting, section 3.2: Q(r) tells for a texel r of the synthesised texture which texel of the exemplar
stands there, "a kind of index image" with the exemplar as its palette. One map serves everything that lies over the
exemplar's texels: BTF, MDF, colours.

Texture coordinates stay those of the exemplar: 1 is a side of it, and the quilted texture repeats after `periods` of
them. So depths, texture scales and the tiles of an object mean what they meant before; only the repetition is gone.
The way from texture coordinates through a map to texels is `data.address`, whatever the size of the table behind it.

A file (.quilt) holds one number per texel in two or four bytes.

Test: tests/data/test_quilting_map.py
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Int, Shaped
from torch import Tensor

from torchmeso.data import store
from torchmeso.errors import ShapeError, check_shape

MOST = 1 << 15
"""Rows and columns of an exemplar: kernels keep both numbers in 32 bits."""

SMALL = 1 << 15
"""Texels of an exemplar whose numbers are kept in two bytes."""


@dataclass(frozen=True, eq=False, kw_only=True)
class QuiltingMap:
    """Places in an exemplar.

    Attributes:
        index: (H, W) int32 texel of the exemplar, row * width + column; row 0 at the top.
        source: height and width of the exemplar.
        tileable: whether the texture continues over its own border.
    """

    index: Int[Tensor, "H W"]
    source: tuple[int, int]
    tileable: bool = False

    def __post_init__(self) -> None:
        """Raise ShapeError unless every texel lies in the exemplar."""
        check_shape("quilting.index", self.index, (-1, -1))
        height, width = self.source
        if self.index.dtype != torch.int32:
            raise ShapeError(f"quilting.index: expected int32, got {self.index.dtype}")
        if min(*self.index.shape, height, width) < 1 or max(height, width) > MOST:
            raise ShapeError(
                f"quilting: expected at least one texel from an exemplar of at most {MOST} rows and columns, got "
                f"{self.index.shape[1]} x {self.index.shape[0]} from {width} x {height}"
            )
        low, high = (int(x) for x in self.index.aminmax())
        if low < 0 or high >= height * width:
            raise ShapeError(
                f"quilting.index: expected texels from 0 to {height * width - 1}, got {low if low < 0 else high}"
            )

    @property
    def texels(self) -> tuple[int, int]:
        """Height and width of the quilted texture."""
        return self.index.shape[0], self.index.shape[1]

    @property
    def periods(self) -> tuple[float, float]:
        """Sides of the exemplar after which the quilted texture repeats, along u and v."""
        return self.texels[1] / self.source[1], self.texels[0] / self.source[0]

    def apply(self, x: Shaped[Tensor, "*batch"], rows: int = 0) -> Shaped[Tensor, "*batch2"]:
        """Return a table over the exemplar's texels as one over the quilted texture's: (..., H, W, ...).

        Args:
            x: (..., height, width, ...).
            rows: dimension of its height; its width follows.

        Raises:
            ShapeError: the table has other texels than the exemplar.
        """
        if tuple(x.shape[rows : rows + 2]) != self.source:
            found = " x ".join(map(str, reversed(x.shape[rows : rows + 2])))
            raise ShapeError(f"table: expected the exemplar's {self.source[1]} x {self.source[0]} texels, got {found}")
        flat = x.flatten(rows, rows + 1)
        return flat.index_select(rows, self.index.flatten().long()).unflatten(rows, self.texels)

    def seams(self) -> tuple[Bool[Tensor, "H W"], Bool[Tensor, "H W"]]:
        """Return where the texel to the right, and the one below, is not the exemplar's neighbour; borders wrap."""
        height, width = self.source
        row, column = self.index // width, self.index % width
        right = (row.roll(-1, 1) != row) | (column.roll(-1, 1) != (column + 1) % width)
        below = (row.roll(-1, 0) != (row + 1) % height) | (column.roll(-1, 0) != column)
        if not self.tileable:
            right[:, -1] = below[-1] = False  # no neighbours
        return right, below


def save(quilting: QuiltingMap, path: str | Path, **meta: object) -> None:
    """Write a quilting map (.quilt), with what `meta` says about how it was made.

    Raises:
        StorageError: the disk is full, or the place cannot be written to.
    """
    height, width = quilting.source
    index = quilting.index.to(torch.int16) if height * width <= SMALL else quilting.index
    about = {"source": list(quilting.source), "tileable": quilting.tileable, **meta}
    store.write_model(path, {"quilting.index": index}, {"kind": "quilting", "quilting": about})


def load(path: str | Path) -> QuiltingMap:
    """Return the quilting map in a file.

    Raises:
        FormatError: the file is missing, damaged, or holds no quilting map.
    """
    model = open_file(path)
    about = model.meta["quilting"]
    with store.reading(path):
        height, width = about["source"]
        return QuiltingMap(
            index=model.read("quilting.index").int(), source=(height, width), tileable=bool(about["tileable"])
        )


def open_file(path: str | Path) -> store.Model:
    """Return the file of a quilting map, nothing of it read but what it says about itself.

    Raises:
        FormatError: the file is missing, damaged, or holds no quilting map.
    """
    return store.open_kind(path, "quilting", expected="a quilting map (.quilt)", make="torchmeso synthesize")


def describe(path: str | Path) -> dict[str, Any]:
    """Return facts about the quilting map in a file, by name.

    Raises:
        FormatError: as `load`.
    """
    found, about = load(path), open_file(path).meta["quilting"]
    right, below = found.seams()
    used = len(found.index.unique()) / (found.source[0] * found.source[1])
    made = {name: value for name, value in about.items() if name not in ("source", "tileable")}
    return {
        "kind": "quilting map",
        "texels": f"{found.texels[1]} x {found.texels[0]}",
        "exemplar": f"{found.source[1]} x {found.source[0]} texels, {used:.1%} of them used",
        "tiles": "yes" if found.tileable else "no",
        "neighbours across seams": f"{float(torch.stack([right, below]).float().mean()):.2%}",
        **made,
    }
