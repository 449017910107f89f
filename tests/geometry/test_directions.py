import math

import torch

from tests.tolerances import FLOAT64
from torchmeso.geometry.directions import from_angles, normalize, to_angles


def test_axes():
    theta = torch.tensor([0.0, math.pi / 2, math.pi / 2], dtype=torch.float64)
    phi = torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64)
    expected = torch.tensor([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    torch.testing.assert_close(from_angles(theta, phi), expected, **FLOAT64)


def test_angles_invert(rng):
    w = normalize(torch.randn(1000, 3, dtype=torch.float64, generator=rng))
    torch.testing.assert_close(from_angles(*to_angles(w)), w, **FLOAT64)


def test_gradient_is_finite_at_the_pole():
    w = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], requires_grad=True)
    theta, phi = to_angles(w)
    assert theta.tolist() == [0.0, math.pi] or torch.allclose(theta, torch.tensor([0.0, math.pi]))
    (theta.sum() + phi.sum()).backward()
    assert torch.isfinite(w.grad).all()


def test_zero_vector_stays_zero():
    assert normalize(torch.zeros(2, 3)).abs().sum() == 0
