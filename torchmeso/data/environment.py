"""Distant light: radiance over the whole sphere of directions, from a picture of it.

A picture is a map of latitude and longitude (2 : 1), or a cube map: a cross (4 : 3 or 3 : 4) or a strip of six faces
(6 : 1 or 1 : 6) +x, -x, +y, -y, +z, -z, each as seen from within. Either way +y is up, and the middle of a lat-long map
and the face -z lie straight ahead of a camera that has not been turned. Texels are kept as they are given, with their
exact solid angles: nothing is resampled, so no energy is lost.

The world sees the map turned by `rotation` and brighter by `exposure` stops.

Test: tests/data/test_environment.py
"""

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra import spherical_harmonics
from torchmeso.data import image
from torchmeso.errors import ConfigError, FormatError, ShapeError, check_finite, check_range, check_shape
from torchmeso.geometry import cube_map

Layout = Literal["lat_long", "cube"]

MOST_RADIANCE = 1e12
"""Of a texel; larger values are those of a damaged file."""

MOST_ROWS = 2048
"""Of a lat-long map as it is used: what has more is averaged, weighted by solid angle."""

LUMINANCE = (0.2126, 0.7152, 0.0722)
"""Of linear RGB (ITU-R BT.709)."""

FACES = {
    (1, 6): [(0, 0), (0, 1), (0, 2), (0, 3), (0, 4), (0, 5)],
    (6, 1): [(0, 0), (1, 0), (2, 0), (3, 0), (4, 0), (5, 0)],
    (3, 4): [(1, 2), (1, 0), (0, 1), (2, 1), (1, 1), (1, 3)],
    (4, 3): [(1, 2), (1, 0), (0, 1), (2, 1), (1, 1), (3, 1)],
}
"""Row and column of the faces in pictures of (rows, columns) of them; in the upright cross the last one is turned."""

AXES = (
    ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    ((-1, 0, 0), (0, 0, 1), (0, 1, 0)),
    ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
    ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    ((0, 0, -1), (-1, 0, 0), (0, 1, 0)),
)
"""Of each face: outward, to the right and up, as OpenGL lays cube maps out."""


class Texels(NamedTuple):
    """An environment as the world sees it, texel by texel.

    Attributes:
        directions: (n, 3) unit, world, through the middle of each texel.
        solid_angle: (n), 4 pi in all.
        radiance: (n, 3) linear RGB.
    """

    directions: Float[Tensor, "n 3"]
    solid_angle: Float[Tensor, "n"]
    radiance: Float[Tensor, "n 3"]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Environment:
    """Radiance that arrives from infinity.

    Attributes:
        radiance: (H, W, 3) linear RGB of a lat-long map, row 0 straight up; (6, n, n, 3) of a cube map.
        layout: how directions lie in it.
        rotation: (3, 3) turns directions of the map into the world's.
        exposure: stops; radiance counts 2^exposure times.
    """

    radiance: Float[Tensor, "*texels 3"]
    layout: Layout = "lat_long"
    rotation: Float[Tensor, "3 3"]
    exposure: float = 0.0

    def __post_init__(self) -> None:
        """Raise ShapeError or ConfigError unless there is a map, of values that mean light."""
        if self.layout not in get_args(Layout):
            raise ConfigError(f"environment.layout: expected lat_long or cube, got '{self.layout}'")
        side = self.radiance.shape[1] if self.radiance.ndim == 4 else -1
        check_shape("environment", self.radiance, (-1, -1, 3) if self.layout == "lat_long" else (6, side, side, 3))
        if not self.radiance.numel():
            raise ShapeError("environment: expected at least one texel, got none")
        check_finite("environment", self.radiance, 0, MOST_RADIANCE)
        check_shape("environment.rotation", self.rotation, (3, 3))
        off = (self.rotation.double() @ self.rotation.double().mT - torch.eye(3)).abs()
        check_finite("environment.rotation (orthonormal)", off, 0, 1e-4)
        check_range("environment.exposure", self.exposure, -40, 40)

    def texels(self) -> Texels:
        """Return directions, solid angles and radiances in the world, float64."""
        w, solid_angle = (
            _lat_long(*self.radiance.shape[:2]) if self.layout == "lat_long" else _cube(len(self.radiance[0]))
        )
        radiance = self.radiance.double().reshape(-1, 3) * 2.0**self.exposure
        return Texels(w @ self.rotation.double().mT, solid_angle, radiance)

    def irradiance(self) -> Float[Tensor, "3"]:
        """Return the integral of radiance over the sphere, float64."""
        _, solid_angle, radiance = self.texels()
        return solid_angle @ radiance

    def harmonics(self, degree: int) -> Float[Tensor, "n 3"]:
        """Return c_e: the projection on spherical harmonics up to `degree`, world, float64.

        A texel counts as its middle, which is exact to the map's own resolution.
        """
        w, solid_angle, radiance = self.texels()
        c = torch.zeros(spherical_harmonics.size(degree), 3, dtype=torch.float64)
        for part in torch.arange(len(w)).split(1 << 18):
            c += spherical_harmonics.project(radiance[part].mT, w[part], solid_angle[part], degree).mT
        return c


