import math

import pytest
import torch

from torchmeso.algebra import secular
from torchmeso.algebra.spherical_harmonics import basis
from torchmeso.errors import ConfigError
from torchmeso.geometry import hemisphere


def factors(degree, dtype=torch.float64):
    return secular.factorise(basis(hemisphere.ubo81().directions(dtype), degree), "ubo81")


def bisect(f, beta, energy):
    """Find lambda the slow way, from the matrices of eq. (5) in float64."""
    A, b = f.matrix.T @ f.matrix, f.matrix.T @ beta

    def c(x):
        return torch.linalg.solve(A + x * torch.eye(len(A), dtype=A.dtype), b)

    if c(0.0) @ c(0.0) <= energy:
        return c(0.0), 0.0
    low, high = 0.0, 1.0
    while c(high) @ c(high) > energy:
        high *= 2
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if c(middle) @ c(middle) > energy else (low, middle)
    return c(high), high


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_equals_bisection(degree, rng):
    """At degree 5 the normal equations of the slow way are too ill for a comparison; see the next test."""
    f = factors(degree)
    beta = torch.rand(20, 81, dtype=torch.float64, generator=rng)
    energy = 2 * math.pi * beta.square().mean(-1) * torch.logspace(-2, 1, 20, dtype=torch.float64)
    found = secular.solve(f, beta, energy)
    assert 0 < (found.multiplier > 0).sum() < 20 or degree > 2
    for k in range(20):
        c, multiplier = bisect(f, beta[k], energy[k])
        torch.testing.assert_close(found.c[k], c, rtol=1e-7, atol=1e-9)
        assert found.multiplier[k].item() == pytest.approx(multiplier, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("degree", [4, 5])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_every_vector_keeps_its_bound_and_no_less(degree, dtype, rng):
    f = factors(degree)
    beta = torch.rand(4000, 81, dtype=dtype, generator=rng) ** torch.linspace(0.2, 30, 4000, dtype=dtype)[:, None]
    energy = (
        2
        * math.pi
        * beta.square().mean(-1)
        * torch.logspace(-3, 9, 4000, dtype=dtype)[torch.randperm(4000, generator=rng)]
    )
    found = secular.solve(f, beta, energy)
    used = found.c.double().square().sum(-1)
    assert (used <= energy.double() * (1 + 1e-5)).all()
    bound = found.multiplier > 0
    assert (used[bound] >= energy.double()[bound] * (1 - 1e-5)).all()
    assert 0.3 < bound.double().mean() < 1


@pytest.mark.parametrize("degree", [4, 5])
def test_float32_is_near_float64(degree, rng):
    f = factors(degree)
    beta = torch.rand(4000, 81, generator=rng)
    energy = 2 * math.pi * beta.square().mean(-1)
    exact = secular.solve(f, beta.double(), energy.double()).c
    error = (secular.solve(f, beta, energy).c - exact).norm(dim=-1) / exact.norm(dim=-1)
    assert error.max() < 1e-4


def test_without_a_bound_it_is_least_squares(rng):
    f = factors(4)
    beta = torch.rand(5, 81, dtype=torch.float64, generator=rng)
    expected = torch.linalg.lstsq(f.matrix, beta.T).solution.T
    found = secular.solve(f, beta)
    torch.testing.assert_close(found.c, expected, rtol=1e-9, atol=1e-9)
    assert not found.multiplier.any()


def test_no_energy_leaves_nothing(rng):
    f = factors(3)
    beta = torch.rand(2, 81, generator=rng)
    beta[1] = 0
    found = secular.solve(f, beta, torch.zeros(2))
    assert torch.equal(found.c, torch.zeros(2, 16))
    assert found.multiplier.tolist() == [math.inf, 0]


def test_seven_harmonics_of_order_zero_need_seven_rings(rng):
    Y = basis(hemisphere.ubo81().directions(torch.float64), 6)
    with pytest.raises(ConfigError, match="light: ubo81: expected directions that tell 49 coefficients apart, got 81"):
        secular.factorise(Y, "light: ubo81")
    f = secular.factorise(Y, "light: ubo81", regularise=True)
    beta = torch.rand(3, 81, dtype=torch.float64, generator=rng)
    expected = torch.linalg.lstsq(Y, beta.T, rcond=1e-7, driver="gelsd").solution.T
    torch.testing.assert_close(secular.solve(f, beta).c, expected, rtol=1e-7, atol=1e-7)


def test_fewer_samples_than_coefficients_are_refused():
    w = hemisphere.grid(4, 2, 80).directions(torch.float64)
    with pytest.raises(ConfigError, match="got 8 that tell"):
        secular.factorise(basis(w, 2), "light")
    assert secular.factorise(basis(w, 2), "light", regularise=True).values.shape == (9,)
