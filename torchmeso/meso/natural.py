"""Grown mesostructures: grass, squama, peanut.

Test: tests/meso/test_natural.py
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import ConfigError, check_range
from torchmeso.meso.mesostructure import Mesostructure, Rgb, palette
from torchmeso.meso.parts import DARK, SEGMENTS, Triangles, assemble, floor, shades, tube, turn


def grass(
    *,
    count: int = 16,
    h: float = 0.35,
    width: float = 0.045,
    bend: float = 0.9,
    shortest: float = 0.5,
    albedo: Rgb = (0.13, 0.3, 0.06),
    soil_albedo: Rgb = (0.06, 0.045, 0.03),
    roughness: float = 0.5,
    f0: float = 0.02,
    variation: float = 0.4,
    backing: bool = True,
    segments: int = 5,
    seed: int = 0,
) -> Mesostructure:
    """Return count x count thin blades, each leaning its own way: many layers deep, so it is no height field.

    A blade of height H with its root at r points up as r + (lean s^2, H s), s in [0, 1], and its width shrinks to
    nothing at the tip. Roots stand one in each cell of a regular grid, anywhere in it.

    Args:
        count: blades per tile in each direction.
        h: height of the tallest blade.
        width: of a blade at its root.
        bend: how far a tip leans sideways, at most, as a share of the blade's height.
        shortest: height of the shortest possible blade as a share of `h`.
        albedo: mean linear RGB of the blades.
        soil_albedo: linear RGB of the soil.
        roughness: GGX width of the blades' coat.
        f0: reflectance of the blades' coat.
        variation: relative spread of the blades' brightness.
        backing: whether soil lies at -h; without it rays pass between the blades (no-hit entries).
        segments: pieces along a blade.
        seed: chooses each blade's root, height, lean and brightness.

    Raises:
        ConfigError: a value is out of range.
    """
    check_range("grass.count", count, 1, 200)
    check_range("grass.width", width, 1e-4, 1)
    check_range("grass.bend", bend, 0, 4)
    check_range("grass.shortest", shortest, 0.01, 1)
    check_range("grass.segments", segments, 1, 100)
    rng = torch.Generator().manual_seed(seed)
    n = count * count
    cell = torch.stack([torch.arange(n) % count, torch.arange(n) // count], -1)
    root = (cell + torch.rand(n, 2, generator=rng)) / count
    height = shortest + (1 - shortest) * torch.rand(n, generator=rng)
    height = height / height.max() * h
    angle = 2 * math.pi * torch.rand(n, generator=rng)
    heading = torch.stack([angle.cos(), angle.sin()], -1)
    lean = heading * (bend * height * torch.rand(n, generator=rng))[:, None]
    s = torch.arange(segments + 1)[:, None] / segments
    edge = torch.stack([-heading[:, 1], heading[:, 0]], -1) * (width / 2)
    parts: list[tuple[Triangles, int]] = [(floor(h), 0)] if backing else []
    for k in range(n):
        middle = torch.cat([root[k] + lean[k] * s**2, height[k] * s - h], -1)
        half = torch.cat([edge[k] * (1 - s), torch.zeros_like(s)], -1)
        parts.append((_blade(middle - half, middle + half), 1 + k))
    tints = [(tint, roughness, f0) for tint in shades(albedo, variation, n, rng)]
    return assemble(parts, palette((soil_albedo, 1.0, 0.0), *tints), h)


def squama(
    *,
    columns: int = 4,
    rows: int = 6,
    h: float = 0.12,
    overlap: float = 1.7,
    dome: float = 0.6,
    albedo: Rgb = (0.16, 0.28, 0.2),
    roughness: float = 0.35,
    f0: float = 0.04,
    variation: float = 0.2,
    segments: int = 24,
    seed: int = 0,
) -> Mesostructure:
    """Return rows of scales like a fish's: each lies over the roots of the next row, its free tip points along +v.

    A scale is a lens: an elliptic disc that rises along v, with a dome on it. In coordinates (x, y) around its middle
    and with rho^2 = (x / a)^2 + (y / b)^2 <= 1 its top is z_0 + slope y + d (1 - rho^2) over its underside
    z_0 + slope y, with a = 1 / (2 columns) and b = overlap / rows. Under the tips the next row shows: no height field.

    Args:
        columns: scales per row.
        rows: rows per tile, even because every other one is shifted by half a scale.
        h: depth of the slab, from the tips to the roots.
        overlap: half length of a scale over the distance of the rows.
        dome: thickness d of a scale as a share of the step from one row to the next.
        albedo: mean linear RGB of the scales.
        roughness: GGX width of their coat.
        f0: reflectance of their coat.
        variation: relative spread of the scales' brightness.
        segments: facets around a scale.
        seed: chooses each scale's brightness.

    Raises:
        ConfigError: rows is odd, or scales would not overlap or cut into each other.
    """
    if rows < 2 or rows % 2 or columns < 1:
        raise ConfigError(f"squama: expected an even number of rows and at least one column, got {rows} x {columns}")
    check_range("squama.rows", rows, 2, 64)
    check_range("squama.columns", columns, 1, 64)
    check_range("squama.segments", segments, *SEGMENTS)
    check_range("squama.overlap", overlap, 1, 4)
    check_range("squama.dome", dome, 0.01, 1)
    # Heights in steps from row to row: the tip, or the crest of the dome where that lies higher.
    highest = overlap if overlap >= 2 * dome else dome + overlap**2 / (4 * dome)
    step = h / (overlap + highest)
    lens = _lens(0.5 / columns, overlap / rows, rows * step, dome * step, segments)
    rng = torch.Generator().manual_seed(seed)
    parts: list[tuple[Triangles, int]] = [(floor(h), 0)]
    for row in range(rows):
        for column in range(columns):
            place = torch.tensor([(column + 0.5 * (row % 2)) / columns, row / rows, -highest * step])
            parts.append(((lens[0] + place, lens[1]), 1 + row * columns + column))
    tints = [(tint, roughness, f0) for tint in shades(albedo, variation, rows * columns, rng)]
    return assemble(parts, palette(DARK, *tints), h)


def peanut(
    *,
    count: int = 10,
    h: float = 0.16,
    waist: float = 0.75,
    smallest: float = 0.8,
    albedo: Rgb = (0.55, 0.36, 0.18),
    floor_albedo: Rgb = (0.2, 0.14, 0.09),
    roughness: float = 0.6,
    f0: float = 0.02,
    variation: float = 0.15,
    segments: int = 24,
    seed: int = 0,
) -> Mesostructure:
    """Return peanuts strewn over a floor at -h, none into another; the largest reaches the reference plane.

    A peanut is an oval of Cassini turned around its axis: (x^2 + r^2 + a^2)^2 - 4 a^2 x^2 = b^4, at most b^2 / (2 a)
    thick and 2 sqrt(a^2 + b^2) long.

    Args:
        count: peanuts per tile.
        h: thickness of the largest.
        waist: thickness in the middle over the largest thickness.
        smallest: size of the smallest possible peanut, the largest being 1.
        albedo: mean linear RGB of the peanuts.
        floor_albedo: linear RGB of the floor.
        roughness: GGX width.
        f0: reflectance of the peanuts' coat.
        variation: relative spread of the peanuts' brightness.
        segments: facets around a peanut, and along it.
        seed: chooses place, direction, size and brightness.

    Raises:
        ConfigError: a value is out of range, or so many do not find room.
    """
    check_range("peanut.count", count, 1, 400)
    check_range("peanut.segments", segments, *SEGMENTS)
    check_range("peanut.waist", waist, 0.1, 0.99)
    check_range("peanut.smallest", smallest, 0.1, 1)
    rng = torch.Generator().manual_seed(seed)
    size = smallest + (1 - smallest) * torch.rand(count, generator=rng)
    size = size.sort(descending=True).values / size.max()
    x, r = _cassini(h / 2, waist, segments)
    layouts = (_strew(size, x, r, rng) for _ in range(8))
    layout = next((places for places in layouts if places is not None), None)
    if layout is None:
        raise ConfigError(f"peanut.count: expected a number that finds room, got {count}; take fewer")
    centre, heading = layout
    around = turn(segments)
    parts: list[tuple[Triangles, int]] = [(floor(h), 0)]
    for k in range(count):
        side = torch.stack([-heading[k, 1], heading[k, 0]])
        flat = x[:, None, None] * heading[k] + (r[:, None] * around.cos())[..., None] * side
        z = r[:, None] * around.sin()
        vertices, faces = tube(torch.cat([flat, z[..., None]], -1) * size[k])
        parts.append(((vertices + torch.cat([centre[k], (size[k] * h / 2 - h)[None]]), faces), 1 + k))
    tints = [(tint, roughness, f0) for tint in shades(albedo, variation, count, rng)]
    return assemble(parts, palette((floor_albedo, 0.9, 0.0), *tints), h)


def _blade(left: Float[Tensor, "n 3"], right: Float[Tensor, "n 3"]) -> Triangles:
    """A strip between two edges that meet at the tip."""
    n = len(left)
    k = torch.arange(n - 1)
    wide = torch.stack([k, k + n, k + 1], -1)
    narrow = torch.stack([k + 1, k + n, k + n + 1], -1)[:-1]  # the last piece is a triangle
    return torch.cat([left, right]), torch.cat([wide, narrow])


def _lens(a: float, b: float, slope: float, dome: float, segments: int) -> Triangles:
    """A closed scale around the origin: up its underside from the middle to the rim, and back over its dome."""
    rings = segments // 4
    rho = torch.arange(rings + 1) / rings
    rho, over = torch.cat([rho, rho.flip(0)[1:]]), torch.arange(2 * rings + 1) > rings
    around = turn(segments)
    x, y = a * rho[:, None] * around.cos(), b * rho[:, None] * around.sin()
    z = slope * y + (over * dome * (1 - rho.square()))[:, None]
    return tube(torch.stack([x, y, z], -1))


def _cassini(radius: float, waist: float, segments: int) -> tuple[Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Return places along the axis and the radius there, of a peanut at most `radius` thick around its axis."""
    s = 2 * (1 - math.sqrt(1 - waist**2)) / waist**2  # (b / a)^2, from waist = 2 sqrt(s - 1) / s
    a = 2 * radius / s
    # Close together at the ends, where the radius changes fast, and on both crests.
    x = -a * math.sqrt(1 + s) * torch.cos(torch.arange(segments + 1, dtype=torch.float64) * (math.pi / segments))
    crest = torch.tensor([a * math.sqrt(1 - s**2 / 4)], dtype=torch.float64)
    x = torch.cat([x, crest, -crest]).sort().values
    r2 = (s**2 * a**4 + 4 * a**2 * x.square()).sqrt() - x.square() - a**2
    return x.float(), r2.clamp(min=0).sqrt().float()


