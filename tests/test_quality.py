import math

import pytest
import torch

from torchmeso import quality
from torchmeso.errors import ShapeError


def picture(rng, size=32):
    return torch.rand(size, size, 3, generator=rng)


def test_equal_pictures_are_equal(rng):
    a = picture(rng)
    got = quality.compare(a, a)
    assert got.psnr == math.inf
    assert got.ssim == pytest.approx(1)
    assert got.flip in (None, pytest.approx(0, abs=1e-6))
    assert got.max_error == 0


def test_psnr_of_a_known_error():
    assert quality.psnr(torch.zeros(10), torch.full((10,), 0.1)) == pytest.approx(20)


def test_exposure_is_set_by_the_reference(rng):
    """A firefly above the percentile does not darken the comparison; exposure scales both pictures alike."""
    a = torch.full((100, 100, 3), 0.25)
    a[0, 0] = 1000
    assert quality.find_exposure(a) == pytest.approx(4)
    b = picture(rng)
    assert quality.compare(b, 0.9 * b).psnr == pytest.approx(quality.compare(8 * b, 7.2 * b).psnr, abs=1e-3)


def test_screen_values_are_srgb():
    shown = quality.to_screen(torch.tensor([[[0.5, 0.0, 2.0]]]), 0.5)
    assert shown[0, 0].tolist() == pytest.approx([0.5370988, 0.0, 1.0], abs=1e-5)


def test_black_reference_has_exposure_one():
    assert quality.find_exposure(torch.zeros(4, 4, 3)) == 1


def test_worse_is_worse(rng):
    a = picture(rng)
    noise = torch.randn(a.shape, generator=rng)
    near, far = (quality.compare(a, (a + s * noise).clamp(min=0)) for s in (0.02, 0.2))
    assert near.psnr > far.psnr
    assert near.ssim > far.ssim
    assert near.flip is None or near.flip < far.flip


def test_iou():
    a, b = torch.zeros(4, 4, dtype=torch.bool), torch.zeros(4, 4, dtype=torch.bool)
    assert quality.iou(a, b) == 1
    a[0, :2] = True
    b[0, 1:3] = True
    assert quality.iou(a, b) == pytest.approx(1 / 3)


@pytest.mark.parametrize("shift", [0, 1, 3])
def test_boundary_distance_of_shifted_squares(shift):
    a, b = torch.zeros(40, 40, dtype=torch.bool), torch.zeros(40, 40, dtype=torch.bool)
    a[:, :20] = True
    b[:, : 20 + shift] = True
    assert quality.boundary_distance(a, b) == pytest.approx(shift, abs=1e-9)


def test_boundary_distance_of_nothing():
    empty, full = torch.zeros(5, 5, dtype=torch.bool), torch.zeros(5, 5, dtype=torch.bool)
    full[2, 2] = True
    assert quality.boundary_distance(empty, empty) == 0
    assert quality.boundary_distance(empty, full) == math.inf


def test_psnr_by_picture_finds_the_bad_one(rng):
    a = torch.rand(2, 3, 8, 8, 3, generator=rng)
    b = a.clone()
    b[1, 2] += 0.1
    got = quality.psnr_by_picture(a, b)
    assert got.shape == (2, 3)
    assert got[1, 2] < 30
    assert got[0].isinf().all()


@pytest.mark.errors
def test_pictures_that_cannot_be_compared(rng):
    with pytest.raises(ShapeError, match="expected pictures of one size, got 32 x 32 and 16 x 16"):
        quality.compare(picture(rng), picture(rng, 16))
    bad = picture(rng)
    bad[0, 0, 0] = math.nan
    with pytest.raises(ShapeError, match="expected finite values"):
        quality.compare(bad, bad)
    with pytest.raises(ShapeError, match="expected one shape"):
        quality.psnr_by_picture(torch.rand(1, 1, 4, 4, 3), torch.rand(1, 2, 4, 4, 3))
