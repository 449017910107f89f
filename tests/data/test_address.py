import torch

from tests.tolerances import FLOAT32, FLOAT64
from torchmeso.data import address


def lookup(picture, uv):
    taps = address.bilinear(uv, *picture.shape)
    return (picture.flatten()[taps.texel] * taps.weight).sum(-1)


def test_exact_at_texel_centres(rng):
    picture = torch.rand(5, 7, dtype=torch.float64, generator=rng)
    centres = address.texel_centres(5, 7, torch.float64)
    torch.testing.assert_close(lookup(picture, centres), picture, **FLOAT64)


def test_row_zero_is_at_the_top():
    assert address.texel_centres(4, 4)[0, 0].tolist() == [0.125, 0.875]
    picture = torch.zeros(4, 4)
    picture[0] = 1
    assert lookup(picture, torch.tensor([0.5, 0.875])) == 1


def test_repeats_with_period_one(rng):
    picture = torch.rand(6, 5, dtype=torch.float64, generator=rng)
    uv = torch.rand(100, 2, dtype=torch.float64, generator=rng)
    shifted = uv + torch.tensor([3.0, -2.0], dtype=torch.float64)
    torch.testing.assert_close(lookup(picture, shifted), lookup(picture, uv), **FLOAT64)


def test_far_coordinates_stay_accurate_in_float32(rng):
    picture = torch.rand(16, 16, generator=rng)
    uv = (torch.rand(100, 2, generator=rng) * 4096).round() / 4096  # exact in float32 also after the shift
    torch.testing.assert_close(lookup(picture, uv + 1000), lookup(picture, uv), **FLOAT32)


def test_continuous_across_the_border(rng):
    picture = torch.rand(8, 8, dtype=torch.float64, generator=rng)
    line = torch.linspace(-0.3, 1.3, 4001, dtype=torch.float64)
    for uv in (torch.stack([line, 0.3 + 0 * line], -1), torch.stack([0.4 + 0 * line, line], -1)):
        assert lookup(picture, uv).diff().abs().max() < 8 * 1.6 / 4000 * 1.01


def test_gradient(rng):
    picture = torch.rand(4, 4, dtype=torch.float64, generator=rng)
    uv = (torch.rand(6, 2, dtype=torch.float64, generator=rng) * 2).requires_grad_()
    assert torch.autograd.gradcheck(lambda uv: lookup(picture, uv), (uv,))
