"""Grown shapes against triangles, lenses and ovals of Cassini."""

import math

import pytest
import torch

from tests.meso.looks import in_first_tile, looks, straight_down, wrong
from torchmeso.errors import ConfigError
from torchmeso.meso import generators
from torchmeso.meso.bake_mdf import RayCastMdf


def triangle_distance(uv, wo, corners):
    """Rays against one triangle and its copies in the tiles around; inf where none is met."""
    p, best = in_first_tile(uv), torch.full((len(uv),), torch.inf, dtype=uv.dtype)
    a, b, c = corners
    normal = torch.linalg.cross(b - a, c - a)
    for i in (-1, 0, 1, 2):
        for j in (-1, 0, 1, 2):
            shift = torch.tensor([i - 1.0, j - 1.0, 0], dtype=uv.dtype)
            t = ((p - a - shift) @ normal) / (wo @ normal)
            q = p - t[:, None] * wo - shift
            inside = torch.stack(
                [torch.linalg.cross((y - x).expand_as(q), q - x) @ normal for x, y in ((a, b), (b, c), (c, a))]
            )
            best = torch.where((inside >= 0).all(0) & (t >= 0), torch.minimum(best, t), best)
    return best


def test_an_upright_blade_is_a_triangle(rng):
    meso = generators.grass(count=1, bend=0.0, width=0.4, h=0.3, backing=False)
    p = meso.geometry.vertices.double()
    root = p[p[:, 2] < -0.3 + 1e-6]
    tip = p[p[:, 2].argmax()]
    assert float((root[0] - root[1]).norm()) == pytest.approx(0.4, abs=1e-6)
    torch.testing.assert_close(tip[:2], root[:, :2].mean(0), rtol=0, atol=1e-6)
    uv, wo = looks(rng, 60)
    expected = triangle_distance(uv, wo, torch.stack([root[0], root[1], tip]))
    assert expected.isfinite().double().mean() > 0.02
    assert wrong(RayCastMdf(meso).evaluate(uv, wo), expected, 1e-4) < 2e-3


