import math

import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.errors import ConfigError
from torchmeso.geometry import sphere
from torchmeso.geometry.directions import from_angles, normalize
from torchmeso.geometry.sphere import SphereGrid

GRID = SphereGrid(n_theta=5, n_phi=8)


def smooth(w):
    return 1 + 0.3 * w[..., 0] - 0.2 * w[..., 1] + 0.4 * w[..., 2]


def answer(table, w):
    near = GRID.interpolate(w)
    return (sphere.with_poles(table).flatten()[near.node] * near.weight).sum(-1)


def test_exact_at_the_directions(rng):
    table = torch.rand(5, 8, generator=rng, dtype=torch.float64)
    torch.testing.assert_close(answer(table, GRID.directions(torch.float64)), table, rtol=0, atol=1e-12)


def test_weights_sum_to_one_and_poles_are_means(rng):
    w = normalize(torch.randn(1000, 3, generator=rng, dtype=torch.float64))
    near = GRID.interpolate(w)
    torch.testing.assert_close(near.weight.sum(-1), torch.ones(1000, dtype=torch.float64), **FLOAT64)
    assert (near.weight >= 0).all()
    table = torch.rand(5, 8, generator=rng, dtype=torch.float64)
    poles = torch.tensor([[0.0, 0, 1], [0, 0, -1]], dtype=torch.float64)
    torch.testing.assert_close(answer(table, poles), table[[0, 4]].mean(-1), **FLOAT64)


def test_no_jump_anywhere(rng):
    """Along great circles over both poles, the largest step halves with the step of the angle."""
    table = torch.rand(5, 8, generator=rng, dtype=torch.float64)
    jumps = []
    for steps in (2000, 4000):
        theta = torch.linspace(-math.pi, math.pi, steps, dtype=torch.float64)
        jumps.append(float(answer(table, from_angles(theta, torch.full_like(theta, 0.7))).diff().abs().max()))
    assert jumps[1] < 0.55 * jumps[0]


def test_error_falls_with_the_directions(rng):
    w = normalize(torch.randn(2000, 3, generator=rng, dtype=torch.float64))
    errors = []
    for n in (4, 8, 16):
        grid = SphereGrid(n_theta=n, n_phi=2 * n)
        near = grid.interpolate(w)
        found = (sphere.with_poles(smooth(grid.directions(torch.float64))).flatten()[near.node] * near.weight).sum(-1)
        errors.append(float((found - smooth(w)).abs().max()))
    assert errors[2] < errors[1] / 3 < errors[0] / 9


@pytest.mark.errors
def test_absurd_sets_are_refused():
    with pytest.raises(ConfigError, match=r"sphere grid: n_theta: expected a value from 2 to 512, got 1"):
        SphereGrid(n_theta=1, n_phi=8)
    with pytest.raises(ConfigError, match="n_phi"):
        SphereGrid(n_theta=4, n_phi=2)
