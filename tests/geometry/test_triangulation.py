import math

import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.geometry import hemisphere, triangulation
from torchmeso.geometry.directions import from_angles

SETS = [
    "ubo81",
    "ubo151",
    "grid(12, 5, 80)",
    "rings(0: 1)",
    "rings(0: 1, 40: 3 @ 10)",
    "rings(30: 1 @ 70)",
    "rings(20: 1, 40: 7 @ 3, 60: 1 @ 350)",
]


def directions(n, rng, dtype=torch.float64):
    """Return directions of the whole sphere."""
    return torch.nn.functional.normalize(torch.randn(n, 3, dtype=dtype, generator=rng), dim=-1)


def blended(table, found):
    return (table[found.node] * found.weight).sum(-1)


@pytest.mark.parametrize("name", SETS)
def test_weights_are_shares_of_the_sets_nodes(name, rng):
    views = hemisphere.parse(name)
    found = triangulation.interpolate(views, directions(2000, rng))
    assert (found.weight >= 0).all()
    torch.testing.assert_close(found.weight.sum(-1), torch.ones(2000, dtype=torch.float64), **FLOAT64)
    assert found.node.min() >= 0
    assert found.node.max() < views.n_nodes


@pytest.mark.parametrize("name", SETS)
def test_nodes_are_exact(name):
    views = hemisphere.parse(name)
    found = triangulation.interpolate(views, views.directions(torch.float64))
    each = torch.zeros(len(views), views.n_nodes, dtype=torch.float64).scatter_add_(1, found.node, found.weight)
    torch.testing.assert_close(each[:, : len(views)], torch.eye(len(views), dtype=torch.float64), **FLOAT64)


def test_what_is_linear_in_the_angles_is_exact(rng):
    """Theta, and between rings of the same azimuths also phi."""
    views = hemisphere.ubo81()
    theta = torch.tensor([t for t, n in zip(views.theta_deg, views.count, strict=True) for _ in range(n)]).double()
    t = torch.rand(500, dtype=torch.float64, generator=rng) * 75
    phi = torch.rand(500, dtype=torch.float64, generator=rng) * 2 * math.pi
    found = triangulation.interpolate(views, from_angles(t.deg2rad(), phi))
    torch.testing.assert_close(blended(theta, found), t, **FLOAT64)
    grid = hemisphere.parse("rings(0: 1, 30: 8, 60: 8)")
    table = torch.cat([torch.zeros(1).double(), *[torch.arange(8).double() * math.pi / 4] * 2])
    inside = (phi < 7 * math.pi / 4) & (t > 30) & (t < 60)
    found = triangulation.interpolate(grid, from_angles(t.deg2rad(), phi))
    torch.testing.assert_close(blended(table, found)[inside], phi[inside], **FLOAT64)


@pytest.mark.parametrize("name", SETS)
def test_sweeps_through_pole_and_horizon_do_not_jump(name, rng):
    """Twice as fine a sweep has at most about half the largest step."""
    views = hemisphere.parse(name)
    table = torch.rand(views.n_nodes, dtype=torch.float64, generator=rng)
    for tilt in (0.0, 1e-3, 0.4, 1.2):
        sizes = []
        for n in (4000, 8000):
            t = torch.linspace(-1.9, 1.9, n, dtype=torch.float64)
            w = torch.stack([t.sin(), t.cos() * math.sin(tilt), t.cos() * math.cos(tilt)], -1)
            sizes.append(float(blended(table, triangulation.interpolate(views, w)).diff().abs().max()))
        assert sizes[1] <= 0.8 * sizes[0] or sizes[0] < 1e-12, tilt


def test_rings_agree_with_their_neighbours_on_both_sides(rng):
    """On a ring only its own two nodes count, from inside and from outside."""
    views = hemisphere.ubo151()
    table = torch.rand(views.n_nodes, dtype=torch.float64, generator=rng)
    phi = torch.rand(300, dtype=torch.float64, generator=rng) * 2 * math.pi
    for theta in views.theta_deg[1:]:
        sides = [from_angles(torch.full_like(phi, math.radians(theta) + d), phi) for d in (-1e-9, 1e-9)]
        inner, outer = (blended(table, triangulation.interpolate(views, w)) for w in sides)
        torch.testing.assert_close(inner, outer, rtol=0, atol=1e-7)


def test_the_pole_is_the_mean_of_the_first_ring():
    views = hemisphere.grid(12, 5, 80)
    found = triangulation.interpolate(views, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))
    assert found.node[0, found.weight[0].argmax()] == len(views)
    assert found.weight.max() == 1


def test_below_the_last_ring_its_value_is_held():
    views = hemisphere.ubo81()
    phi = torch.linspace(-3, 3, 50, dtype=torch.float64)
    table = torch.arange(81).double()
    at = [
        blended(table, triangulation.interpolate(views, from_angles(torch.full_like(phi, math.radians(t)), phi)))
        for t in (75, 80, 90, 120)
    ]
    for lower in at[1:]:
        torch.testing.assert_close(lower, at[0], **FLOAT64)


def test_directions_are_differentiable(rng):
    views = hemisphere.ubo81()
    table = torch.rand(81, dtype=torch.float64, generator=rng)
    w = from_angles(torch.tensor([0.1, 0.7, 1.2]).double(), torch.tensor([0.3, 2.0, -1.0]).double()).requires_grad_()
    assert torch.autograd.gradcheck(lambda w: blended(table, triangulation.interpolate(views, w)), w)


def test_float32_is_close(rng):
    views = hemisphere.ubo151()
    table = torch.rand(views.n_nodes, dtype=torch.float64, generator=rng)
    w = directions(2000, rng, torch.float32)
    w = w[w[:, 2] > 0]
    found, exact = triangulation.interpolate(views, w), triangulation.interpolate(views, w.double())
    torch.testing.assert_close(blended(table.float(), found).double(), blended(table, exact), rtol=0, atol=3e-5)


def test_nothing_to_interpolate():
    assert triangulation.interpolate(hemisphere.ubo81(), torch.zeros(0, 3)).node.shape == (0, 3)
