"""Cameras: right-handed world, looking along the camera's -z, row 0 on top, pixel centres at (i + 0.5).

One linear map takes a world point to homogeneous pixel coordinates (x w, y w, w). For a perspective camera w
is the view depth, so 1/w is linear on the screen; for an orthographic camera w = 1 and the view depth itself
is. Depth stored with a pixel is t, the distance along the pixel's ray.

Test: tests/geometry/test_camera.py
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import ConfigError, check_finite, check_range, check_shape
from torchmeso.geometry.directions import normalize

Projection = Literal["perspective", "orthographic"]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Camera:
    """A pinhole or a parallel camera.

    Attributes:
        eye: (3,) world position.
        axes: (3, 3) rows right, up, back (camera x, y, z) in world space, orthonormal.
        projection: perspective or orthographic.
        fov_deg: full vertical opening angle; perspective only.
        view_height: world height of the picture; orthographic only.
        width: pixels.
        height: pixels.
        near: view depth below which nothing is drawn, world units.
        shift: where rays pass through a pixel, in pixels right and down of its centre.
    """

    eye: Float[Tensor, "3"]
    axes: Float[Tensor, "3 3"]
    projection: Projection = "perspective"
    fov_deg: float = 45.0
    view_height: float = 2.0
    width: int = 800
    height: int = 600
    near: float = 1e-3
    shift: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        """Raise ShapeError or ConfigError for values no picture can be made with."""
        check_shape("camera.eye", self.eye, (3,))
        check_shape("camera.axes", self.axes, (3, 3))
        check_range("camera.width", self.width, 1, 16384)
        check_range("camera.height", self.height, 1, 16384)
        check_range("camera.fov_deg", self.fov_deg, 1e-3, 175)
        check_finite("camera.eye", self.eye)
        check_finite("camera.axes", self.axes)
        if not (0 < self.near < math.inf and 0 < self.view_height < math.inf):
            raise ConfigError(
                f"camera: expected near and view_height > 0 and finite, got {self.near:g}, {self.view_height:g}"
            )

    @property
    def pixel_size(self) -> float:
        """Side of a pixel: at view depth 1 for a perspective camera, in world units for an orthographic one."""
        if self.projection == "perspective":
            return 2 * math.tan(math.radians(self.fov_deg) / 2) / self.height
        return self.view_height / self.height

    def project(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
        """Return (x w, y w, w, depth): homogeneous pixel coordinates, and the view depth in world units.

        Divide the first two by w for pixels (0, 0 = the top left corner of the picture).
        """
        a, b, c = (points - self.eye.to(points.dtype)).unbind(-1)
        # Products and sums one by one: kernels do the same, and corners are snapped alike to the last bit.
        x, y, back = (a * row[0] + b * row[1] + c * row[2] for row in self.axes.to(points.dtype))
        depth = -back
        w = depth if self.projection == "perspective" else torch.ones_like(depth)
        size, (right, down) = self.pixel_size, self.shift
        x, y = x / size + w * (self.width / 2 - right), -y / size + w * (self.height / 2 - down)
        return torch.stack([x, y, w, depth], -1)

    def rays(
        self, xy: Float[Tensor, "*batch 2"]
    ) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
        """Return origin, unit direction and length per unit of view depth of the rays through pixels `xy`.

        Args:
            xy: (..., 2) in pixels; the centre of pixel (column i, row j) is (i + 0.5, j + 0.5).

        Returns:
            origin (..., 3) on the plane of the eye, direction (..., 3), and stretch (...): t = depth * stretch.
        """
        size = self.pixel_size
        x = (xy[..., 0] - (self.width / 2 - self.shift[0])) * size
        y = (self.height / 2 - self.shift[1] - xy[..., 1]) * size
        right, up, back = self.axes.to(xy.dtype).unbind(0)
        offset = x.unsqueeze(-1) * right + y.unsqueeze(-1) * up
        eye = self.eye.to(xy.dtype)
        if self.projection == "orthographic":
            return eye + offset, (-back).expand_as(offset), torch.ones_like(x)
        stretch = torch.sqrt(1 + x.square() + y.square())
        return eye.expand_as(offset), (offset - back) / stretch.unsqueeze(-1), stretch

    def pixel_width(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Return how wide a pixel is at `points`, across the line of sight, in world units."""
        if self.projection == "orthographic":
            return torch.full_like(points[..., 0], self.pixel_size)
        depth = -((points - self.eye.to(points.dtype)) * self.axes[2].to(points.dtype)).sum(-1)
        return depth.clamp(min=0) * self.pixel_size

    def jittered(self, n: int) -> Iterator["Camera"]:
        """Yield n x n cameras whose rays stand in a regular grid in every pixel."""
        for row in range(n):
            for column in range(n):
                yield replace(self, shift=((column + 0.5) / n - 0.5, (row + 0.5) / n - 0.5))

    def pixel_centres(self, dtype: torch.dtype = torch.float32) -> Float[Tensor, "height width 2"]:
        """Return the (height, width, 2) centres of all pixels."""
        y = torch.arange(self.height, dtype=dtype) + 0.5
        x = torch.arange(self.width, dtype=dtype) + 0.5
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


def look_at(
    eye: Float[Tensor, "3"], at: Float[Tensor, "3"], up: Float[Tensor, "3"]
) -> tuple[Float[Tensor, "3"], Float[Tensor, "3 3"]]:
    """Return `eye` and the axes of a camera there that looks at `at` with `up` upwards in the picture.

    Raises:
        ConfigError: eye and at coincide, or up is parallel to the line of sight.
    """
    check_finite("camera (eye, at, up)", torch.stack([eye, at, up]))
    back = normalize(eye - at)
    right = torch.linalg.cross(up, back)
    if back.norm() == 0 or right.norm() < 1e-6 * up.norm():
        raise ConfigError("camera: expected eye and at to differ and up not to be parallel to the line of sight")
    right = normalize(right)
    return eye, torch.stack([right, torch.linalg.cross(back, right), back])
