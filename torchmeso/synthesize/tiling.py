"""Tilings of the plane by Wang tiles: in scanlines, or by a hash of the cell.

leung2007tileable, section 4.1, after cohen2003wang: row by row, each cell takes at random one of the tiles that match
those to the north and the west (`scanlines`).

Where each side's colour, or each corner's, is a hash of its place, any cell is found without its neighbours
(`cells`): nothing is stored, whatever the size of the plane. That takes a set with a tile for every combination. The
hash is one of 32 bits, the same in every language.

Test: tests/synthesize/test_tiling.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from torchmeso.data.tile_set import TileSet
from torchmeso.errors import ConfigError, check_range

MOST_CELLS = 1 << 22
"""Of a tiling that is kept."""

WORD = 0xFFFFFFFF


def scanlines(tiles: TileSet, rows: int, columns: int, *, rng: torch.Generator) -> Int[Tensor, "rows columns"]:
    """Return a tiling, each tile drawn among those that match the ones to the north and the west.

    Raises:
        ConfigError: the size is out of range, or nothing matches.
    """
    check_range("tiling.rows", rows, 1, MOST_CELLS)
    check_range("tiling.columns", columns, 1, MOST_CELLS // rows)
    colours = tiles.colours.tolist()
    # What a neighbour to the north, or to the west, asks for: (place among one's own colours, among its).
    north, west = (((0, 3), (1, 2)), ((0, 1), (3, 2))) if tiles.marks == "corners" else (((0, 2),), ((3, 1),))
    matching: dict[tuple, list[int]] = {}
    found: list[list[int]] = []
    for row in range(rows):
        found.append([])
        for column in range(columns):
            wanted: dict[int, int] = {}
            if row:
                wanted |= {own: colours[found[row - 1][column]][other] for own, other in north}
            if column:
                wanted |= {own: colours[found[row][column - 1]][other] for own, other in west}
            key = tuple(sorted(wanted.items()))
            if key not in matching:
                matching[key] = [k for k, own in enumerate(colours) if all(own[at] == c for at, c in key)]
            choice = matching[key]
            if not choice:
                raise ConfigError(f"tiling: expected a tile that matches its neighbours, got none of colours {wanted}")
            found[row].append(choice[int(torch.randint(len(choice), (1,), generator=rng))])
    return torch.tensor(found)


class Alphabet(NamedTuple):
    """Colours that hashes are taken of.

    Attributes:
        across: of sides on which tiles meet one above the other, or of corners.
        down: of those on which they meet side by side.
    """

    across: list[int]
    down: list[int]


def alphabet(tiles: TileSet) -> Alphabet:
    """Return colours of which the set has every combination.

    A set for any topology has two of its four colours on two of the sides: in the plane, one class lies across and the
    other down.

    Raises:
        ConfigError: the set lacks a combination.
    """
    across, down = (tiles.colours[:, k].unique().tolist() for k in (0, 1))
    if tiles.marks == "corners":
        return _complete(tiles, Alphabet(across, across))
    if across == down == [0, 1, 2, 3] and len(tiles.colours) < 4**4:
        across, down = across[:2], down[2:]
    return _complete(tiles, Alphabet(across, down))


def _complete(tiles: TileSet, found: Alphabet) -> Alphabet:
    across, down = torch.tensor(found.across), torch.tensor(found.down)
    tiles.find(torch.cartesian_prod(across, down, across, down))
    return found


def cells(
    tiles: TileSet,
    row: Int[Tensor, "*batch"],
    column: Int[Tensor, "*batch"],
    *,
    seed: int = 0,
    period: tuple[int, int] | None = None,
) -> Int[Tensor, "*batch"]:
    """Return the tiles of cells of the plane, each by itself.

    Args:
        tiles: a set with every combination of colours.
        row: any whole numbers; rows go down.
        column: the same shape.
        seed: of the hash.
        period: rows and columns after which the tiling repeats; None = never.

    Raises:
        ConfigError: the set lacks a combination.
    """
    colours = alphabet(tiles)

    def colour(down: int, right: int, which: int) -> Tensor:
        y, x = row + down, column + right
        if period is not None:
            y, x = y % period[0], x % period[1]
        letters = torch.tensor(colours.down if which else colours.across)
        return letters[hashed(y, x, which, seed) * len(letters) >> 32]

    if tiles.marks == "corners":
        found = [colour(0, 0, 0), colour(0, 1, 0), colour(1, 1, 0), colour(1, 0, 0)]
    else:  # a cell's north and west are its own
        found = [colour(0, 0, 0), colour(0, 1, 1), colour(1, 0, 0), colour(0, 0, 1)]
    return tiles.find(torch.stack(found, -1))


def hashed(row: Int[Tensor, "*batch"], column: Int[Tensor, "*batch"], which: int, seed: int) -> Int[Tensor, "*batch"]:
    """Return 32 bits that look like chance, of a place, a kind of side, and a seed."""
    h = _mixed(torch.full_like(row, seed & WORD) ^ (0x9E3779B9 * (which + 1) & WORD))
    h = _mixed(h ^ (row & WORD))
    return _mixed(h ^ (column & WORD))


def _mixed(h: Int[Tensor, "*batch"]) -> Int[Tensor, "*batch"]:
    """Return each word mixed so that every bit of it changes half of the result's (MurmurHash3's last steps)."""
    h = (h ^ h >> 16) * 0x85EBCA6B & WORD
    h = (h ^ h >> 13) * 0xC2B2AE35 & WORD
    return h ^ h >> 16


def plane(
    tiles: TileSet, rows: int, columns: int, *, seed: int = 0, repeats: bool = True
) -> Int[Tensor, "rows columns"]:
    """Return the cells of a rectangle by hash; one that `repeats` goes on over its border.

    Raises:
        ConfigError: the size is out of range, or the set lacks a combination.
    """
    check_range("tiling.rows", rows, 1, MOST_CELLS)
    check_range("tiling.columns", columns, 1, MOST_CELLS // rows)
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    return cells(tiles, row, column, seed=seed, period=(rows, columns) if repeats else None)
