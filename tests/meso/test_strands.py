"""Round strands against ellipses, cylinders and stadia."""

import math

import pytest
import torch

from tests.meso.looks import in_first_tile, looks, straight_down, wrong
from torchmeso.errors import ConfigError
from torchmeso.meso import generators
from torchmeso.meso.bake_mdf import RayCastMdf


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


def pipes_distance(uv, wo, count, radius, layers):
    """Rays against cylinders along u, and under them along v."""
    p, best = in_first_tile(uv), torch.full((len(uv),), torch.inf, dtype=uv.dtype)
    for layer in range(layers):
        across = 1 - layer
        d = torch.stack([-wo[:, across], -wo[:, 2]], -1)
        for k in range(-2 * count, 3 * count):
            centre = torch.tensor([(k + 0.5) / count, -radius * (1 + 2 * layer)], dtype=uv.dtype)
            m = p[:, [across, 2]] - centre
            a, b, c = d.square().sum(-1), (m * d).sum(-1), m.square().sum(-1) - radius**2
            disc = b.square() - a * c
            t = (-b - disc.clamp(min=0).sqrt()) / a
            best = torch.where((disc > 0) & (t >= 0), torch.minimum(best, t), best)
    return best


@pytest.mark.parametrize("crossing", [False, True])
def test_pipes(crossing, rng):
    meso = generators.pipes(count=3, radius=0.1, h=0.45, crossing=crossing, segments=256)
    uv, wo = looks(rng, 70)
    expected = torch.minimum(pipes_distance(uv, wo, 3, 0.1, 1 + crossing), 0.45 / wo[:, 2])
    assert wrong(RayCastMdf(meso).evaluate(uv, wo), expected, 1e-3) < 1e-2  # rays that graze a pipe


def middles(k, links, radius, wire):
    """Place of a link's middle and its axes: along the chain, across in its own plane, normal to that."""
    lean = math.pi / 4 if k % 2 else -math.pi / 4
    x, y = torch.tensor([1.0, 0, 0]), torch.tensor([0.0, math.cos(lean), math.sin(lean)])
    axes = torch.stack([x, y, torch.linalg.cross(x, y)]).double()
    return torch.tensor([(k + 0.5) / links, 0.0, -radius * math.sqrt(0.5) - wire], dtype=torch.float64), axes


def chain_gap(p, count, links, radius, wire):
    """Distance of points to the wire of the nearest link."""
    best, side = torch.full((len(p),), torch.inf, dtype=p.dtype), 1 / links - 2 * radius + 2 * wire
    for j in range(count):
        for k in range(links):
            middle, axes = middles(k, links, radius, wire)
            for turns in (-1.0, 0.0, 1.0):
                offset = p - middle - torch.tensor([turns, 0, 0])
                y = offset[:, 1] - (j + 0.5) / count
                offset[:, 1] = y - y.round()
                a, b, c = (offset @ axes.T).unbind(-1)
                in_plane = torch.hypot((a.abs() - side / 2).clamp(min=0), b) - radius
                best = torch.minimum(best, torch.hypot(in_plane, c) - wire)
    return best


def test_chain(rng):
    """Rays marched through the distance to the wire find what the triangles say."""
    shape = {"count": 3, "links": 2, "radius": 0.14, "wire": 0.04}
    uv, wo = looks(rng, 55, n=800)
    t = torch.zeros(800, dtype=torch.float64)
    for _ in range(400):
        p = in_first_tile(uv) - t[:, None] * wo
        t += chain_gap(torch.cat([p[:, :2] % 1, p[:, 2:]], 1), **shape).clamp(min=0)
    expected = torch.where(t * wo[:, 2] < 0.3, t, torch.inf)
    D = RayCastMdf(generators.chain(**shape, h=0.3, segments=64)).evaluate(uv, wo)
    assert wrong(D, expected, 1e-3) < 1e-2  # rays that graze the wire


def test_links_of_a_chain_are_linked_and_touch_without_cutting():
    links, radius, wire = 4, 0.08, 0.03
    side = 1 / links - 2 * radius + 2 * wire
    angle, x = (torch.linspace(-1, 1, 201)[:-1].double() * w for w in (math.pi / 2, side / 2))
    half = torch.cat([torch.stack([radius * angle.cos() + side / 2, radius * angle.sin()], -1),
                      torch.stack([-x, torch.full_like(x, radius)], -1)])  # fmt: skip
    flat = torch.cat([half, -half])
    loops = []
    for k in (0, 1):
        middle, axes = middles(k, links, radius, wire)
        loops.append(middle + flat @ axes[:2])
    a, b = loops
    da, db = a.roll(-1, 0) - a, b.roll(-1, 0) - b
    r = (a + da / 2)[:, None] - (b + db / 2)
    gauss = (r * torch.linalg.cross(da[:, None].expand_as(r), db.expand_as(r))).sum(-1) / r.norm(dim=-1) ** 3
    assert abs(float(gauss.sum()) / (4 * math.pi)) == pytest.approx(1, abs=1e-2)
    assert float((a[:, None] - b).norm(dim=-1).min()) == pytest.approx(2 * wire, abs=1e-4)


@pytest.mark.errors
def test_impossible_shapes_are_refused():
    with pytest.raises(ConfigError, match="even number of yarns, got 3"):
        generators.weave(count=3)
    with pytest.raises(ConfigError, match=r"pipes\.radius: expected a value from 0\.001 to 0\.125"):
        generators.pipes(radius=0.2)
    with pytest.raises(ConfigError, match=r"pipes\.h: expected a value from 0\.32"):
        generators.pipes(h=0.2)
    with pytest.raises(ConfigError, match="even number of links, got 3"):
        generators.chain(links=3)
    with pytest.raises(ConfigError, match=r"chain\.radius: expected a value from 0\.06 to"):
        generators.chain(radius=0.04)
    with pytest.raises(ConfigError, match=r"chain\.count"):
        generators.chain(count=8)
    with pytest.raises(ConfigError, match=r"segments: expected a value from 3"):
        generators.pipes(segments=2)
