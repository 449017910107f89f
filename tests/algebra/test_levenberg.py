import pytest
import torch

from torchmeso.algebra import levenberg
from torchmeso.errors import ShapeError


def rosenbrock(x):
    return torch.stack([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def test_the_bottom_of_a_bent_valley():
    found = levenberg.minimise(rosenbrock, torch.tensor([-1.2, 1.0], dtype=torch.float64))
    torch.testing.assert_close(found.x, torch.ones(2, dtype=torch.float64))


def test_covariance_is_that_of_linear_regression(rng):
    A = torch.randn(200, 3, generator=rng, dtype=torch.float64)
    b = A @ torch.tensor([1.0, -2, 3], dtype=torch.float64) + torch.randn(200, generator=rng, dtype=torch.float64)
    found = levenberg.minimise(lambda x: A @ x - b, torch.zeros(3, dtype=torch.float64))
    s2 = found.residuals.square().sum() / 197
    torch.testing.assert_close(found.x, torch.linalg.lstsq(A, b).solution)
    torch.testing.assert_close(found.covariance, s2 * torch.linalg.inv(A.T @ A))


def test_what_is_not_fixed_has_infinite_covariance():
    def of_the_sum(x):
        return torch.stack([x.sum() - 1, 2 * x.sum() - 2, x.sum()])

    found = levenberg.minimise(of_the_sum, torch.zeros(2, dtype=torch.float64), max_steps=30)
    assert found.covariance.isinf().all()
    assert found.x.sum() == pytest.approx(5 / 6, abs=1e-6)


@pytest.mark.errors
def test_impossible_starts_are_refused():
    with pytest.raises(ShapeError, match="at least as many"):
        levenberg.minimise(lambda x: x[:1], torch.zeros(2, dtype=torch.float64))
    with pytest.raises(ShapeError, match="finite values at the start"):
        levenberg.minimise(lambda x: x / 0, torch.ones(2, dtype=torch.float64))
