"""Built-in mesostructures: flat sheet, groove, spheres, brick, weave. Each is tileable and exact.

All lengths are in tile units. Closed forms of every shape stand in its test.

Test: tests/meso/test_generators.py
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import ConfigError, check_range
from torchmeso.meso.mesostructure import Mesostructure, Rgb, palette
from torchmeso.transport.materials import Palette
from torchmeso.transport.tracer import Geometry

Triangles = tuple[Tensor, Tensor]
"""(V, 3) vertices and (F, 3) faces of one part."""


def sheet(*, h: float = 0.1, albedo: Rgb = (0.5, 0.5, 0.5), roughness: float = 0.5, f0: float = 0.0) -> Mesostructure:
    """Return a flat sheet at the bottom of the slab: D = h / cos(theta) everywhere."""
    return _assemble([(_floor(h), 0)], palette((albedo, roughness, f0)), h)


def groove(
    *, h: float = 0.1, width: float = 0.4, albedo: Rgb = (0.5, 0.5, 0.5), roughness: float = 0.5, f0: float = 0.0
) -> Mesostructure:
    """Return a groove along v with upright walls, `width` wide around u = 0.5 and h deep; its banks lie on top."""
    check_range("groove.width", width, 0.01, 0.99)
    low, high = 0.5 - width / 2, 0.5 + width / 2
    parts = [
        _rectangle(high, low + 1, 0.0, 1.0, 0.0),
        _rectangle(low, high, 0.0, 1.0, -h),
        _quad((low, 0, -h), (low, 1, -h), (low, 1, 0), (low, 0, 0)),
        _quad((high, 0, 0), (high, 1, 0), (high, 1, -h), (high, 0, -h)),
    ]
    return _assemble([(p, 0) for p in parts], palette((albedo, roughness, f0)), h)


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
    check_range("spheres.radius", radius, 1e-3, 0.5 / count)
    check_range("spheres.h", h, radius, 10)
    ball = _ellipsoid(radius, segments)
    parts: list[tuple[Triangles, int]] = [(_floor(h), 1)]
    for i in range(count):
        for j in range(count):
            centre = torch.tensor([(i + 0.5) / count, (j + 0.5) / count, -radius])
            parts.append(((ball[0] + centre, ball[1]), 0))
    return _assemble(parts, palette((albedo, roughness, f0), (floor_albedo, roughness, 0.0)), h)


def brick(
    *,
    rows: int = 4,
    columns: int = 2,
    h: float = 0.1,
    mortar: float = 0.03,
    bevel: float = 0.02,
    albedo: Rgb = (0.42, 0.15, 0.09),
    mortar_albedo: Rgb = (0.5, 0.48, 0.45),
    roughness: float = 0.6,
    f0: float = 0.0,
    variation: float = 0.25,
    seed: int = 0,
) -> Mesostructure:
    """Return a running bond of bevelled bricks with tops on the reference plane over mortar at -h.

    Args:
        rows: courses per tile, even so that the bond repeats.
        columns: bricks per course.
        h: depth of the joints.
        mortar: width of the joints at the bottom.
        bevel: width of the sloping rim of each brick, seen from above.
        albedo: mean linear RGB of the bricks.
        mortar_albedo: linear RGB of the joints.
        roughness: GGX width.
        f0: reflectance of the bricks' coat.
        variation: relative spread of the bricks' brightness.
        seed: chooses each brick's brightness.

    Raises:
        ConfigError: rows is odd, or a brick would have no top.
    """
    if rows < 2 or rows % 2 or columns < 1:
        raise ConfigError(f"brick: expected an even number of rows and at least one column, got {rows} x {columns}")
    inset = mortar / 2 + bevel
    if inset * 2 >= min(1 / rows, 1 / columns) or min(mortar, bevel) < 0:
        raise ConfigError("brick: expected mortar and bevel to leave a top on every brick; make them narrower")
    rng = torch.Generator().manual_seed(seed)
    shade = 1 + variation * (2 * torch.rand(rows * columns, generator=rng) - 1)
    parts: list[tuple[Triangles, int]] = [(_floor(h), 0)]
    for row in range(rows):
        for column in range(columns):
            u, v = (column + 0.5 * (row % 2)) / columns, row / rows
            outer = (u + mortar / 2, u + 1 / columns - mortar / 2, v + mortar / 2, v + 1 / rows - mortar / 2)
            parts.append((_frustum(outer, bevel, h), 1 + row * columns + column))
    materials = [(mortar_albedo, 0.8, 0.0)]
    for k in range(rows * columns):
        r, g, b = (min(1.0, c * float(shade[k])) for c in albedo)
        materials.append(((r, g, b), roughness, f0))
    return _assemble(parts, palette(*materials), h)


def weave(
    *,
    count: int = 4,
    h: float = 0.16,
    width: float = 0.9,
    albedo: Rgb = (0.55, 0.42, 0.2),
    weft_albedo: Rgb = (0.16, 0.28, 0.45),
    roughness: float = 0.35,
    f0: float = 0.04,
    backing: bool = True,
    segments: int = 24,
) -> Mesostructure:
    """Return an over-under weave of elliptic yarns: each dives under its neighbours, so it is no height field.

    Yarn j of the weft runs along u at v = (j + 0.5) / count, its centre at -h/2 + (-1)^j h/4 cos(pi (count u - 0.5));
    the warp runs along v with the opposite sign. Sections at constant u (or v) are ellipses of half height h/4.

    Args:
        count: yarns per tile in each direction, even so that the weave repeats.
        h: depth of the slab: two yarns.
        width: width of a yarn as a share of the spacing.
        albedo: linear RGB of the warp.
        weft_albedo: linear RGB of the weft.
        roughness: GGX width of the yarns' coat.
        f0: reflectance of the yarns' coat.
        backing: whether a dark sheet closes the gaps at -h; without it rays pass through (no-hit entries).
        segments: facets around a yarn; along it as many per crossing.

    Raises:
        ConfigError: count is odd, or the width is out of range.
    """
    if count < 2 or count % 2:
        raise ConfigError(f"weave.count: expected an even number of yarns, got {count}")
    check_range("weave.width", width, 0.05, 1)
    half_width, half_height = width / (2 * count), h / 4
    along = torch.arange(count * segments + 1) / (count * segments)
    around = torch.arange(segments) * (2 * math.pi / segments)
    wave = half_height * torch.cos(math.pi * (count * along - 0.5))
    parts: list[tuple[Triangles, int]] = [(_floor(h), 2)] if backing else []
    for j in range(count):
        across = (j + 0.5) / count + half_width * around.cos()
        for part, sign in ((1, (-1) ** j), (0, -((-1) ** j))):
            z = -h / 2 + sign * wave[:, None] + half_height * around.sin()
            a, c = along[:, None].expand_as(z), across.expand_as(z)
            tube = torch.stack([a, c, z] if part == 1 else [c, a, z], -1)
            parts.append((_tube(tube), part))
    materials = palette((albedo, roughness, f0), (weft_albedo, roughness, f0), ((0.03, 0.03, 0.03), 1.0, 0.0))
    return _assemble(parts, materials, h)


GENERATORS: dict[str, Callable[..., Mesostructure]] = {
    "sheet": sheet,
    "groove": groove,
    "spheres": spheres,
    "brick": brick,
    "weave": weave,
}


def _assemble(parts: list[tuple[Triangles, int]], materials: Palette, h: float) -> Mesostructure:
    vertices, faces, part, first = [], [], [], 0
    for (v, f), number in parts:
        vertices.append(v)
        faces.append(f + first)
        part.append(torch.full((len(f),), number))
        first += len(v)
    geometry = Geometry(
        vertices=torch.cat(vertices).clamp(min=torch.tensor([-torch.inf, -torch.inf, -h])),
        faces=torch.cat(faces),
        part=torch.cat(part),
        palette=materials,
    )
    return Mesostructure(geometry=geometry, h=h)


def _floor(h: float) -> Triangles:
    return _rectangle(0.0, 1.0, 0.0, 1.0, -h)


def _rectangle(u0: float, u1: float, v0: float, v1: float, z: float) -> Triangles:
    return _quad((u0, v0, z), (u1, v0, z), (u1, v1, z), (u0, v1, z))


def _quad(*corners: tuple[float, float, float]) -> Triangles:
    return torch.tensor(corners, dtype=torch.float32), torch.tensor([[0, 1, 2], [0, 2, 3]])


def _frustum(outer: tuple[float, float, float, float], bevel: float, h: float) -> Triangles:
    """A brick without a bottom: a rectangle at z = 0, inset by `bevel`, over `outer` at z = -h."""
    u0, u1, v0, v1 = outer
    low = [(u0, v0, -h), (u1, v0, -h), (u1, v1, -h), (u0, v1, -h)]
    top = [
        (u0 + bevel, v0 + bevel, 0.0),
        (u1 - bevel, v0 + bevel, 0.0),
        (u1 - bevel, v1 - bevel, 0.0),
        (u0 + bevel, v1 - bevel, 0.0),
    ]
    faces = [(4, 5, 6), (4, 6, 7)]
    for k in range(4):
        n = (k + 1) % 4
        faces += [(k, n, 4 + n), (k, 4 + n, 4 + k)]
    return torch.tensor(low + top, dtype=torch.float32), torch.tensor(faces)


def _ellipsoid(radius: float, segments: int) -> Triangles:
    """A sphere around the origin, `segments` facets around and half as many from pole to pole."""
    rings = segments // 2
    phi = torch.arange(segments) * (2 * math.pi / segments)
    theta = (torch.arange(rings + 1) * (math.pi / rings))[:, None]
    points = torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos().expand(-1, segments)], -1)
    vertices, faces = _tube(points)
    return vertices * radius, faces


def _tube(points: Float[Tensor, "along around 3"]) -> Triangles:
    """Join rings of points into a tube, open at both ends."""
    along, around, _ = points.shape
    number = torch.arange(along * around).reshape(along, around)
    a, b = number[:-1], number[1:]
    c, d = b.roll(-1, 1), a.roll(-1, 1)
    faces = torch.stack([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)], 2).reshape(-1, 3)
    return points.reshape(-1, 3), faces
