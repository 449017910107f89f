"""The plainest mesostructures, whose distances are known by hand: flat sheet, groove, spheres.

Test: tests/meso/test_plain.py
"""

import torch

from torchmeso.errors import check_range
from torchmeso.meso.mesostructure import Mesostructure, Rgb, palette
from torchmeso.meso.parts import Triangles, assemble, ellipsoid, floor, quad, rectangle


def sheet(*, h: float = 0.1, albedo: Rgb = (0.5, 0.5, 0.5), roughness: float = 0.5, f0: float = 0.0) -> Mesostructure:
    """Return a flat sheet at the bottom of the slab: D = h / cos(theta) everywhere."""
    return assemble([(floor(h), 0)], palette((albedo, roughness, f0)), h)


def groove(
    *, h: float = 0.1, width: float = 0.4, albedo: Rgb = (0.5, 0.5, 0.5), roughness: float = 0.5, f0: float = 0.0
) -> Mesostructure:
    """Return a groove along v with upright walls, `width` wide around u = 0.5 and h deep; its banks lie on top."""
    check_range("groove.width", width, 0.01, 0.99)
    low, high = 0.5 - width / 2, 0.5 + width / 2
    parts = [
        rectangle(high, low + 1, 0.0, 1.0, 0.0),
        rectangle(low, high, 0.0, 1.0, -h),
        quad((low, 0, -h), (low, 1, -h), (low, 1, 0), (low, 0, 0)),
        quad((high, 0, 0), (high, 1, 0), (high, 1, -h), (high, 0, -h)),
    ]
    return assemble([(p, 0) for p in parts], palette((albedo, roughness, f0)), h)


def spheres(
    *,
    count: int = 2,
    radius: float = 0.22,
    h: float = 0.3,
    albedo: Rgb = (0.7, 0.5, 0.3),
    floor_albedo: Rgb = (0.3, 0.3, 0.35),
    roughness: float = 0.4,
    f0: float = 0.0,
    segments: int = 64,
) -> Mesostructure:
    """Return count x count spheres whose tops touch the reference plane, over a floor at -h: not a height field.

    `segments` is the number of facets around the equator.
    """
    check_range("spheres.count", count, 1, 64)
    check_range("spheres.radius", radius, 1e-3, 0.5 / count)
    check_range("spheres.h", h, radius, 10)
    ball = ellipsoid(radius, segments)
    parts: list[tuple[Triangles, int]] = [(floor(h), 1)]
    for i in range(count):
        for j in range(count):
            centre = torch.tensor([(i + 0.5) / count, (j + 0.5) / count, -radius])
            parts.append(((ball[0] + centre, ball[1]), 0))
    return assemble(parts, palette((albedo, roughness, f0), (floor_albedo, roughness, 0.0)), h)
