"""The part of a textile that becomes a tile, and the copies of every yarn in it.

The tile is the smallest box along x and y that all yarns repeat by (the file's domain where that is a multiple of it),
taken n x m times so that its sides are alike. Where no n, m up to 8 make them equal, they may differ by
`MOST_ANISOTROPY`. Yarns whose own repeats do not tell a side repeat by the tile.

Test: tests/meso/test_textile_period.py
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data.textile import Textile, Yarn
from torchmeso.errors import GeometryError

MOST_REPEATS = 32
"""How many of a yarn's own repeats are looked through for the period of the tile."""

MOST_PERIODS = 8
"""How many periods along a side of the tile make it square."""

MOST_ANISOTROPY = 1.05


class Tile(NamedTuple):
    """What part of a textile is the tile.

    Attributes:
        low: (2,) its corner, in the textile's units.
        sides: (2,) along x and y.
        anisotropy: longer over shorter side.
    """

    low: Float[Tensor, "2"]
    sides: Float[Tensor, "2"]
    anisotropy: float

    @property
    def unit(self) -> Float[Tensor, "3"]:
        """What becomes 1 along x, y and z."""
        return torch.cat([self.sides, self.sides.prod().sqrt()[None]])


def tile_of(textile: Textile) -> Tile:
    """Return the part of the x-y plane that becomes the tile.

    Raises:
        GeometryError: yarns share no period, nothing repeats and there is no domain, or the sides are too unlike.
    """
    box = textile.domain
    sides = torch.zeros(2, dtype=torch.float64)
    for axis in (0, 1):
        periods = [p for p in (_period(y, axis) for y in textile.yarns) if p is not None]
        shown = None if box is None else float(box[1, axis] - box[0, axis])
        if not periods and shown is None:
            raise GeometryError("textile: expected yarns that repeat, or a domain, to tell the tile's sides")
        side = _common(periods) if periods else shown
        if side is None:
            raise GeometryError(f"textile: expected yarns with a common period along {'xy'[axis]}, got {periods[:4]}")
        sides[axis] = shown if shown is not None and _is_multiple(shown, side) else side
    n, m = _square(float(sides[0]), float(sides[1]))
    sides = sides * sides.new_tensor([n, m])
    low = sides.new_zeros(2) if box is None else box[0].double()
    return Tile(low, sides, float(sides.max() / sides.min()))


def copies(yarn: Yarn, tile: Tile) -> list[Float[Tensor, "3"]]:
    """Return the shifts (tile units, in [0, 1)) of all copies of a yarn that the tile holds.

    Raises:
        GeometryError: the repeats do not fill the tile evenly, or the yarn lies in its own copies.
    """
    basis = _lattice(yarn, tile)
    count = float(tile.sides.prod() / torch.linalg.det(basis).abs())
    found = _translations(basis)
    place = found / tile.sides
    place = (place + 1e-6) % 1 - 1e-6
    steps = (place * 1e5).round().long() % 100000
    _, first = torch.unique(steps[:, 0] * 100000 + steps[:, 1], return_inverse=True)
    if not count < MOST_REPEATS**2 / 4 or int(first.max()) + 1 != round(count) or abs(count - round(count)) > 1e-3:
        raise GeometryError(
            f"textile: expected yarns whose repeats fill the tile evenly, got {count:.4g} copies of one; "
            "its repeats are no period of the others or of the domain"
        )
    which = torch.stack([(first == k).nonzero()[0, 0] for k in range(round(count))])
    return [_flat(shift) for shift in (found[which] / tile.sides) % 1]


def goes_on(yarn: Yarn, tile: Tile) -> bool:
    """Return whether a yarn ends where a copy of it begins.

    Raises:
        GeometryError: it goes on for several of its repeats, so that it lies in its own copies.
    """
    inverse = torch.linalg.inv(_lattice(yarn, tile))
    steps = yarn.way[:2].double() @ inverse
    whole = bool((steps - steps.round()).abs().max() < 1e-5) and abs(float(yarn.way[2])) < 1e-5 * float(
        tile.sides.min()
    )
    times = math.gcd(*(int(s) for s in steps.round().tolist()))
    if whole and times > 1:
        raise GeometryError(
            f"textile: expected yarns over one of their repeats, got one over {times}: it would lie in its own copies"
        )
    return whole


