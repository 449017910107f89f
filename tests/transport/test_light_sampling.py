import math
from dataclasses import replace

import pytest
import torch

from torchmeso.data.environment import LUMINANCE, Environment, Texels
from torchmeso.errors import ConfigError
from torchmeso.pipeline.environment import about
from torchmeso.transport import light_sampling
from torchmeso.transport.light_sampling import directions, from_quads, to_quads

METHODS = ["quadtree", "median_cut", "uniform"]


def some_map(rng, height=16):
    """Dim noise with a few bright texels."""
    radiance = torch.rand(height, 2 * height, 3, generator=rng)
    radiance[3, 5], radiance[3, 6], radiance[11, 20] = 300.0, 200.0, 500.0
    return Environment(radiance=radiance, rotation=torch.eye(3))


def on_the_sphere(n, rng):
    return torch.nn.functional.normalize(torch.randn(n, 3, dtype=torch.float64, generator=rng), dim=1)


def turned(texels, angle):
    c, s = math.cos(angle), math.sin(angle)
    R = torch.tensor([[c, 0, s], [0, 1, 0], [-s, 0, c]], dtype=torch.float64)
    return Texels(texels.directions @ R.mT, *texels[1:])


def diffuse(lights, normals):
    w, E = lights
    return (normals @ w.mT).clamp(min=0) @ E / math.pi


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("count", [1, 5, 12, 50, 200, 2000])
def test_the_lights_carry_all_the_energy_of_the_map(method, count, rng):
    made = some_map(rng)
    w, E = directions(made.texels(), count, method=method)
    torch.testing.assert_close(E.sum(0), made.irradiance(), rtol=1e-12, atol=0)
    torch.testing.assert_close(w.norm(dim=1), torch.ones(len(w), dtype=torch.float64))
    assert len(w) <= count and (len(w) >= 0.9 * min(count, 512) or method == "uniform")


def test_quads_have_equal_areas_and_places_on_them_go_back_and_forth(rng):
    w = torch.cat([on_the_sphere(60_000, rng), torch.eye(3, dtype=torch.float64), -torch.eye(3, dtype=torch.float64)])
    quad, x, y = to_quads(w)
    back = from_quads(quad, x, y)
    assert float((back - w).norm(dim=1).max()) < 1e-12  # measured 8e-14
    cells = torch.bincount((quad * 2 + (x * 2).long().clamp(max=1)) * 2 + (y * 2).long().clamp(max=1), minlength=48)
    expected = len(w) / 48
    assert float(((cells - expected) ** 2 / expected).sum()) < 47 + 4 * math.sqrt(2 * 47)


@pytest.mark.parametrize("method", METHODS)
def test_more_lights_are_nearer_to_the_map(method, rng):
    texels = some_map(rng).texels()
    normals = on_the_sphere(300, rng)
    whole = diffuse((texels.directions, texels.solid_angle[:, None] * texels.radiance), normals)
    error = [
        float((diffuse(directions(texels, n, method=method), normals) - whole).norm() / whole.norm()) for n in (16, 256)
    ]
    assert error[1] < 0.4 * error[0]
    assert error[1] < (0.1 if method == "uniform" else 0.01)


def test_one_bright_texel_is_one_light_where_it_stands():
    radiance = torch.zeros(32, 64, 3)
    radiance[7, 40] = torch.tensor([3.0, 2.0, 1.0])
    made = Environment(radiance=radiance, rotation=torch.eye(3))
    for method in ("quadtree", "median_cut"):
        w, E = directions(made.texels(), 50, method=method)
        assert len(w) == 1
        torch.testing.assert_close(w[0], made.texels().directions[7 * 64 + 40])
        torch.testing.assert_close(E[0], made.irradiance())


@pytest.mark.parametrize("method", METHODS)
def test_a_black_map_has_no_lights(method):
    made = Environment(radiance=torch.zeros(4, 8, 3), rotation=torch.eye(3))
    assert light_sampling.lights(made, 50, method=method) == ()


@pytest.mark.parametrize("method", METHODS)
def test_a_single_texel_is_a_map(method):
    made = Environment(radiance=torch.ones(1, 1, 3), rotation=torch.eye(3))
    lights = light_sampling.lights(made, 10, method=method)
    total = sum(light.irradiance for light in lights)
    torch.testing.assert_close(total, torch.full((3,), 4 * math.pi))


def test_a_small_turn_of_the_map_changes_the_picture_little(rng):
    texels = some_map(rng, 32).texels()
    normals = on_the_sphere(300, rng)
    pictures, exact = [], []
    for k in range(8):
        t = turned(texels, math.radians(k))
        pictures.append(diffuse(directions(t, 100), normals))
        exact.append(diffuse((t.directions, t.solid_angle[:, None] * t.radiance), normals))
    steps, wanted = (torch.stack(x).diff(dim=0).square().mean().sqrt() for x in (pictures, exact))
    assert float(steps / wanted) < 1.1  # measured 1.036


@pytest.mark.parametrize("method", METHODS)
def test_lights_turn_with_their_map(method, rng):
    made = some_map(rng)
    R = about((1.0, 2.0, 0.5), 77.0).float()
    before = light_sampling.lights(made, 50, method=method)
    after = light_sampling.lights(replace(made, rotation=R @ made.rotation), 50, method=method)
    for a, b in zip(before, after, strict=True):
        torch.testing.assert_close(b.direction, R @ a.direction)
        assert torch.equal(a.irradiance, b.irradiance)
    total = sum(b.irradiance.double() for b in after)
    torch.testing.assert_close(total, replace(made, rotation=R).irradiance(), rtol=1e-6, atol=0)


def test_joining_keeps_luminance_and_its_centre(rng):
    texels = some_map(rng).texels()
    E = texels.solid_angle[:, None] * texels.radiance
    moments = light_sampling._moments(texels.directions[:40], E[:40])
    _, found = light_sampling._joined(moments, texels.directions[:40], 7)
    torch.testing.assert_close(found.sum(0), E[:40].sum(0))
    assert len(found) == 7
    assert torch.allclose(moments[:, 3], E[:40] @ torch.tensor(LUMINANCE, dtype=torch.float64))


@pytest.mark.errors
@pytest.mark.parametrize("count", [0, 10**6])
def test_a_count_that_is_none_is_refused(count, rng):
    with pytest.raises(ConfigError, match="lights of an environment"):
        directions(some_map(rng).texels(), count)