def read(path: str | Path) -> Environment:
    """Return the environment in a picture: Radiance, OpenEXR, PFM, or one of 8 bits; its shape tells the layout.

    Values that mean no light become some that do, and a warning counts them: what is negative or no number becomes 0,
    what is infinite the largest value there is. Lat-long maps of 8192 x 4096 texels are averaged to 4096 x 2048.

    Raises:
        FormatError: the file is missing, unreadable, of no known layout, or holds no number.
    """
    picture = image.read(path)
    height, width = picture.shape[:2]
    radiance = cleaned(picture, str(path))
    if width == 2 * height or width == height == 1:
        return Environment(radiance=reduced(radiance), rotation=torch.eye(3))
    for (rows, columns), places in FACES.items():
        if width * rows == height * columns and height % rows == 0:
            faces = radiance.unflatten(1, (columns, -1)).unflatten(0, (rows, -1)).transpose(1, 2)
            cube = torch.stack([faces[place] for place in places])
            if rows > columns == 3:
                cube[5] = cube[5].flip(0, 1)
            return Environment(radiance=cube, layout="cube", rotation=torch.eye(3))
    raise FormatError(
        f"{path}: expected a lat-long map (2 : 1) or a cube map (4 : 3, 3 : 4, 6 : 1 or 1 : 6), got {width} x {height}"
    )


def cleaned(radiance: Float[Tensor, "*texels 3"], name: str) -> Float[Tensor, "*texels 3"]:
    """Return radiances without what means no light; say how many values were changed.

    Raises:
        FormatError: there is not one finite value.
    """
    finite = radiance.isfinite()
    endless, below = radiance == math.inf, radiance < 0
    if not bool(finite.any()):
        raise FormatError(f"{name}: expected radiances, got none that is a finite number; the copy may be damaged")
    most = min(float(radiance[finite].max().clamp(min=0)), MOST_RADIANCE)
    found = {"not a number": radiance.isnan(), "below 0": below, "infinite or too large": endless | (radiance > most)}
    counts = [f"{int(bad.sum())} {what}" for what, bad in found.items() if bool(bad.any())]
    if counts:
        warnings.warn(
            f"{name}: of {radiance.numel()} values {', '.join(counts)}: taken as 0, infinite ones as {most:g}",
            stacklevel=3,
        )
    if most == 0:
        warnings.warn(f"{name}: all values are 0: this environment sends no light", stacklevel=3)
    return torch.nan_to_num(radiance, nan=0.0, posinf=most).clamp(0, most)


def reduced(radiance: Float[Tensor, "H W 3"]) -> Float[Tensor, "_ _ 3"]:
    """Return a lat-long map of at most `MOST_ROWS` rows: means by solid angle, so that no energy is lost.

    An odd number of rows stays as it is.
    """
    while radiance.shape[0] > MOST_ROWS and radiance.shape[0] % 2 == 0:
        edge = (torch.arange(len(radiance) + 1, dtype=torch.float64) * (math.pi / len(radiance))).cos()
        pair = (edge[:-1] - edge[1:]).unflatten(0, (-1, 2))
        share = (pair / pair.sum(1, keepdim=True) / 2).to(radiance.dtype)
        across = radiance.unflatten(1, (-1, 2)).sum(2).unflatten(0, (-1, 2))
        radiance = (across * share[:, :, None, None]).sum(1)
    return radiance


def _lat_long(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return directions and exact solid angles of the texels of a lat-long map, float64."""
    theta = (torch.arange(height, dtype=torch.float64) + 0.5) * (math.pi / height)
    phi = ((torch.arange(width, dtype=torch.float64) + 0.5) / width - 0.5) * (2 * math.pi)
    edge = (torch.arange(height + 1, dtype=torch.float64) * (math.pi / height)).cos()
    area = (edge[:-1] - edge[1:]) * (2 * math.pi / width)
    sine = theta.sin()[:, None]
    w = torch.stack([sine * phi.sin(), theta.cos()[:, None].expand(-1, width), -sine * phi.cos()], -1)
    return w.reshape(-1, 3), area[:, None].expand(-1, width).reshape(-1)


def _cube(n: int) -> tuple[Tensor, Tensor]:
    """Return directions and exact solid angles of the texels of a cube map, float64."""
    middle = (torch.arange(n, dtype=torch.float64) + 0.5) * (2 / n) - 1
    out, right, up = torch.tensor(AXES, dtype=torch.float64).unbind(1)
    w = out[:, None, None] + middle[:, None] * right[:, None, None] - middle[:, None, None] * up[:, None, None]
    return torch.nn.functional.normalize(w.reshape(-1, 3), dim=-1), cube_map.texels(n).solid_angle
