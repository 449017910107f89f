"""Each generator against a closed form of its surface."""

import math

import pytest
import torch

from torchmeso.errors import ConfigError
from torchmeso.geometry.directions import from_angles
from torchmeso.meso import generators
from torchmeso.meso.bake_mdf import RayCastMdf
from torchmeso.meso.generators import GENERATORS

N = 4000


def looks(rng, last_deg=80.0):
    theta = torch.rand(N, generator=rng, dtype=torch.float64) * math.radians(last_deg)
    phi = torch.rand(N, generator=rng, dtype=torch.float64) * 2 * math.pi
    return torch.rand(N, 2, generator=rng, dtype=torch.float64) * 4 - 2, from_angles(theta, phi)


def straight_down(rng):
    wo = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(N, 3)
    return torch.rand(N, 2, generator=rng, dtype=torch.float64), wo


def groove_distance(uv, wo, h, width):
    """Ray against banks (z = 0), bottom (z = -h) and the two walls of a groove along v."""
    low, high = 0.5 - width / 2, 0.5 + width / 2
    u = uv[:, 0] % 1
    over = (u > low) & (u < high)
    slope = -wo[:, 0] / wo[:, 2]  # change of u per unit of depth
    wall = torch.where(slope > 0, (high - u) / slope, (low - u) / slope)
    depth = torch.where(slope == 0, h, wall.clamp(max=h))
    return torch.where(over, depth / wo[:, 2], 0)


def spheres_distance(uv, wo, count, radius, h):
    p = torch.cat([uv, torch.zeros(N, 1, dtype=torch.float64)], 1)
    best = h / wo[:, 2]
    for i in range(-12 * count, 13 * count):
        for j in range(-12 * count, 13 * count):
            centre = torch.tensor([(i + 0.5) / count, (j + 0.5) / count, -radius], dtype=torch.float64)
            near = ((p - centre)[:, :2].norm(dim=-1) - radius) < best
            if not bool(near.any()):
                continue
            m = p - centre
            b = (m * wo).sum(-1)
            disc = b**2 - (m.square().sum(-1) - radius**2)
            t = b - disc.clamp(min=0).sqrt()
            best = torch.where((disc > 0) & (t >= 0), torch.minimum(best, t), best)
    return best


def brick_height(uv, rows, columns, h, mortar, bevel):
    u, v = uv[:, 0] % 1, uv[:, 1] % 1
    row = (v * rows).floor()
    y = v - row / rows
    x = (u - 0.5 * (row % 2) / columns) % (1 / columns)
    edge = torch.minimum(torch.minimum(x, 1 / columns - x), torch.minimum(y, 1 / rows - y)) - mortar / 2
    return torch.where(edge < 0, -h, -h + h * (edge / bevel).clamp(max=1))


def weave_height(uv, count, h, width):
    """Top of the yarns seen from above; nan in the gaps."""
    half_width, half_height = width / (2 * count), h / 4
    u, v = uv[:, 0] % 1, uv[:, 1] % 1
    tops = []
    for along, across, turn in ((u, v, 1.0), (v, u, -1.0)):
        yarn = (across * count).floor()
        x = (across - (yarn + 0.5) / count) / half_width
        sign = turn * (1 - 2 * (yarn % 2))
        centre = -h / 2 + sign * half_height * torch.cos(math.pi * (count * along - 0.5))
        tops.append(torch.where(x.abs() < 1, centre + half_height * (1 - x.square()).clamp(min=0).sqrt(), -torch.inf))
    return torch.maximum(*tops)


def test_sheet(rng):
    uv, wo = looks(rng, 88)
    D = RayCastMdf(generators.sheet(h=0.2)).evaluate(uv, wo)
    torch.testing.assert_close(D, 0.2 / wo[:, 2], rtol=1e-4, atol=0)