def _period(yarn: Yarn, axis: int) -> float | None:
    """Return the least translation along an axis under which a yarn repeats; None where its repeats do not tell."""
    flat = _repeats(yarn)
    if len(flat) < 2:
        return float(flat[0, axis].abs()) if len(flat) and float(flat[0, 1 - axis].abs()) == 0 else None
    found = _translations(flat)
    straight = found[found[:, 1 - axis].abs() < 1e-6 * flat.abs().max()][:, axis]
    straight = straight[straight > 1e-6 * flat.abs().max()]
    return float(straight.min()) if len(straight) else None


def _repeats(yarn: Yarn) -> Float[Tensor, "n 2"]:
    """Return what a yarn repeats by in the plane: layers above each other are left out.

    Raises:
        GeometryError: repeats lead out of the plane, or are more than two or along each other.
    """
    repeats = yarn.repeats.double()
    size = float(repeats.abs().max()) if len(repeats) else 1.0
    flat = repeats[repeats[:, :2].abs().amax(1) > 1e-9 * size] if len(repeats) else repeats
    slanted = bool((flat[:, 2].abs() > 1e-6 * size).any())
    along = len(flat) == 2 and float(torch.linalg.det(flat[:, :2]).abs()) < 1e-9 * size**2
    if len(flat) > 2 or slanted or along:
        raise GeometryError(
            f"textile: expected at most two repeats of a yarn, across each other and level, got {repeats.tolist()[:4]}"
        )
    return flat[:, :2]


def _lattice(yarn: Yarn, tile: Tile) -> Float[Tensor, "2 2"]:
    """Return two translations that make all copies of a yarn; the tile's sides stand in for missing repeats."""
    flat, sides = _repeats(yarn), torch.diag(tile.sides)
    if len(flat) == 1:
        return torch.cat([flat, sides[flat.abs().argmin(1)]])
    return flat if len(flat) else sides


def _translations(basis: Float[Tensor, "2 2"]) -> Float[Tensor, "n 2"]:
    """Return the sums of up to `MOST_REPEATS` of two translations either way, the shortest first."""
    n = torch.arange(-MOST_REPEATS, MOST_REPEATS + 1, dtype=torch.float64)
    steps = torch.cartesian_prod(n, n)
    return steps[steps.abs().sum(1).argsort(stable=True)] @ basis


def _common(periods: list[float]) -> float | None:
    """Return the least length that all periods divide; None where it is over `MOST_REPEATS` of the longest."""
    longest = max(periods)
    for n in range(1, MOST_REPEATS + 1):
        if all(_is_multiple(n * longest, p) for p in periods):
            return n * longest
    return None


def _is_multiple(length: float, period: float) -> bool:
    times = length / period
    return 0.5 < times < 1e9 and abs(times - round(times)) < 1e-5 * times


def _square(x: float, y: float) -> tuple[int, int]:
    """Return how many periods along x and y make a tile that is square, or nearly.

    Raises:
        GeometryError: none do.
    """
    counts = [(n, m) for n in range(1, MOST_PERIODS + 1) for m in range(1, MOST_PERIODS + 1)]
    for allowed in (1 + 1e-6, 1 + 1e-3, 1.01, MOST_ANISOTROPY):
        fit = [(n, m) for n, m in counts if max(n * x, m * y) <= allowed * min(n * x, m * y)]
        if fit:
            return min(fit, key=lambda pair: pair[0] * pair[1])
    raise GeometryError(
        f"textile: expected a period whose sides come to each other within {MOST_PERIODS} repetitions, "
        f"got {x:g} x {y:g}"
    )


def _flat(x: Float[Tensor, "2"]) -> Float[Tensor, "3"]:
    return torch.cat([x, x.new_zeros(1)])
