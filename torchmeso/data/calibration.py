"""Calibrated cameras: where a point of the rig is seen, and along which ray a pixel looks.

With X = R p + t in the camera (x right, y down, z forward), m = (X / Z, Y / Z) and r^2 = |m|^2,

    m' = m (1 + k1 r^2 + k2 r^4 + k3 r^6) + (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y)
    pixel = (fx m'_x + skew m'_y + cx, fy m'_y + cy)

which is the radial and tangential distortion of brown1966decentering with the names of zhang2000flexible's usual
implementations. Pixel centres are at (i + 0.5); calibrations that put them at i have cx and cy less by a half.

Test: tests/data/test_calibration.py
"""

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data.store import reading, replacing
from torchmeso.errors import ConfigError, FormatError, check_finite, check_range, check_shape

NEWTON_STEPS = 8
"""Steps to undo distortion; the error squares with each, and lenses that need more fold their picture over."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class CalibratedCamera:
    """A pinhole camera with lens distortion, at its place in the rig.

    Attributes:
        K: (3, 3) float64 intrinsic matrix in pixels.
        distortion: (5,) float64 k1, k2, p1, p2, k3, unitless.
        R: (3, 3) float64 rotation from the rig's frame to the camera's.
        t: (3,) float64 the rig's origin in the camera's frame, in the rig's unit of length.
        width: pixels.
        height: pixels.
    """

    K: Float[Tensor, "3 3"]
    distortion: Float[Tensor, "5"]
    R: Float[Tensor, "3 3"]
    t: Float[Tensor, "3"]
    width: int
    height: int

    def __post_init__(self) -> None:
        """Raise ShapeError or ConfigError for values no camera has."""
        for name, value, shape in (
            ("K", self.K, (3, 3)),
            ("distortion", self.distortion, (5,)),
            ("R", self.R, (3, 3)),
            ("t", self.t, (3,)),
        ):
            check_shape(f"camera.{name}", value, shape)
            check_finite(f"camera.{name}", value)
        check_range("camera.width", self.width, 1, 65536)
        check_range("camera.height", self.height, 1, 65536)
        if float(self.K[0, 0]) <= 0 or float(self.K[1, 1]) <= 0:
            raise ConfigError(
                f"camera.K: expected focal lengths > 0, got {float(self.K[0, 0]):g}, {float(self.K[1, 1]):g}"
            )
        off = float((self.R @ self.R.T - torch.eye(3, dtype=self.R.dtype)).abs().max())
        if off > 1e-6:
            raise ConfigError(f"camera.R: expected a rotation, got rows off orthonormal by {off:.2g}")

    @property
    def position(self) -> Float[Tensor, "3"]:
        """The centre of projection in the rig's frame."""
        return -self.R.T @ self.t

    def project(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Return the pixels where `points` of the rig are seen; NaN behind the camera."""
        seen = points @ self.R.T.to(points) + self.t.to(points)
        z = seen[..., 2:]
        pixels = to_pixels(distort(seen[..., :2] / z, self.distortion.to(points)), self.K.to(points))
        return torch.where(z > 0, pixels, torch.nan)

    def rays(self, xy: Float[Tensor, "*batch 2"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "*batch 3"]]:
        """Return the centre of projection and the unit directions, away from the camera, of the pixels `xy`."""
        plane = undistort(from_pixels(xy, self.K.to(xy)), self.distortion.to(xy))
        seen = torch.cat([plane, torch.ones_like(plane[..., :1])], -1)
        direction = seen @ self.R.to(xy)
        return self.position.to(xy), direction / direction.norm(dim=-1, keepdim=True)

    def pixel_centres(self, dtype: torch.dtype = torch.float32) -> Float[Tensor, "height width 2"]:
        """Return the (height, width, 2) centres of all pixels."""
        x = torch.arange(self.width, dtype=dtype) + 0.5
        y = torch.arange(self.height, dtype=dtype) + 0.5
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


def to_pixels(m: Float[Tensor, "*batch 2"], K: Float[Tensor, "3 3"]) -> Float[Tensor, "*batch 2"]:
    """Return the pixels of points `m` of the plane at distance 1."""
    return m @ K[:2, :2].T + K[:2, 2]


def from_pixels(xy: Float[Tensor, "*batch 2"], K: Float[Tensor, "3 3"]) -> Float[Tensor, "*batch 2"]:
    """Return the points of the plane at distance 1 that pixels `xy` show; the inverse of `to_pixels`."""
    y = (xy[..., 1] - K[1, 2]) / K[1, 1]
    return torch.stack([(xy[..., 0] - K[0, 2] - K[0, 1] * y) / K[0, 0], y], -1)


def distort(m: Float[Tensor, "*batch 2"], k: Float[Tensor, "5"]) -> Float[Tensor, "*batch 2"]:
    """Return where the lens shows the points `m` of the plane at distance 1; differentiable in both."""
    k1, k2, p1, p2, k3 = k.unbind(-1)
    x, y = m.unbind(-1)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return torch.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y], -1
    )


def undistort(seen: Float[Tensor, "*batch 2"], k: Float[Tensor, "5"]) -> Float[Tensor, "*batch 2"]:
    """Return the points m with distort(m) = `seen`, by Newton's method from `seen`."""
    if not bool(k.any()):
        return seen
    k1, k2, p1, p2, k3 = k.unbind(-1)
    m = seen
    for _ in range(NEWTON_STEPS):
        x, y = m.unbind(-1)
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))  # d radial / d r2, times d r2 / dx = 2 x
        xx = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
        xy = slope * x * y + 2 * p1 * x + 2 * p2 * y  # both mixed derivatives
        yy = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
        dx, dy = (seen - distort(m, k)).unbind(-1)
        step = torch.stack([yy * dx - xy * dy, xx * dy - xy * dx], -1) / (xx * yy - xy * xy).unsqueeze(-1)
        m = m + step
        if float(step.abs().max()) < 1e-15:
            break
    return m


def save(cameras: list[CalibratedCamera], path: str | Path) -> None:
    """Write `cameras` as JSON, whole or not at all."""
    fields = ("K", "distortion", "R", "t")
    content = [{**{f: getattr(c, f).tolist() for f in fields}, "width": c.width, "height": c.height} for c in cameras]
    with replacing(path) as beside:
        beside.write_text(json.dumps({"kind": "cameras", "cameras": content}, indent=1) + "\n", encoding="utf-8")


def load(path: str | Path) -> list[CalibratedCamera]:
    """Return the cameras of a JSON file.

    Raises:
        FormatError: the file is missing, damaged or of another kind.
    """
    with reading(path):
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        if not isinstance(content, dict) or content.get("kind") != "cameras":
            raise FormatError(f"{path}: expected calibrated cameras, got another kind of file")
        return [
            CalibratedCamera(
                **{f: torch.tensor(c[f], dtype=torch.float64) for f in ("K", "distortion", "R", "t")},
                width=c["width"],
                height=c["height"],
            )
            for c in content["cameras"]
        ]