def test_groove(rng):
    uv, wo = looks(rng)
    D = RayCastMdf(generators.groove(h=0.15, width=0.4)).evaluate(uv, wo)
    expected = groove_distance(uv, wo, 0.15, 0.4)
    wrong = (D - expected).abs() > 2e-4
    assert wrong.float().mean() < 2e-3  # rays within float32 of an edge


def test_spheres(rng):
    uv, wo = looks(rng)
    D = RayCastMdf(generators.spheres(segments=512)).evaluate(uv, wo)
    expected = spheres_distance(uv, wo, 2, 0.22, 0.3)
    wrong = (D - expected).abs() > 2e-3  # facets: 0.22 (1 - cos(pi / 512)) / cos at grazing incidence
    assert wrong.float().mean() < 1e-2  # rays that graze a sphere


def test_brick(rng):
    uv, wo = straight_down(rng)
    D = RayCastMdf(generators.brick(h=0.1, mortar=0.03, bevel=0.02)).evaluate(uv, wo)
    expected = -brick_height(uv, 4, 2, 0.1, 0.03, 0.02)
    assert ((D - expected).abs() > 1e-4).float().mean() < 2e-3


def test_weave(rng):
    uv, wo = straight_down(rng)
    D = RayCastMdf(generators.weave(segments=96)).evaluate(uv, wo)
    height = weave_height(uv, 4, 0.16, 0.9)
    expected = torch.where(height.isinf(), 0.16, -height)
    assert ((D - expected).abs() > 1e-3).float().mean() < 2e-2  # the steep flanks of faceted yarns


def test_weave_is_no_height_field():
    """Two surfaces above one point of the tile: yarns over and under, with a gap between them at a slant."""
    geometry = generators.weave(backing=False).geometry
    inside = geometry.vertices[(geometry.vertices[:, :2] - 0.125).norm(dim=-1) < 0.03]
    assert inside[:, 2].max() > -0.03
    assert inside[:, 2].min() < -0.13


def test_weave_without_backing_lets_rays_through(rng):
    uv, wo = straight_down(rng)
    D = RayCastMdf(generators.weave(width=0.7, backing=False)).evaluate(uv, wo)
    assert float(D.isinf().double().mean()) == pytest.approx(0.3**2, abs=0.02)


@pytest.mark.parametrize("name", list(GENERATORS))
def test_everything_repeats(name, rng):
    caster = RayCastMdf(GENERATORS[name]())
    uv, wo = looks(rng, 75)
    shift = torch.tensor([2.0, -3.0], dtype=torch.float64)
    assert ((caster.evaluate(uv, wo) - caster.evaluate(uv + shift, wo)).abs() > 1e-4).float().mean() < 2e-3


@pytest.mark.parametrize("name", list(GENERATORS))
def test_top_and_depth(name):
    meso = GENERATORS[name]()
    z = meso.geometry.vertices[:, 2]
    assert float(z.min()) >= -meso.h - 1e-6
    if name != "sheet":
        assert float(z.max()) == pytest.approx(0, abs=1e-6)


def test_bricks_differ_in_shade_and_the_seed_decides():
    a, b = generators.brick(seed=1), generators.brick(seed=2)
    assert len(a.geometry.palette.albedo.unique(dim=0)) == 9
    assert not torch.equal(a.geometry.palette.albedo, b.geometry.palette.albedo)
    assert torch.equal(a.geometry.palette.albedo, generators.brick(seed=1).geometry.palette.albedo)


@pytest.mark.errors
def test_impossible_shapes_are_refused():
    with pytest.raises(ConfigError, match="even number of rows"):
        generators.brick(rows=3)
    with pytest.raises(ConfigError, match="leave a top on every brick"):
        generators.brick(mortar=0.22)
    with pytest.raises(ConfigError, match="even number of yarns, got 3"):
        generators.weave(count=3)
    with pytest.raises(ConfigError, match=r"spheres\.radius: expected a value from 0\.001 to 0\.25"):
        generators.spheres(radius=0.4)
    with pytest.raises(ConfigError, match=r"groove\.width"):
        generators.groove(width=1.5)
