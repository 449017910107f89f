"""Mesostructures of round strands: weave, pipes, chain.

Test: tests/meso/test_strands.py
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import ConfigError, check_range
from torchmeso.meso.mesostructure import Mesostructure, Rgb, palette
from torchmeso.meso.parts import DARK, SEGMENTS, Triangles, assemble, floor, straight, tube, turn


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
    check_range("weave.count", count, 2, 64)
    check_range("weave.segments", segments, *SEGMENTS)
    check_range("weave.width", width, 0.05, 1)
    half_width, half_height = width / (2 * count), h / 4
    along = torch.arange(count * segments + 1) / (count * segments)
    around = turn(segments)
    wave = half_height * torch.cos(math.pi * (count * along - 0.5))
    parts: list[tuple[Triangles, int]] = [(floor(h), 2)] if backing else []
    for j in range(count):
        across = (j + 0.5) / count + half_width * around.cos()
        for part, sign in ((1, (-1) ** j), (0, -((-1) ** j))):
            z = -h / 2 + sign * wave[:, None] + half_height * around.sin()
            a, c = along[:, None].expand_as(z), across.expand_as(z)
            points = torch.stack([a, c, z] if part == 1 else [c, a, z], -1)
            parts.append((tube(points), part))
    materials = palette((albedo, roughness, f0), (weft_albedo, roughness, f0), DARK)
    return assemble(parts, materials, h)


def pipes(
    *,
    count: int = 4,
    radius: float = 0.08,
    h: float = 0.34,
    crossing: bool = True,
    albedo: Rgb = (0.08, 0.2, 0.5),
    crossing_albedo: Rgb = (0.35, 0.36, 0.38),
    floor_albedo: Rgb = (0.12, 0.12, 0.13),
    roughness: float = 0.3,
    f0: float = 0.04,
    segments: int = 24,
) -> Mesostructure:
    """Return pipes along u whose tops touch the reference plane, on pipes along v, over a floor at -h.

    Args:
        count: pipes per tile in each direction.
        radius: of a pipe.
        h: depth of the floor: at least the pipes' own height.
        crossing: whether there are pipes along v under those along u.
        albedo: linear RGB of the pipes along u.
        crossing_albedo: linear RGB of the pipes along v.
        floor_albedo: linear RGB of the floor.
        roughness: GGX width of the pipes' coat.
        f0: reflectance of the pipes' coat.
        segments: facets around a pipe.

    Raises:
        ConfigError: the pipes do not fit beside each other or into the slab.
    """
    check_range("pipes.count", count, 1, 64)
    check_range("pipes.radius", radius, 1e-3, 0.5 / count)
    check_range("pipes.h", h, radius * (4 if crossing else 2), 10)
    around = turn(segments)
    parts: list[tuple[Triangles, int]] = [(floor(h), 2)]
    for layer in range(2 if crossing else 1):
        for k in range(count):
            across = (k + 0.5) / count + radius * around.cos()
            z = radius * (around.sin() - 1 - 2 * layer)
            parts.append((straight(torch.stack([across, z], -1), layer), layer))
    coats = (albedo, roughness, f0), (crossing_albedo, roughness, f0)
    return assemble(parts, palette(*coats, (floor_albedo, 0.8, 0.0)), h)


def chain(
    *,
    count: int = 4,
    links: int = 4,
    radius: float = 0.08,
    wire: float = 0.03,
    h: float = 0.18,
    albedo: Rgb = (0.5, 0.38, 0.16),
    roughness: float = 0.3,
    f0: float = 0.3,
    backing: bool = False,
    segments: int = 16,
) -> Mesostructure:
    """Return taut chains along u: each link is a stadium of round wire, turned by 90 degrees against its neighbours.

    Links lean by +45 and -45 degrees in turn, so that all reach equally high. The tops touch the reference plane.

    Args:
        count: chains per tile, side by side.
        links: links per tile, even so that the chain repeats.
        radius: of the round ends of a link, to the middle of the wire.
        wire: radius of the wire.
        h: depth of the slab.
        albedo: linear RGB of the metal under its coat.
        roughness: GGX width of the coat.
        f0: reflectance of the coat.
        backing: whether a dark sheet closes the gaps at -h; without it rays pass through (no-hit entries).
        segments: facets around the wire.

    Raises:
        ConfigError: links is odd, links would cut into each other, or chains do not fit into the tile.
    """
    if links < 2 or links % 2:
        raise ConfigError(f"chain.links: expected an even number of links, got {links}")
    check_range("chain.segments", segments, *SEGMENTS)
    check_range("chain.radius", radius, 2 * wire, 0.5 / links + wire)
    reach = radius * math.sqrt(0.5) + wire
    check_range("chain.count", count, 1, 0.5 / reach)
    check_range("chain.h", h, 2 * reach, 10)
    side = 1 / links - 2 * radius + 2 * wire  # two taut links lie two wire radii into each other
    ring, outwards = _stadium(radius, side, segments)
    around = turn(segments)[:, None]
    parts: list[tuple[Triangles, int]] = [(floor(h), 1)] if backing else []
    for k in range(links):
        lean = math.pi / 4 if k % 2 else -math.pi / 4
        across = torch.tensor([0.0, math.cos(lean), math.sin(lean)])
        normal = torch.tensor([0.0, -math.sin(lean), math.cos(lean)])
        plane = torch.stack([torch.tensor([1.0, 0.0, 0.0]), across])
        points = (ring @ plane)[:, None] + wire * (around.cos() * (outwards @ plane)[:, None] + around.sin() * normal)
        vertices, faces = tube(torch.cat([points, points[:1]]))
        for j in range(count):
            place = torch.tensor([(k + 0.5) / links, (j + 0.5) / count, -reach])
            parts.append(((vertices + place, faces), 0))
    return assemble(parts, palette((albedo, roughness, f0), DARK), h)


def _stadium(radius: float, side: float, segments: int) -> tuple[Float[Tensor, "n 2"], Float[Tensor, "n 2"]]:
    """Return points on two half circles joined by straight sides along x, and the outward normals there."""
    angle = torch.arange(segments + 1) * (math.pi / segments) - math.pi / 2
    angle = torch.cat([angle, angle + math.pi])
    outwards = torch.stack([angle.cos(), angle.sin()], -1)
    end = torch.tensor([side / 2, 0.0]).repeat(segments + 1, 1)
    return radius * outwards + torch.cat([end, -end]), outwards
