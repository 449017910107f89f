"""The plain shapes against what is known by hand."""

import pytest
import torch

from tests.meso.looks import N, looks
from torchmeso.errors import ConfigError
from torchmeso.meso import generators
from torchmeso.meso.bake_mdf import RayCastMdf


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


@pytest.mark.errors
def test_impossible_shapes_are_refused():
    with pytest.raises(ConfigError, match=r"spheres\.radius: expected a value from 0\.001 to 0\.25"):
        generators.spheres(radius=0.4)
    with pytest.raises(ConfigError, match=r"groove\.width"):
        generators.groove(width=1.5)
