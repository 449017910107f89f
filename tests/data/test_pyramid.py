import math

import pytest
import torch

from torchmeso.data import address, pyramid
from torchmeso.geometry.directions import normalize


def uniform(shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("size", [8, 7, 6, 5, 3, 2, 1])
def test_a_texel_of_a_level_is_the_mean_of_what_it_covers(size):
    """Against texels cut into pieces so small that every coarse texel holds a whole number of them."""
    x, half = uniform((3, size)), max(size // 2, 1)
    pieces = x.repeat_interleave(half, 1)  # size * half pieces: `size` to each of the coarse texels
    torch.testing.assert_close(pyramid.halve(x, 1), pieces.reshape(3, half, size).mean(-1))


@pytest.mark.parametrize("shape", [(8, 8), (12, 20), (5, 7), (1, 6)])
def test_every_level_has_the_same_mean(shape):
    levels = pyramid.build(uniform((2, *shape, 3)), 1)
    assert levels[-1].shape[1:3] == (1, 1)
    for level in levels:
        torch.testing.assert_close(level.mean((1, 2)), levels[0].mean((1, 2)))


def test_codes_are_rounded_once():
    codes = torch.randint(0, 256, (2, 16, 16, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    levels = pyramid.build(codes, 1)
    assert all(level.dtype == torch.uint8 for level in levels)
    exact = codes.double().mean((1, 2))
    assert (levels[-1][:, 0, 0].double() - exact).abs().max() <= 0.5 + 1e-4


def test_a_footprint_is_longer_by_one_over_cosine():
    wo = normalize(torch.tensor([[0.0, 0.0, 1.0], [3.0, 4.0, 5.0], [0.0, 1.0, 0.0]], dtype=torch.float64))
    seen = pyramid.footprint(wo, torch.full((3,), 0.1, dtype=torch.float64))
    torch.testing.assert_close(seen.along[0].norm(), torch.tensor(0.1, dtype=torch.float64))
    torch.testing.assert_close(seen.along[1], 0.1 * math.sqrt(2) * torch.tensor([0.6, 0.8], dtype=torch.float64))
    assert seen.along[2].isfinite().all()


def looks(width, theta_deg=0.0, texels=64, levels=7):
    theta = torch.deg2rad(torch.as_tensor(theta_deg, dtype=torch.float64)).expand(len(width))
    wo = torch.stack([theta.sin(), torch.zeros_like(theta), theta.cos()], -1)
    seen = pyramid.footprint(wo, width / texels)
    return pyramid.probes(torch.zeros(len(width), 2, dtype=torch.float64), seen, texels, levels)


def test_weights_sum_to_one_and_levels_exist():
    width = torch.logspace(-3, 3, 500, dtype=torch.float64)
    for theta in (0, 30, 60, 80, 89, 90):
        found = looks(width, theta)
        torch.testing.assert_close(sum(p.weight for p in found), torch.ones_like(width))
        for p in found:
            assert ((p.level >= 0) & (p.level < 7)).all()
            assert (p.weight >= 0).all()


def test_what_is_near_is_read_once_in_the_texture_itself():
    (probe,) = looks(torch.linspace(0.01, 1.0, 50, dtype=torch.float64))
    assert (probe.level == 0).all()
    assert (probe.uv == 0).all()


def test_the_level_grows_smoothly_with_the_distance():
    width = torch.logspace(-1, 2, 4000, base=2 * math.pi, dtype=torch.float64)
    level = sum(p.level * p.weight for p in looks(width))
    assert (level.diff() >= -1e-9).all()
    assert level.diff().max() < 0.1  # a step of 1 / 4000 of the range; a jump would be 1
    assert level[-1] > 3


def test_a_grazing_view_reads_along_the_texture():
    """At 80.4 degrees a pixel is six times as long as wide: two places, all within it, around its centre."""
    found = [p for p in looks(torch.full((1,), 4.0, dtype=torch.float64), 80.406) if p.weight[0] > 0]
    places = sorted({round(float(p.uv[0, 0]) * 64, 3) for p in found})
    assert places == pytest.approx([-6, 6], abs=0.05)
    assert all(p.uv[0, 1] == 0 for p in found)


def test_filtered_noise_is_as_even_as_the_mean_over_a_pixel():
    """Over a picture of noise, a pixel of n x n texels varies by about 1 / n of the noise, not by all of it."""
    levels = pyramid.build(uniform((64, 64), 3), 0)
    centre = uniform((4000, 2), 4)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(4000, 3)
    for n in (2.0, 4.0, 8.0):
        seen = pyramid.footprint(up, torch.full((4000,), n / 64, dtype=torch.float64))
        value = torch.zeros(4000, dtype=torch.float64)
        for p in pyramid.probes(centre, seen, 64, len(levels)):
            for l in p.level.unique().tolist():
                which = p.level == l
                taps = address.bilinear(p.uv[which], *levels[l].shape)
                value[which] += p.weight[which] * (levels[l].flatten()[taps.texel] * taps.weight).sum(-1)
        spread = float(value.std() / levels[0].std())
        assert 0.5 / n < spread < 1.6 / n
