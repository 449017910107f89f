import math

import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.errors import ConfigError
from torchmeso.geometry.camera import Camera, look_at


def camera(projection, **options):
    eye, axes = look_at(*torch.tensor([[1.0, 2.0, 5.0], [0.2, 0.1, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64))
    return Camera(eye=eye, axes=axes, projection=projection, width=64, height=48, **options)


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_rays_and_projection_invert_each_other(projection, rng):
    view = camera(projection)
    xy = torch.rand(100, 2, dtype=torch.float64, generator=rng) * 60
    origin, direction, stretch = view.rays(xy)
    t = 1 + torch.rand(100, dtype=torch.float64, generator=rng)
    x, y, w, depth = view.project(origin + t[:, None] * direction).unbind(-1)
    torch.testing.assert_close(torch.stack([x / w, y / w], -1), xy, **FLOAT64)
    torch.testing.assert_close(depth * stretch, t, **FLOAT64)


def test_point_looked_at_is_in_the_middle():
    x, y, w, _ = camera("perspective").project(torch.tensor([0.2, 0.1, 0.0], dtype=torch.float64))
    torch.testing.assert_close(torch.stack([x / w, y / w]), torch.tensor([32.0, 24.0], dtype=torch.float64), **FLOAT64)


def test_row_zero_is_the_top():
    view = camera("perspective")
    above = view.eye - view.axes[2] * 4 + 0.1 * view.axes[1]
    _, y, w, _ = view.project(above)
    assert y / w < view.height / 2


def test_vertical_field_of_view():
    view = camera("perspective", fov_deg=60.0)
    edge = view.eye - view.axes[2] + math.tan(math.radians(30)) * view.axes[1]
    _, y, w, _ = view.project(edge)
    assert float(y / w) == pytest.approx(0, abs=1e-9)


def test_orthographic_height():
    view = camera("orthographic", view_height=3.0)
    _, y, w, _ = view.project(view.eye - view.axes[2] + 1.5 * view.axes[1])
    assert float(y / w) == pytest.approx(0, abs=1e-9)


def test_pixel_centres():
    centres = camera("perspective").pixel_centres()
    assert centres.shape == (48, 64, 2)
    assert centres[3, 7].tolist() == [7.5, 3.5]


@pytest.mark.errors
def test_bad_cameras_are_refused():
    with pytest.raises(ConfigError, match="up not to be parallel"):
        look_at(*torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    with pytest.raises(ConfigError, match="near and view_height > 0"):
        camera("perspective", near=0.0)
    with pytest.raises(ConfigError, match="fov_deg: expected a value from"):
        camera("perspective", fov_deg=180.0)


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_a_shifted_camera_sees_the_places_beside_the_centres(projection, rng):
    plain, shifted = camera(projection), camera(projection, shift=(0.25, -0.4))
    xy = torch.rand(50, 2, dtype=torch.float64, generator=rng) * 40
    for a, b in zip(shifted.rays(xy), plain.rays(xy + torch.tensor([0.25, -0.4], dtype=torch.float64)), strict=True):
        torch.testing.assert_close(a, b, **FLOAT64)
    points = torch.randn(50, 3, dtype=torch.float64, generator=rng) * 0.3
    a, b = shifted.project(points), plain.project(points)
    places = [x[:, :2] / x[:, 2:3] for x in (a, b)]
    torch.testing.assert_close(places[0] + torch.tensor([0.25, -0.4], dtype=torch.float64), places[1], **FLOAT64)


def test_jittered_cameras_fill_a_pixel_evenly():
    shifts = [c.shift for c in camera("perspective").jittered(4)]
    assert len(set(shifts)) == 16
    for axis in (0, 1):
        assert sorted({s[axis] for s in shifts}) == [-0.375, -0.125, 0.125, 0.375]


def test_width_of_a_pixel(rng):
    """What lies a pixel apart on the screen lies so far apart across the line of sight."""
    view = camera("perspective")
    points = view.eye - 3.0 * view.axes[2] + 0.2 * torch.randn(20, 3, dtype=torch.float64, generator=rng)
    width = view.pixel_width(points)
    a, b = view.project(points), view.project(points + width[:, None] * view.axes[0])
    torch.testing.assert_close(b[:, 0] / b[:, 2] - a[:, 0] / a[:, 2], torch.ones(20, dtype=torch.float64), **FLOAT64)
    flat = camera("orthographic", view_height=2.0)
    assert (flat.pixel_width(points) == 2.0 / 48).all()