def _strew(
    size: Float[Tensor, "count"], x: Float[Tensor, "n"], r: Float[Tensor, "n"], rng: torch.Generator
) -> tuple[Float[Tensor, "count 2"], Float[Tensor, "count 2"]] | None:
    """Return middles and headings so that none overlaps another, or None where the last found no room.

    One after the other is laid, of a thousand places the one as close to the others as can be.

    A peanut is taken for the balls of radius r at the places x along its axis.
    """
    tries = 1000
    x, r = x[::2], r[::2]  # balls this close together leave no room for another between them
    balls, radii = torch.zeros(0, 2), torch.zeros(0)
    centres, headings = [], []
    for k in range(len(size)):
        centre = torch.rand(tries, 2, generator=rng)
        angle = 2 * math.pi * torch.rand(tries, generator=rng)
        heading = torch.stack([angle.cos(), angle.sin()], -1)
        own = centre[:, None] + size[k] * x[:, None] * heading[:, None]
        apart = own[:, :, None] - balls
        apart = (apart - apart.round()).norm(dim=-1)  # the tile repeats
        room = (apart - (size[k] * r)[:, None] - radii).flatten(1)
        gap = room.amin(1) if len(balls) else torch.zeros(tries)
        chosen = int(torch.where(gap >= 0, gap, torch.inf).argmin())
        if float(gap[chosen]) < 0:
            return None
        balls, radii = torch.cat([balls, own[chosen]]), torch.cat([radii, size[k] * r])
        centres.append(centre[chosen])
        headings.append(heading[chosen])
    return torch.stack(centres), torch.stack(headings)
