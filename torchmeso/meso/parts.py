"""The pieces generators put tiles together from: rectangles, frusta, ellipsoids, tubes.

Lengths are in tile units, z = 0 is the top of the slab. Pieces may stick out of the tile; they come in again on the
other side.

Test: tests/meso/test_parts.py
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import check_range
from torchmeso.meso.mesostructure import Mesostructure, Rgb
from torchmeso.transport.materials import Palette
from torchmeso.transport.tracer import Geometry

Triangles = tuple[Tensor, Tensor]
"""(V, 3) vertices and (F, 3) faces of one piece."""

DARK: tuple[Rgb, float, float] = ((0.03, 0.03, 0.03), 1.0, 0.0)
"""Albedo, roughness and f0 of the sheet that closes the holes of an open structure."""

SEGMENTS = 3, 512
"""Facets around a round piece: fewest and most."""

ALONG = 12
"""Pieces a straight bar is cut into along a tile: as fine as displaced meshes are refined, so they stay as they are."""


def assemble(parts: Sequence[tuple[Triangles, int]], materials: Palette, h: float) -> Mesostructure:
    """Return the tile made of (triangles, row of the palette)."""
    vertices, faces, part, first = [], [], [], 0
    for (v, f), number in parts:
        vertices.append(v)
        faces.append(f + first)
        part.append(torch.full((len(f),), number))
        first += len(v)
    # Rounding may carry a vertex a bit below the bottom.
    geometry = Geometry(
        vertices=torch.cat(vertices).clamp(min=torch.tensor([-torch.inf, -torch.inf, -h])),
        faces=torch.cat(faces),
        part=torch.cat(part),
        palette=materials,
    )
    return Mesostructure(geometry=geometry, h=h)


def shades(albedo: Rgb, variation: float, count: int, rng: torch.Generator) -> list[Rgb]:
    """Return `count` colours around `albedo`, each brighter or darker by at most the share `variation`."""
    factor = 1 + variation * (2 * torch.rand(count, generator=rng) - 1)
    r, g, b = albedo
    return [(min(1.0, r * f), min(1.0, g * f), min(1.0, b * f)) for f in factor.tolist()]


def floor(h: float) -> Triangles:
    """Return the bottom of the slab."""
    return rectangle(0.0, 1.0, 0.0, 1.0, -h)


def rectangle(u0: float, u1: float, v0: float, v1: float, z: float) -> Triangles:
    """Return a level rectangle."""
    return quad((u0, v0, z), (u1, v0, z), (u1, v1, z), (u0, v1, z))


def quad(*corners: tuple[float, float, float]) -> Triangles:
    """Return a quadrilateral by its corners, in order."""
    return torch.tensor(corners, dtype=torch.float32), torch.tensor([[0, 1, 2], [0, 2, 3]])


def frustum(outer: tuple[float, float, float, float], bevel: float, bottom: float, top: float) -> Triangles:
    """Return a frustum without its base: a rectangle at z = top, inset by `bevel`, over `outer` at z = bottom.

    `outer` is (u0, u1, v0, v1); without a bevel it is an upright block.
    """
    u0, u1, v0, v1 = outer
    low = [(u0, v0, bottom), (u1, v0, bottom), (u1, v1, bottom), (u0, v1, bottom)]
    high = [
        (u0 + bevel, v0 + bevel, top),
        (u1 - bevel, v0 + bevel, top),
        (u1 - bevel, v1 - bevel, top),
        (u0 + bevel, v1 - bevel, top),
    ]
    faces = [(4, 5, 6), (4, 6, 7)]
    for k in range(4):
        n = (k + 1) % 4
        faces += [(k, n, 4 + n), (k, 4 + n, 4 + k)]
    return torch.tensor(low + high, dtype=torch.float32), torch.tensor(faces)


def ellipsoid(radius: float, segments: int) -> Triangles:
    """Return a sphere around the origin, `segments` facets around and half as many from pole to pole."""
    rings = segments // 2
    phi = turn(segments)
    theta = (torch.arange(rings + 1) * (math.pi / rings))[:, None]
    points = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos().expand(-1, segments)], -1)
    vertices, faces = tube(points)
    return vertices * radius, faces


def straight(section: Float[Tensor, "around 2"], axis: int) -> Triangles:
    """Return a bar through the whole tile along u (axis 0) or v (axis 1), open at both ends.

    `section` holds its outline: (v, z) of a bar along u, (u, z) of one along v.
    """
    along = (torch.arange(ALONG + 1) / ALONG)[:, None].expand(-1, len(section))
    across, z = (x.expand_as(along) for x in section.unbind(-1))
    return tube(torch.stack([along, across, z] if axis == 0 else [across, along, z], -1))


def tube(points: Float[Tensor, "along around 3"]) -> Triangles:
    """Return rings of points joined into a tube, open at both ends."""
    along, around, _ = points.shape
    number = torch.arange(along * around).reshape(along, around)
    a, b = number[:-1], number[1:]
    c, d = b.roll(-1, 1), a.roll(-1, 1)
    faces = torch.stack([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)], 2).reshape(-1, 3)
    return points.reshape(-1, 3), faces


def turn(segments: int) -> Float[Tensor, "segments"]:
    """Return the angles of the corners of a regular polygon, the first at 0."""
    check_range("segments", segments, *SEGMENTS)
    return torch.arange(segments) * (2 * math.pi / segments)
