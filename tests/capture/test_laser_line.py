import math

import pytest
import torch
from reference import laser_line as slow

from torchmeso.capture import laser_line
from torchmeso.capture.laser_line import LineSearch
from torchmeso.errors import ConfigError, ShapeError

SIZE = 48


def stripe(intercepts, slope=0.1, sigma=1.5, peak=200.0, width=SIZE):
    """Frames that show y = intercept + slope x, integrated over nothing: point samples."""
    y, x = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    away = torch.stack([(y - i - slope * x) / math.hypot(1, slope) for i in intercepts]).double()
    return peak * torch.exp(-0.5 * (away / sigma).square())


def line_of(intercept, slope):
    n = torch.tensor([-slope, 1.0, intercept], dtype=torch.float64)
    return n / n[:2].norm()


ALL = torch.ones(SIZE, SIZE, dtype=torch.bool)


def test_line_of_a_clean_stripe_is_exact_with_the_gaussian_peak():
    found = laser_line.measure(stripe([10.3, 20.77]), ALL)
    torch.testing.assert_close(found.line[1], line_of(20.77, 0.1), rtol=0, atol=2e-3)
    assert found.rms.max() < 0.02 and found.count.min() > 40


def test_peaks_are_those_of_the_plain_loop(rng):
    frame = stripe([17.4]) + 2 * torch.rand(1, SIZE, SIZE, generator=rng, dtype=torch.float64)
    region = ALL.clone()
    region[:, 20:30] = False
    xy, valid = laser_line.peaks(frame, region, LineSearch())
    wanted = slow.column_peaks(frame[0].tolist(), region.tolist(), 1.0, 30.0)
    torch.testing.assert_close(xy[0][valid[0]], torch.tensor(wanted, dtype=torch.float64), rtol=0, atol=1e-9)


@pytest.mark.parametrize("peak", ["parabola", "centroid", "gaussian"])
def test_peaks_in_camera_noise_of_30_db(peak, rng):
    clean = stripe([11.0, 17.4, 23.8, 30.1])
    noisy = clean + 200 * 10 ** (-30 / 20) * torch.randn(clean.shape, generator=rng, dtype=torch.float64)
    xy, valid = laser_line.peaks(noisy, ALL, LineSearch(peak=peak))
    truth = torch.tensor([[11.0], [17.4], [23.8], [30.1]]) + 0.1 * xy[..., 0]
    inside = valid & (truth > 6) & (truth < SIZE - 6)
    rms = (xy[..., 1] - truth)[inside].square().mean().sqrt()
    assert rms < {"parabola": 0.05, "centroid": 0.06, "gaussian": 0.05}[peak]


def test_outliers_do_not_move_the_line(rng):
    frames = stripe([20.0], slope=-0.05)
    frames[0, 5:9, 10:22] = 255  # a glint
    found = laser_line.measure(frames, ALL)
    torch.testing.assert_close(found.line[0], line_of(20.0, -0.05), rtol=0, atol=0.02)
    assert 25 < found.count[0] < 45


def test_stripes_that_move_sideways():
    found = laser_line.measure(stripe([20.0]).mT.contiguous(), ALL, LineSearch(across="x"))
    torch.testing.assert_close(found.line[0], line_of(20.0, 0.1)[[1, 0, 2]], rtol=0, atol=2e-3)


def test_empty_and_dark_frames_have_no_line():
    frames = torch.cat([torch.zeros(1, SIZE, SIZE), stripe([20.0]).float(), stripe([20.0], peak=10).float()])
    found = laser_line.measure(frames.to(torch.uint8), ALL)
    assert found.found.tolist() == [False, True, False]
    assert laser_line.measure(frames[:0], ALL).line.shape == (0, 3)


def test_saturated_stripe_keeps_its_place():
    found = laser_line.measure(stripe([20.3], peak=900).clamp(max=255), ALL, LineSearch(peak="centroid"))
    torch.testing.assert_close(found.line[0], line_of(20.3, 0.1), rtol=0, atol=0.05)


def test_blocks_make_no_difference(monkeypatch):
    frames = stripe([10.0 + i for i in range(7)])
    whole = laser_line.measure(frames, ALL).line
    monkeypatch.setattr(laser_line, "BLOCK_BYTES", 2 * 4 * SIZE * SIZE)
    torch.testing.assert_close(laser_line.measure(frames, ALL).line, whole)


@pytest.mark.errors
def test_what_cannot_be_searched_is_refused():
    with pytest.raises(ConfigError, match="only the turntable"):
        laser_line.measure(torch.zeros(1, 4, 4), torch.zeros(4, 4, dtype=torch.bool))
    with pytest.raises(ShapeError, match="region"):
        laser_line.measure(torch.zeros(1, 4, 4), torch.zeros(4, 5, dtype=torch.bool))
    with pytest.raises(ConfigError, match=r"line\.across"):
        LineSearch(across="z")
    with pytest.raises(ConfigError, match=r"line\.peak"):
        LineSearch(peak="best")
