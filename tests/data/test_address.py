import pytest
import torch

from tests.tolerances import FLOAT32, FLOAT64
from torchmeso.data import address
from torchmeso.data.quilting_map import QuiltingMap


def lookup(picture, uv, quilting=None):
    taps = address.bilinear(uv, *picture.shape, quilting)
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


def quilted(rng, size=(7, 9), source=(6, 4)):
    index = torch.randint(0, source[0] * source[1], size, generator=rng, dtype=torch.int32)
    return QuiltingMap(index=index, source=source, tileable=True)


@pytest.mark.parametrize("size", [(6, 4), (12, 8), (18, 4), (24, 16), (3, 2), (1, 1), (4, 3)])
def test_a_map_that_changes_nothing_changes_nothing(size, rng):
    same = QuiltingMap(index=torch.arange(24, dtype=torch.int32).reshape(6, 4), source=(6, 4))
    picture = torch.rand(*size, dtype=torch.float64, generator=rng)
    uv = 6 * torch.rand(300, 2, dtype=torch.float64, generator=rng) - 3
    torch.testing.assert_close(lookup(picture, uv, same), lookup(picture, uv), **FLOAT64)


@pytest.mark.parametrize("finer", [1, 2, 3, 4])
def test_a_quilted_picture_is_that_of_the_texels_the_map_names(finer, rng):
    quilting = quilted(rng)
    picture = torch.rand(6 * finer, 4 * finer, dtype=torch.float64, generator=rng)
    blocks = picture.reshape(6, finer, 4, finer).movedim(1, 2)  # of each texel of the exemplar
    whole = quilting.apply(blocks).movedim(2, 1).reshape(7 * finer, 9 * finer)
    uv = 9 * torch.rand(500, 2, dtype=torch.float64, generator=rng) - 4
    periods = torch.tensor(quilting.periods, dtype=torch.float64)
    torch.testing.assert_close(lookup(picture, uv, quilting), lookup(whole, uv / periods), **FLOAT64)


def at_level(picture, uv, quilting):
    taps = address.of_level(uv, *picture.shape, 1, quilting)
    return (picture.flatten()[taps.texel] * taps.weight).sum(-1)


@pytest.mark.parametrize("shift", [(0, 0), (1, 0), (3, 2)])
def test_inside_a_patch_a_level_is_read_where_the_patch_came_from(shift, rng):
    row, column = torch.meshgrid(torch.arange(12), torch.arange(16), indexing="ij")
    index = (row + shift[0]) * 20 + column + shift[1]
    quilting = QuiltingMap(index=index.int(), source=(18, 20))
    picture = torch.rand(9, 10, dtype=torch.float64, generator=rng)
    # Two texels from the map's border and more: there the patch ends.
    y, x = (2 + (n - 4) * torch.rand(200, dtype=torch.float64, generator=rng) for n in (12, 16))
    uv = torch.stack([x / 20, (12 - y) / 18], -1)
    there = torch.stack([(x + shift[1]) / 20, 1 - (y + shift[0]) / 18], -1)
    torch.testing.assert_close(at_level(picture, uv, quilting), lookup(picture, there), **FLOAT64)


def test_levels_are_continuous_across_seams_and_the_border(rng):
    quilting = quilted(rng, size=(8, 12))
    picture = torch.rand(3, 2, dtype=torch.float64, generator=rng)
    line = torch.linspace(-3, 3, 40001, dtype=torch.float64)
    for uv in (torch.stack([line, 0.3 + 0 * line], -1), torch.stack([0.4 + 0 * line, line], -1)):
        assert at_level(picture, uv, quilting).diff().abs().max() < 2 * 3 * 6 / 40000 * 1.01
    taps = address.of_level(torch.rand(50, 2, generator=rng), 3, 2, 1, quilting)
    torch.testing.assert_close(taps.weight.sum(-1), torch.ones(50), **FLOAT32)
    assert taps.texel.shape == (50, 16) and taps.texel.min() >= 0 and taps.texel.max() < 6


@pytest.mark.parametrize("size", [(6, 4), (24, 16)])
def test_a_quilted_texture_repeats_after_its_periods_without_a_jump(size, rng):
    quilting = quilted(rng)
    picture = torch.rand(*size, dtype=torch.float64, generator=rng)
    uv = torch.rand(100, 2, dtype=torch.float64, generator=rng)
    turned = uv + torch.tensor([2.0, -3.0]) * torch.tensor(quilting.periods, dtype=torch.float64)
    torch.testing.assert_close(lookup(picture, turned, quilting), lookup(picture, uv, quilting), rtol=1e-9, atol=1e-9)
    line = torch.linspace(-3, 3, 40001, dtype=torch.float64)
    for uv in (torch.stack([line, 0.3 + 0 * line], -1), torch.stack([0.4 + 0 * line, line], -1)):
        assert lookup(picture, uv, quilting).diff().abs().max() < max(size) * 6 / 40000 * 1.01


def test_a_map_smaller_than_a_texel_stays_inside_of_the_table(rng):
    quilting = QuiltingMap(index=torch.zeros(1, 1, dtype=torch.int32), source=(64, 64))
    for size in (1, 2, 64, 256):
        taps = address.bilinear(torch.rand(50, 2, generator=rng), size, size, quilting)
        assert taps.texel.min() >= 0 and taps.texel.max() < size * size


def test_gradient_through_a_map(rng):
    picture, quilting = torch.rand(6, 4, dtype=torch.float64, generator=rng), quilted(rng)
    uv = (torch.rand(6, 2, dtype=torch.float64, generator=rng) * 2).requires_grad_()
    assert torch.autograd.gradcheck(lambda uv: lookup(picture, uv, quilting), (uv,))
