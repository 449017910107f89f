"""Tiles side by side in one map, so that the surface of an object points into it tile by tile.

Each tile stands once, with a margin all around that shows tiles that go on there: what is read beyond a tile's border
is what lies beyond it on the surface. Across a border the first texels depend on the side's colour alone, so these are
the neighbour's own whichever it is; those further out, read by coarse tables and by rays that walk through a relief,
are of some tile that could lie there. So the address of quilted textures and its filters serve tiled surfaces as they
are (leung2007tileable, section 5.3, looks tiles up in an array of indices likewise).

Texture coordinates are those of the exemplar: 1 is a side of it (see `data.quilting_map`).

Test: tests/data/test_tile_atlas.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.data.tile_set import TileSet

MARGIN = 4
"""A margin is a side over this many."""

AROUND = tuple((down, right) for down in (-1, 0, 1) for right in (-1, 0, 1))


class TileAtlas(NamedTuple):
    """A map of all tiles.

    Attributes:
        map: rows of tiles from the top, each with its margin.
        side: texels along a side of a tile.
        margin: texels around it.
        columns: tiles in a row.
    """

    map: QuiltingMap
    side: int
    margin: int
    columns: int

    @property
    def scale(self) -> tuple[float, float]:
        """Sides of a tile in sides of the exemplar, along u and v."""
        height, width = self.map.source
        return self.side / width, self.side / height

    def coordinates(self, tile: Int[Tensor, "*batch"], place: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch 2"]:
        """Return texture coordinates.

        Args:
            tile: which.
            place: where in it, east and north from its south-west corner, [0, 1] inside.
        """
        pitch = self.side + 2 * self.margin
        height = self.map.texels[0]
        corner = torch.stack(
            [tile % self.columns * pitch + self.margin, height - tile // self.columns * pitch - pitch + self.margin], -1
        )
        uv = (corner + self.side * place) / torch.tensor([self.map.source[1], self.map.source[0]], dtype=place.dtype)
        # The map repeats: halves around zero keep coordinates small.
        period = torch.tensor(self.map.periods, dtype=place.dtype)
        middle = (corner + self.side / 2) / torch.tensor([self.map.source[1], self.map.source[0]], dtype=place.dtype)
        return uv - torch.where(middle > period / 2, period, 0)


def build(tiles: TileSet) -> TileAtlas:
    """Return the atlas of a set of tiles; the same tiles have the same places in all sets of a kind."""
    side = tiles.side
    margin = max(side // MARGIN, 2)
    columns = max(round(len(tiles.index) ** 0.5), 1)
    rows = -(-len(tiles.index) // columns)
    tile = torch.zeros(rows * columns, 3, 3, dtype=torch.long)
    tile[: len(tiles.index)] = neighbours(tiles)
    along = torch.arange(-margin, side + margin)
    block, inside = (along.div(side, rounding_mode="floor") + 1).clamp(0, 2), along % side
    shown = tiles.shown()[tile[:, block[:, None], block], inside[:, None], inside]
    index = shown.unflatten(0, (rows, columns)).movedim(2, 1).flatten(2).flatten(0, 1)
    return TileAtlas(QuiltingMap(index=index.contiguous(), source=tiles.source, tileable=True), side, margin, columns)


def neighbours(tiles: TileSet) -> Int[Tensor, "T 3 3"]:
    """Return tiles that match each tile and one another, on all sides and beyond corners; itself where none does."""
    colours = tiles.colours
    count = len(colours)
    found = torch.arange(count)[:, None, None].expand(-1, 3, 3).clone()
    # What a tile to the north asks for of the one below: (its own, the other's).
    if tiles.marks == "corners":
        north, west = ((3, 0), (2, 1)), ((1, 0), (2, 3))
    else:
        north, west = ((2, 0),), ((1, 3),)

    def fits(one: Int[Tensor, "T"], pairs: tuple[tuple[int, int], ...]) -> Tensor:
        """Return (T, T) whether each tile could lie beyond tile `one`."""
        return torch.stack([colours[None, :, own] == colours[one, None, other] for own, other in pairs]).all(0)

    # Others before others of others, each beginning the search at another tile: not all margins show the same.
    order = (torch.arange(count)[:, None] + torch.arange(1, count + 1)) % count
    south, east = tuple((b, a) for a, b in north), tuple((b, a) for a, b in west)
    for down, right in sorted(AROUND, key=lambda at: abs(at[0]) + abs(at[1]))[1:]:
        able = torch.ones(count, count, dtype=torch.bool)
        if down:
            able &= fits(found[:, 1, 1 + right], north if down < 0 else south)
        if right:
            able &= fits(found[:, 1 + down, 1], west if right < 0 else east)
        able = able.gather(1, order)
        first = order.gather(1, able.int().argmax(1, keepdim=True))[:, 0]
        found[:, 1 + down, 1 + right] = torch.where(able.any(1), first, torch.arange(count))
    return found
