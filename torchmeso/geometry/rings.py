"""The rings behind a list of angles: which direction set it is, and where each of its directions stands in it.

Foreign files list directions one by one, in any order. Directions whose polar angles agree form a ring; a ring is
accepted where every direction lies within `TOLERANCE_DEG` of evenly spaced azimuths.

Test: tests/geometry/test_rings.py
"""

import math
from itertools import accumulate
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.errors import FormatError
from torchmeso.geometry import hemisphere
from torchmeso.geometry.directions import from_angles
from torchmeso.geometry.hemisphere import DirectionSet

TOLERANCE_DEG = 0.5
"""Largest angle between a listed direction and its place on the ring: rigs are named in whole or half degrees."""

LOWEST_DEG = 89.9
"""Directions nearer to the horizon are no part of a direction set."""


class Found(NamedTuple):
    """A direction set, and how to bring a table over the list into its order.

    Attributes:
        directions: the set.
        order: (n) long; place in the list of each direction of the set: table[order] is in the set's order.
    """

    directions: DirectionSet
    order: Int[Tensor, "direction"]


def recognise(name: str, angles: Float[Tensor, "direction 2"]) -> Found:
    """Return the rings of a list of directions: `ubo81` or `ubo151` where it is one of these.

    Args:
        name: of the list, for errors.
        angles: (n, 2) theta and phi in radians, in any order, each direction once.

    Raises:
        FormatError: the directions do not form rings of even steps, one is listed twice, or one is at the horizon or
            below it.
    """
    angles = angles.double()
    if not bool(angles.isfinite().all()):
        raise FormatError(f"{name}: expected angles in radians, got one that is no number; the copy may be incomplete")
    theta, phi = angles.rad2deg().unbind(-1)
    # A negative polar angle, or one beyond a quarter turn by much, is damage and no direction of a rig.
    if len(angles) == 0 or float(theta.min()) < 0 or float(theta.max()) > LOWEST_DEG:
        worst = "none" if len(angles) == 0 else f"{float(theta.min()):.4g} to {float(theta.max()):.4g}"
        raise FormatError(f"{name}: expected polar angles from 0 to {LOWEST_DEG} degrees, got {worst}")
    for known in (hemisphere.ubo81(), hemisphere.ubo151()):
        order = _places(known, theta, phi)
        if order is not None:
            return Found(known, order)
    found = _fitted(theta, phi)
    order = _places(found, theta, phi)
    if order is None:
        raise FormatError(
            f"{name}: expected {len(theta)} directions on rings of even steps, got a scattered list; "
            "resample it to rings such as ubo81 or ubo151 with the program that made it"
        )
    return Found(found, order)


def _fitted(theta: Tensor, phi: Tensor) -> DirectionSet:
    """Return rings of neighbouring polar angles, each turned as fits its directions best."""
    by_theta = theta.argsort(stable=True)
    steps = theta[by_theta].diff() > TOLERANCE_DEG
    groups = torch.tensor_split(by_theta, (steps.nonzero()[:, 0] + 1).tolist())
    rings = []
    for group in groups:
        count, mean = len(group), float(theta[group].mean())
        if count == 1 and mean < TOLERANCE_DEG:
            rings.append((0.0, 1, 0.0))
            continue
        rings.append((round(mean, 4), count, first_azimuth(phi[group], count)))
    return hemisphere.from_rings(*zip(*rings, strict=True))


def first_azimuth(phi_deg: Float[Tensor, "direction"], count: int) -> float:
    """Return the azimuth, in degrees, of the first of `count` even steps that fit the azimuths best.

    It is rounded to 4 digits: float32 radians are good to 1e-5 degrees, and what is meant is a short number.
    """
    turns = torch.exp(1j * phi_deg.double().deg2rad() * count).mean()
    first = math.degrees(math.atan2(float(turns.imag), float(turns.real))) / count
    return round(first % (360 / count), 4) % (360 / count)


def nearest(
    directions: DirectionSet, angles_deg: Float[Tensor, "direction 2"]
) -> tuple[Int[Tensor, "direction"], Float[Tensor, "direction"]]:
    """Return the place in the set that is nearest to each theta and phi (degrees) on the nearest ring.

    Returns:
        (n) places, and (n) degrees between the directions there and those asked for.
    """
    theta, phi = angles_deg.double().unbind(-1)
    ring_theta = torch.tensor(directions.theta_deg, dtype=torch.float64)
    count, phi0 = torch.tensor(directions.count), torch.tensor(directions.phi0_deg, dtype=torch.float64)
    ring = (theta[:, None] - ring_theta).abs().argmin(1)
    step = ((phi - phi0[ring]) * count[ring] / 360).round().long() % count[ring]
    place = torch.tensor([0, *accumulate(directions.count)])[ring] + step
    apart = (from_angles(theta.deg2rad(), phi.deg2rad()) - directions.directions(torch.float64)[place]).norm(dim=-1)
    return place, 2 * (apart / 2).clamp(max=1).asin().rad2deg()


def _places(directions: DirectionSet, theta: Tensor, phi: Tensor) -> Tensor | None:
    """Return the order that sorts a list into `directions`; None unless each has exactly one near its place."""
    if len(directions) != len(theta):
        return None
    place, off = nearest(directions, torch.stack([theta, phi], -1))
    if len(place.unique()) < len(place) or float(off.max()) > TOLERANCE_DEG:
        return None
    return place.argsort()
