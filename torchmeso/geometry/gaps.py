"""What a measured set of directions lacks: the rings it was meant to have, and weights that fill its gaps.

Measured sets name their directions by angles in degrees. `meant` finds the rings behind them, `locate` the place of
each, and `filling` weighs those present for each one missing (`geometry.kriging`), also over whole missing rings.

Test: tests/geometry/test_gaps.py
"""

import math
from collections.abc import Collection, Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso.errors import FormatError
from torchmeso.geometry import hemisphere, kriging, rings
from torchmeso.geometry.hemisphere import DirectionSet

Angles = tuple[float, float]
"""theta and phi in degrees."""

TOLERANCE_DEG = 0.75
"""Names round both angles to whole degrees: up to 0.71 degrees between directions."""

MOST = 4096
"""Directions of a set that is told from angles: rigs take some hundred, damaged names could mean millions."""

SMALL = 1e-3
"""Weights below it are dropped: a picture that counts for less than a code need not be read."""


def meant(angles: Collection[Angles], name: str) -> DirectionSet:
    """Return the rings that `angles` (degrees) are part of.

    One direction is itself. Directions of `ubo81` are meant to be all of it. Others are rings whose step is the
    smallest one between two neighbours.

    Args:
        angles: distinct directions, at least one.
        name: of the set, for errors.

    Raises:
        FormatError: a ring has no even steps, or an angle is out of range.
    """
    wrong = [pair for pair in angles if not (0 <= pair[0] <= 89.9 and math.isfinite(pair[1]))]
    if wrong:
        raise FormatError(
            f"{name}: expected polar angles from 0 to 89.9 degrees and azimuths that are numbers, "
            f"got theta {wrong[0][0]:g}, phi {wrong[0][1]:g}"
        )
    if len(angles) == 1:
        ((theta, phi),) = angles
        return hemisphere.from_rings((theta,), (1,), (phi,))
    if not any(place is None for place in locate(hemisphere.ubo81(), angles)):
        return hemisphere.ubo81()
    thetas = sorted({theta for theta, _ in angles})
    found = [_ring(sorted(phi for t, phi in angles if t == theta), theta, name) for theta in thetas]
    if sum(count for count, _ in found) > MOST:
        raise FormatError(f"{name}: expected at most {MOST} directions on rings, got steps of a fraction of a degree")
    return hemisphere.from_rings(thetas, *zip(*found, strict=True))


def _ring(phis: Sequence[float], theta: float, name: str) -> tuple[int, float]:
    """Return how many directions the ring has, and the first one's azimuth."""
    if len(phis) == 1:
        return 1, phis[0]
    step = min((b - a) % 360 for a, b in zip(phis, [*phis[1:], phis[0]], strict=True))
    count = round(360 / step)
    first = rings.first_azimuth(torch.tensor(phis, dtype=torch.float64), count)
    steps = [(phi - first) * count / 360 for phi in phis]
    if max(abs(x - round(x)) * 360 / count for x in steps) > TOLERANCE_DEG:
        raise FormatError(
            f"{name}: expected even steps in azimuth at theta {theta:g}, got {', '.join(f'{p:g}' for p in phis[:6])}; "
            "only directions on rings can be read"
        )
    return count, first


def locate(directions: DirectionSet, angles: Collection[Angles]) -> list[int | None]:
    """Return the index of each of `angles` (degrees) in the set, None where it has none there."""
    if not angles:
        return []
    places, off = rings.nearest(directions, torch.tensor(list(angles), dtype=torch.float64))
    return [p if away <= TOLERANCE_DEG else None for p, away in zip(places.tolist(), off.tolist(), strict=True)]


def turned(angles: Angles) -> Angles:
    """Return the same direction with phi in [0, 360), and 0 at the pole."""
    theta, phi = angles
    return theta, phi % 360 if theta else 0.0


def angles_deg(directions: DirectionSet) -> list[Angles]:
    """Return theta and phi in degrees of all directions, in order."""
    return [
        (theta, phi0 + 360 * j / count)
        for theta, count, phi0 in zip(directions.theta_deg, directions.count, directions.phi0_deg, strict=True)
        for j in range(count)
    ]


def filling(directions: DirectionSet, present: Bool[Tensor, "direction"]) -> Float[Tensor, "direction direction"]:
    """Return float64 weights W with value_i = sum_j W_ij value_j: over those present, 1 at i = j where i is present.

    Rows sum to 1; columns of missing directions are 0. At least one direction must be present.
    """
    n = len(directions)
    weights = torch.eye(n, dtype=torch.float64) * present
    missing = ~present
    if bool(missing.any()):
        w = directions.directions(torch.float64)
        filled = kriging.weights(w[present], w[missing])
        filled = torch.where(filled.abs() < SMALL, 0, filled)
        rows = torch.zeros(len(filled), n, dtype=torch.float64)
        rows[:, present] = filled / filled.sum(1, keepdim=True)
        weights[missing] = rows
    return weights
