"""Mesostructures with level and upright faces: brick, blocks, grid.

Test: tests/meso/test_masonry.py
"""

import torch

from torchmeso.errors import ConfigError, check_range
from torchmeso.meso.mesostructure import Mesostructure, Rgb, palette
from torchmeso.meso.parts import DARK, Triangles, assemble, floor, frustum, shades, straight


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
    parts: list[tuple[Triangles, int]] = [(floor(h), 0)]
    for row in range(rows):
        for column in range(columns):
            u, v = (column + 0.5 * (row % 2)) / columns, row / rows
            outer = (u + mortar / 2, u + 1 / columns - mortar / 2, v + mortar / 2, v + 1 / rows - mortar / 2)
            parts.append((frustum(outer, bevel, -h, 0.0), 1 + row * columns + column))
    tints = [(tint, roughness, f0) for tint in shades(albedo, variation, rows * columns, rng)]
    return assemble(parts, palette((mortar_albedo, 0.8, 0.0), *tints), h)


def blocks(
    *,
    count: int = 4,
    h: float = 0.2,
    gap: float = 0.05,
    lowest: float = 0.35,
    albedo: Rgb = (0.45, 0.42, 0.36),
    floor_albedo: Rgb = (0.25, 0.24, 0.22),
    roughness: float = 0.6,
    f0: float = 0.0,
    variation: float = 0.2,
    seed: int = 0,
) -> Mesostructure:
    """Return count x count upright blocks of different heights over a floor at -h; the highest reaches the top.

    Args:
        count: blocks per tile in each direction.
        h: height of the highest block.
        gap: distance between blocks.
        lowest: height of the lowest possible block as a share of `h`.
        albedo: mean linear RGB of the blocks.
        floor_albedo: linear RGB between them.
        roughness: GGX width.
        f0: reflectance of the blocks' coat.
        variation: relative spread of the blocks' brightness.
        seed: chooses each block's height and brightness.

    Raises:
        ConfigError: a value is out of range.
    """
    check_range("blocks.count", count, 1, 64)
    check_range("blocks.gap", gap, 0, 0.95 / count)
    check_range("blocks.lowest", lowest, 0.01, 1)
    rng = torch.Generator().manual_seed(seed)
    height = lowest + (1 - lowest) * torch.rand(count * count, generator=rng)
    top = (height / height.max() - 1) * h
    parts: list[tuple[Triangles, int]] = [(floor(h), 0)]
    for k in range(count * count):
        u, v = (k % count) / count + gap / 2, (k // count) / count + gap / 2
        side = 1 / count - gap
        parts.append((frustum((u, u + side, v, v + side), 0.0, -h, float(top[k])), 1 + k))
    tints = [(tint, roughness, f0) for tint in shades(albedo, variation, count * count, rng)]
    return assemble(parts, palette((floor_albedo, roughness, 0.0), *tints), h)


def grid(
    *,
    count: int = 3,
    h: float = 0.3,
    bar: float = 0.08,
    albedo: Rgb = (0.5, 0.4, 0.25),
    roughness: float = 0.4,
    f0: float = 0.04,
    backing: bool = False,
) -> Mesostructure:
    """Return a lattice of square bars: one layer on top, one at the bottom, posts between them where bars cross.

    Args:
        count: bars per tile in each direction.
        h: depth of the slab, from the top of the upper layer to the bottom of the lower one.
        bar: side of a bar.
        albedo: linear RGB of the bars.
        roughness: GGX width of their coat.
        f0: reflectance of their coat.
        backing: whether a dark sheet closes the holes at -h; without it rays pass through (no-hit entries).

    Raises:
        ConfigError: the bars leave no holes, or the layers no room between them.
    """
    check_range("grid.count", count, 1, 64)
    check_range("grid.bar", bar, 1e-3, min(0.95 / count, 0.49 * h))
    parts: list[tuple[Triangles, int]] = [(floor(h), 1)] if backing else []
    for k in range(count):
        low, high = (k + 0.5) / count - bar / 2, (k + 0.5) / count + bar / 2
        for bottom, top in ((-bar, 0.0), (-h, bar - h)):
            section = torch.tensor([[low, bottom], [high, bottom], [high, top], [low, top]])
            parts += [(straight(section, 0), 0), (straight(section, 1), 0)]
        for j in range(count):
            v = (j + 0.5) / count - bar / 2
            parts.append((frustum((low, high, v, v + bar), 0.0, bar - h, -bar), 0))
    return assemble(parts, palette((albedo, roughness, f0), DARK), h)
