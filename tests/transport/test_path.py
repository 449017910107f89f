import math

import pytest
import torch

from torchmeso.geometry import shapes
from torchmeso.geometry.directions import from_angles, normalize
from torchmeso.geometry.light import DirectionalLight, PointLight
from torchmeso.meso import generators
from torchmeso.transport.materials import Palette
from torchmeso.transport.path import radiance
from torchmeso.transport.tracer import Geometry, MeshTracer, TileTracer

DOWN = torch.tensor([0.0, 0.0, -1.0])


def sun(theta_deg, phi_deg=0.0):
    theta, phi = (torch.tensor(x).deg2rad() for x in (theta_deg, phi_deg))
    return DirectionalLight(direction=from_angles(theta, phi), irradiance=torch.full((3,), math.pi))


def tile(name, **options):
    meso = generators.GENERATORS[name](**options)
    return TileTracer(meso.geometry, meso.h)


def from_above(n, rng):
    return torch.cat([torch.rand(n, 2, generator=rng), torch.full((n, 1), 1e-4)], 1), DOWN.expand(n, 3)


def test_lambertian_sheet_is_albedo_times_cosine(rng):
    lights = [sun(0.0), sun(60.0), sun(80.0, 30.0)]
    L, sky, seen = radiance(tile("sheet", albedo=(0.2, 0.4, 0.8)), *from_above(200, rng), lights, bounces=0, rng=rng)
    assert seen.all()
    assert (sky == 0).all()
    cosine = torch.tensor([0.0, 60.0, 80.0]).deg2rad().cos()
    expected = cosine[:, None] * torch.tensor([0.2, 0.4, 0.8])
    torch.testing.assert_close(L, expected.expand(200, 3, 3), rtol=1e-4, atol=1e-6)


def test_shadow_of_a_groove_wall(rng):
    """At 45 degrees the bottom of a groove is dark over a strip as wide as the wall is high."""
    o, d = from_above(4000, rng)
    L, _, _ = radiance(tile("groove", h=0.1, width=0.4), o, d, [sun(45.0)], bounces=0, rng=rng)
    u = o[:, 0]
    bottom = (u > 0.3) & (u < 0.7)
    dark = L[:, 0, 0] == 0
    assert not dark[~bottom].any()
    assert dark[bottom & (u > 0.6 + 1e-3)].all()
    assert not dark[bottom & (u < 0.6 - 1e-3)].any()


def test_white_furnace(rng):
    """White material under a uniform sky reflects exactly the sky, however deep the structure."""
    white = {"albedo": (1.0, 1.0, 1.0), "roughness": 1.0}
    for name, options in (("groove", {**white, "h": 0.3}), ("spheres", {**white, "floor_albedo": (1.0, 1.0, 1.0)})):
        o, d = from_above(3000, rng)
        _, sky, _ = radiance(tile(name, **options), o, d, [sun(0.0)], bounces=60, ambient=1.0, rng=rng)
        assert sky.max() <= 1 + 1e-4
        assert float(sky.mean()) == pytest.approx(1, abs=2e-3)  # what 60 bounces leave over


def test_integrating_sphere_is_a_geometric_series(rng):
    """Inside a diffuse sphere lit from its centre each bounce adds the same radiance times the albedo, exactly."""
    ball = shapes.sphere(triangles=20_000)
    palette = Palette(albedo=torch.full((1, 3), 0.6), alpha=torch.ones(1), f0=torch.zeros(1, 3))
    part = torch.zeros(len(ball.faces), dtype=torch.long)
    tracer = MeshTracer(Geometry(vertices=ball.vertices, faces=ball.faces, part=part, palette=palette))
    lamp = PointLight(position=torch.zeros(3), intensity=torch.full((3,), math.pi))
    d = normalize(torch.randn(2000, 3, generator=rng))
    for bounces, expected in ((0, 0.6), (1, 0.96), (3, 1.3056)):
        L, _, _ = radiance(tracer, torch.zeros(2000, 3), d, [lamp], bounces=bounces, rng=rng)
        assert float(L.mean()) == pytest.approx(expected, rel=3e-3)  # facets
        assert float(L.std()) < 0.02


def test_point_light_is_blocked_and_limited(rng):
    quad = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    palette = Palette(albedo=torch.ones(1, 3), alpha=torch.ones(1), f0=torch.zeros(1, 3))
    faces, part = torch.tensor([[0, 1, 2], [0, 2, 3]]), torch.zeros(2, dtype=torch.long)
    floor = Geometry(vertices=quad, faces=faces, part=part, palette=palette)
    above = Geometry(vertices=quad * 0.2 + torch.tensor([0.0, 0, 3]), faces=faces, part=part, palette=palette)
    below = Geometry(vertices=quad * 0.2 + torch.tensor([0.0, 0, 1]), faces=faces, part=part, palette=palette)
    lamp = PointLight(position=torch.tensor([0.0, 0, 2]), intensity=torch.full((3,), math.pi))
    o, d = torch.tensor([[0.5, 0.0, 0.1], [0.0, 0.0, 0.1]]), DOWN.expand(2, 3)
    clear, _, _ = radiance(MeshTracer(floor, above), o, d, [lamp], bounces=0, rng=rng)
    assert float(clear[1, 0, 0]) == pytest.approx(0.25, rel=1e-4)  # cos / r^2; what lies behind the lamp is no blocker
    dark, _, _ = radiance(MeshTracer(floor, below), o, d, [lamp], bounces=0, rng=rng)
    assert dark[1, 0, 0] == 0


def test_same_seed_same_bits_at_any_thread_count():
    o, d = from_above(500, torch.Generator().manual_seed(1))
    threads = torch.get_num_threads()
    results = []
    try:
        for n in (1, 2):
            torch.set_num_threads(n)
            rng = torch.Generator().manual_seed(7)
            results.append(radiance(tile("weave"), o, d, [sun(30.0), sun(50.0)], bounces=2, rng=rng)[0])
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*results)


def test_rays_that_miss_are_black(rng):
    o, d = from_above(10, rng)
    L, sky, seen = radiance(tile("sheet"), o, -d, [sun(0.0)], bounces=1, ambient=0.5, rng=rng)
    assert not seen.any()
    assert (L == 0).all()
    assert (sky == 0).all()
