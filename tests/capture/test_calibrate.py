import math
import sys

import pytest
import torch

from torchmeso.capture import calibrate
from torchmeso.errors import GeometryError, ShapeError

BOARD = torch.stack(torch.meshgrid(torch.arange(8.0), torch.arange(6.0), indexing="xy"), -1).view(-1, 2).double() * 25
LENS = torch.tensor([810.0, 800, 322, 237, -0.2, 0.08, 8e-4, -5e-4, 0.01], dtype=torch.float64)


def boards(rng, n=8, tilt=0.5):
    turn = (torch.rand(n, 3, generator=rng, dtype=torch.float64) - 0.5) * 2 * tilt
    place = torch.tensor([-90.0, -60, 420]) + torch.tensor([60.0, 50, 120]) * (
        torch.rand(n, 3, generator=rng, dtype=torch.float64) - 0.5
    )
    return torch.cat([turn, place], 1)


def test_clean_corners_give_the_lens_back(rng):
    seen = calibrate.project_board(BOARD, LENS, boards(rng))
    found = calibrate.calibrate(BOARD, seen, width=640, height=480)
    torch.testing.assert_close(found.cameras[0].K, calibrate.intrinsic_matrix(LENS), rtol=0, atol=1e-6)
    torch.testing.assert_close(found.cameras[0].distortion, LENS[4:], rtol=0, atol=1e-7)
    assert found.rms < 1e-8


def test_uncertainty_covers_the_errors(rng):
    clean = calibrate.project_board(BOARD, LENS, boards(rng, 10))
    noisy = clean + 0.1 * torch.randn(clean.shape, generator=rng, dtype=torch.float64)
    found = calibrate.calibrate(BOARD, noisy, width=640, height=480)
    K = found.cameras[0].K
    off = torch.stack([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *found.cameras[0].distortion]) - LENS
    assert ((off / found.sigma).abs() < 4).all() and (off / found.sigma).square().mean() > 0.05
    assert found.rms == pytest.approx(0.1 * math.sqrt(2), rel=0.1)


def test_the_optimum_is_that_of_opencv(rng):
    cv2 = pytest.importorskip("cv2")
    import numpy as np

    clean = calibrate.project_board(BOARD, LENS, boards(rng, 10))
    # OpenCV reads float32 corners: both get the same numbers.
    noisy = (clean + 0.1 * torch.randn(clean.shape, generator=rng, dtype=torch.float64)).float()
    ours = calibrate.calibrate(BOARD, noisy, width=640, height=480)
    flat = np.concatenate([BOARD.numpy(), np.zeros((len(BOARD), 1))], 1).astype(np.float32)
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 300, 1e-15)
    rms, K, *_ = cv2.calibrateCamera(
        [flat] * 10, [s.numpy() for s in noisy], (640, 480), None, None, criteria=stop
    )  # fmt: skip
    assert ours.rms == pytest.approx(rms, abs=1e-4)
    np.testing.assert_allclose(ours.cameras[0].K.numpy(), K, rtol=0, atol=1e-3)


def test_rotation_vectors_round_trip(rng):
    v = torch.randn(50, 3, generator=rng, dtype=torch.float64)
    v = v / v.norm(dim=1, keepdim=True) * torch.linspace(0, math.pi, 50).double()[:, None]
    R = calibrate.rotation(v)
    torch.testing.assert_close(calibrate.rotation(calibrate.rotation_vector(R)), R, rtol=0, atol=1e-7)


def test_laser_angle_and_plane():
    assert calibrate.laser_angle(2.0, 2.0) == pytest.approx(math.pi / 4)
    points = torch.tensor([[0.0, 0, 1], [1, 0, 1], [0, 1, 1], [3, 4, 1]], dtype=torch.float64)
    plane, rms = calibrate.fit_plane(points)
    torch.testing.assert_close(plane[:3].abs(), torch.tensor([0.0, 0, 1], dtype=torch.float64))
    assert rms < 1e-12 and (plane[:3] @ points[0] - plane[3]).abs() < 1e-12


@pytest.mark.errors
def test_boards_that_do_not_fix_a_camera_are_refused(rng):
    seen = calibrate.project_board(BOARD, LENS, boards(rng, 4, tilt=0.0))
    with pytest.raises(GeometryError, match="parallel"):
        calibrate.calibrate(BOARD, seen, width=640, height=480)
    with pytest.raises(ShapeError, match="at least 2 pictures, got 0"):
        calibrate.calibrate(BOARD, seen[:0], width=640, height=480)
    with pytest.raises(GeometryError, match="collinear"):
        calibrate.fit_plane(torch.arange(4.0)[:, None] * torch.ones(3))
    with pytest.raises(GeometryError, match="different height"):
        calibrate.laser_angle(1.0, 0.0)


def checkerboard(columns=7, rows=5, square=24, margin=30):
    y, x = torch.meshgrid(torch.arange((rows + 1) * square), torch.arange((columns + 1) * square), indexing="ij")
    dark = ((x // square + y // square) % 2 == 0).to(torch.uint8)
    return torch.nn.functional.pad(230 - 200 * dark, (margin,) * 4, value=230)


def test_corners_of_a_board_are_at_half_pixel_centres():
    pytest.importorskip("cv2")
    board, blank = checkerboard(), torch.full((174, 222), 200, dtype=torch.uint8)
    found = calibrate.find_corners([board, blank], 7, 5)
    x = 30 + 24 * torch.arange(1, 8).double()
    assert found[1].isnan().all()
    # Corners lie between pixels: at whole numbers where pixel centres are at (i + 0.5).
    torch.testing.assert_close(found[0, :, 0].view(5, 7)[0].sort().values, x, rtol=0, atol=0.1)


@pytest.mark.errors
def test_pictures_without_a_board_are_refused():
    pytest.importorskip("cv2")
    with pytest.raises(GeometryError, match="no board of 7 x 5"):
        calibrate.find_corners([torch.zeros(60, 60, dtype=torch.uint8)], 7, 5)


@pytest.mark.errors
def test_what_does_not_fix_a_camera(rng):
    with pytest.raises(ShapeError, match="at least 4 corners, got 3"):
        calibrate.calibrate(BOARD[:3], torch.zeros(2, 3, 2), width=640, height=480)
    few = BOARD[[0, 7, 40, 47] * 4]  # 24 equations for 27 numbers
    with pytest.raises(GeometryError, match="expected poses that fix the camera"):
        calibrate.calibrate(few, calibrate.project_board(few, LENS, boards(rng, 3)), width=640, height=480)
    with pytest.raises(GeometryError, match="at least 3 points, got 2"):
        calibrate.fit_plane(torch.eye(3)[:2])


@pytest.mark.errors
def test_corners_need_opencv(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(GeometryError, match=r"expected OpenCV, which is absent; install torchmeso\[rig\]"):
        calibrate.find_corners([torch.zeros(60, 60, dtype=torch.uint8)], 7, 5)
