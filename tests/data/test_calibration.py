import math
from dataclasses import replace

import pytest
import torch

from torchmeso.data import calibration
from torchmeso.data.calibration import CalibratedCamera
from torchmeso.errors import ConfigError, FormatError


@pytest.fixture
def camera():
    angle = math.radians(150)
    c, s = math.cos(angle), math.sin(angle)
    return CalibratedCamera(
        K=torch.tensor([[800.0, 0.5, 330.0], [0, 790, 236], [0, 0, 1]], dtype=torch.float64),
        distortion=torch.tensor([-0.25, 0.12, 1e-3, -7e-4, -0.02], dtype=torch.float64),
        R=torch.tensor([[1, 0, 0], [0, c, -s], [0, s, c]], dtype=torch.float64),
        t=torch.tensor([3.0, -2, 500], dtype=torch.float64),
        width=640,
        height=480,
    )


def test_rays_pass_through_what_their_pixel_shows(camera, rng):
    points = (torch.rand(200, 3, generator=rng, dtype=torch.float64) - 0.5) * 200
    pixels = camera.project(points)
    origin, direction = camera.rays(pixels)
    along = ((points - origin) * direction).sum(-1, keepdim=True)
    torch.testing.assert_close(origin + along * direction, points, rtol=0, atol=1e-9)


def test_the_formula_of_the_lens_by_hand():
    k = torch.tensor([0.1, 0.01, 0.002, 0.003, 0.001], dtype=torch.float64)
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 + 0.1 * r2 + 0.01 * r2**2 + 0.001 * r2**3
    wanted = [x * radial + 2 * 0.002 * x * y + 0.003 * (r2 + 2 * x * x), 0.0]
    wanted[1] = y * radial + 0.002 * (r2 + 2 * y * y) + 2 * 0.003 * x * y
    found = calibration.distort(torch.tensor([x, y], dtype=torch.float64), k)
    torch.testing.assert_close(found, torch.tensor(wanted, dtype=torch.float64))


def test_points_behind_the_camera_are_seen_nowhere(camera):
    behind = camera.position - 10 * camera.R[2]
    assert camera.project(behind).isnan().all()


def test_files_keep_every_bit(camera, tmp_path):
    calibration.save([camera], tmp_path / "cameras.json")
    (found,) = calibration.load(tmp_path / "cameras.json")
    for name in ("K", "distortion", "R", "t"):
        assert torch.equal(getattr(found, name), getattr(camera, name))


@pytest.mark.errors
def test_impossible_cameras_are_refused(camera, tmp_path):
    with pytest.raises(ConfigError, match="expected a rotation"):
        replace(camera, R=2 * camera.R)
    with pytest.raises(ConfigError, match="focal lengths"):
        replace(camera, K=-camera.K)
    (tmp_path / "x.json").write_text("[]")
    with pytest.raises(FormatError, match="expected calibrated cameras"):
        calibration.load(tmp_path / "x.json")