def test_a_bent_blade_follows_its_parabola(rng):
    """Seen from above: height h sqrt(x / lean) at the distance x from the root along the lean."""
    meso = generators.grass(count=1, bend=2.0, width=0.2, h=0.3, segments=100, backing=False, seed=2)
    p = meso.geometry.vertices.double()
    root, tip = p[p[:, 2] < -0.3 + 1e-6][:, :2].mean(0), p[p[:, 2].argmax(), :2]
    lean = float((tip - root).norm())
    assert 0.05 < lean <= 0.6
    along = (tip - root) / lean
    uv, wo = straight_down(rng)
    got = RayCastMdf(meso).evaluate(uv, wo)
    place = uv[got.isfinite()] - root
    place = torch.stack([(place + torch.tensor([i, j])) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    x, y = place @ along, place @ torch.stack([-along[1], along[0]])
    s = (x / lean).clamp(min=0, max=1).sqrt()
    over = (y.abs() <= 0.1 * (1 - s) + 1e-5) & (x >= 0) & (x <= lean)
    expected = torch.where(over, 0.3 * (1 - s), torch.inf).amin(0)
    assert wrong(got[got.isfinite()], expected, 2e-3) < 1e-2
    # The area under a blade: the integral of its width 0.2 (1 - s) over x = lean s^2.
    assert float(got.isfinite().double().mean()) == pytest.approx(0.2 * lean / 3, abs=0.02)


def test_grass_is_many_layers_deep_and_open_without_soil(rng):
    uv, wo = straight_down(rng)
    closed, open_ = (RayCastMdf(generators.grass(backing=b)).evaluate(uv, wo) for b in (True, False))
    gap = open_.isinf()
    assert 0.05 < float(gap.double().mean()) < 0.8
    torch.testing.assert_close(closed[gap], torch.full((int(gap.sum()),), 0.35, dtype=torch.float64), rtol=0, atol=1e-5)
    torch.testing.assert_close(closed[~gap], open_[~gap], rtol=0, atol=1e-6)


def squama_height(uv, columns, rows, overlap, dome, h):
    """Top of the scales seen from above, from the highest point of a scale that lies at 0."""
    a, b = 0.5 / columns, overlap / rows
    highest = overlap if overlap >= 2 * dome else dome + overlap**2 / (4 * dome)
    step = h / (overlap + highest)
    best = torch.full((len(uv),), -h, dtype=uv.dtype)
    for row in range(-rows, 2 * rows):
        for column in range(-columns, 2 * columns):
            x = (uv[:, 0] % 1) - (column + 0.5 * (row % 2)) / columns
            y = (uv[:, 1] % 1) - row / rows
            rho2 = (x / a).square() + (y / b).square()
            top = (rows * y - highest) * step + dome * step * (1 - rho2)
            best = torch.where(rho2 < 1, torch.maximum(best, top), best)
    return best


@pytest.mark.parametrize("dome", [0.4, 1.0])
def test_squama(dome, rng):
    uv, wo = straight_down(rng)
    meso = generators.squama(columns=3, rows=4, overlap=1.7, dome=dome, h=0.2, segments=128)
    D = RayCastMdf(meso).evaluate(uv, wo)
    assert wrong(D, -squama_height(uv, 3, 4, 1.7, dome, 0.2), 1e-3) < 1e-2  # rims between facets
    assert float(meso.geometry.vertices[:, 2].max()) == pytest.approx(0, abs=1e-3)


def test_rays_pass_under_the_tips_of_scales():
    """From the tip's side a ray enters under a scale that covers the place when seen from above."""
    meso = generators.squama(columns=3, rows=4, overlap=1.7, dome=0.4, h=0.2)
    wo = torch.tensor([[0.0, math.sin(1.2), math.cos(1.2)]], dtype=torch.float64)
    v = torch.linspace(0, 1, 400, dtype=torch.float64)
    uv = torch.stack([torch.zeros_like(v), v], -1)
    t = RayCastMdf(meso).evaluate(uv, wo.expand(400, 3))
    p = in_first_tile(uv) - t[:, None] * wo
    above = squama_height(p[:, :2], 3, 4, 1.7, 0.4, 0.2)
    assert float((above - p[:, 2]).max()) > 0.01


def cassini_height(uv, meso, h, waist):
    """Height of lying peanuts seen from above; middle, heading and size are read off their vertices."""
    s = 2 * (1 - math.sqrt(1 - waist**2)) / waist**2
    best = torch.full((len(uv),), -h, dtype=uv.dtype)
    part = torch.zeros(len(meso.geometry.vertices), dtype=torch.long)
    part[meso.geometry.faces] = meso.geometry.part[:, None].expand(-1, 3)
    for k in range(1, int(part.max()) + 1):
        p = meso.geometry.vertices[part == k].double()
        ends, middle, thick = torch.stack([p[0], p[-1]])[:, :2], p.mean(0)[:2], float(p[:, 2].max() - p[:, 2].min())
        a = thick / s
        heading = (ends[1] - ends[0]) / (ends[1] - ends[0]).norm()
        torch.testing.assert_close((ends[1] - ends[0]).norm().item(), 2 * a * math.sqrt(1 + s), rtol=1e-4, atol=1e-5)
        offset = uv - middle
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                q = offset + torch.tensor([i, j], dtype=uv.dtype)
                x, y = q @ heading, q @ torch.stack([-heading[1], heading[0]])
                r2 = (s**2 * a**4 + 4 * a**2 * x.square()).sqrt() - x.square() - a**2
                z = thick / 2 - h + (r2 - y.square()).clamp(min=0).sqrt()
                best = torch.where(r2 > y.square(), torch.maximum(best, z), best)
    return best


def test_peanut(rng):
    uv, wo = straight_down(rng)
    meso = generators.peanut(count=6, h=0.2, waist=0.7, segments=96)
    D = RayCastMdf(meso).evaluate(uv, wo)
    assert wrong(D, -cassini_height(uv, meso, 0.2, 0.7), 2e-3) < 1e-2  # steep flanks between facets


def test_peanuts_touch_at_most():
    """No vertex of one lies inside another: its own level line is the only thing above it."""
    meso = generators.peanut(seed=5)
    part = torch.zeros(len(meso.geometry.vertices), dtype=torch.long)
    part[meso.geometry.faces] = meso.geometry.part[:, None].expand(-1, 3)
    s = 2 * (1 - math.sqrt(1 - 0.75**2)) / 0.75**2
    bodies = [meso.geometry.vertices[part == k].double() for k in range(1, 11)]
    for k, p in enumerate(bodies):
        others = torch.cat([q for j, q in enumerate(bodies) if j != k])
        thick = float(p[:, 2].max() - p[:, 2].min())
        a, axis = thick / s, (p[-1] - p[0]) / (p[-1] - p[0]).norm()
        q = others - p.mean(0)
        q[:, :2] -= q[:, :2].round()
        x2 = (q @ axis).square()
        r2 = q.square().sum(-1) - x2
        level = (x2 + r2 + a**2).square() - 4 * a**2 * x2 - (s * a**2) ** 2
        assert float(level.min()) > -1e-3 * a**4


@pytest.mark.parametrize("name", ["grass", "peanut", "squama"])
def test_the_seed_decides(name):
    make = generators.GENERATORS[name]
    a, b, again = (make(seed=k).geometry for k in (1, 2, 1))
    assert torch.equal(a.vertices, again.vertices)
    assert torch.equal(a.palette.albedo, again.palette.albedo)
    assert not torch.equal(a.palette.albedo, b.palette.albedo)


@pytest.mark.errors
def test_impossible_shapes_are_refused():
    with pytest.raises(ConfigError, match="even number of rows"):
        generators.squama(rows=5)
    with pytest.raises(ConfigError, match=r"squama\.overlap: expected a value from 1"):
        generators.squama(overlap=0.5)
    with pytest.raises(ConfigError, match=r"peanut\.count: expected a number that finds room, got 60"):
        generators.peanut(count=60)
    with pytest.raises(ConfigError, match=r"peanut\.waist"):
        generators.peanut(waist=1.0)
    with pytest.raises(ConfigError, match=r"grass\.shortest"):
        generators.grass(shortest=0.0)
