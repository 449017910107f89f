"""Cross-sections of yarns: closed outlines over v in [0, 1), and how one goes over into another.

    ellipse      (w/2 cos 2 pi v, h/2 sin 2 pi v)
    power n      (w/2 cos 2 pi v, +-h/2 |sin 2 pi v|^n): 1 = ellipse, towards 0 a rectangle, 2 a lens with sharp ends
    lenticular   two arcs of circles through (+-w/2, d), the upper over (0, h/2), the lower over (0, -h/2)

lin2012automated. v = 0 lies at +x and grows towards +y; corners of a rectangle lie at odd eighths.

Test: tests/data/test_yarn_section.py
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import FormatError, check_shape

MOST = 1e6
"""Longest side of a section in the file's units; nothing woven comes near."""


@runtime_checkable
class Section(Protocol):
    """A closed outline."""

    def outline(self, v: Float[Tensor, "n"]) -> Float[Tensor, "n 2"]:
        """Return the points at `v` in [0, 1): x across the yarn to the right, y up, in the file's units."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Ellipse:
    """An ellipse, or a power ellipse where `power` is not 1; `width` and `height` are full axes."""

    width: float
    height: float
    power: float = 1.0

    def __post_init__(self) -> None:
        """Raise FormatError unless the sizes make a section."""
        _check_size("ellipse", self.width, self.height)
        if not 0 <= self.power <= 64:
            raise FormatError(f"ellipse: expected a power from 0 to 64, got {self.power:g}")

    def outline(self, v: Float[Tensor, "n"]) -> Float[Tensor, "n 2"]:
        """Return points of the outline, see `Section`."""
        x, y = (2 * math.pi * v).cos(), (2 * math.pi * v).sin()
        return torch.stack([x * self.width / 2, y.sign() * y.abs() ** self.power * self.height / 2], -1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Lenticular:
    """Two arcs of circles that meet at the height `distortion` above the middle."""

    width: float
    height: float
    distortion: float = 0.0

    def __post_init__(self) -> None:
        """Raise FormatError unless the sizes make a section."""
        _check_size("lenticular section", self.width, self.height)
        if not abs(self.distortion) < self.height / 2:
            raise FormatError(
                f"lenticular section: expected a distortion of less than half its height {self.height:g}, "
                f"got {self.distortion:g}"
            )

    def outline(self, v: Float[Tensor, "n"]) -> Float[Tensor, "n 2"]:
        """Return points of the outline, see `Section`."""
        upper = v < 0.5
        sagitta = self.height / 2 - self.distortion * torch.where(upper, 1, -1).to(v.dtype)
        radius = (self.width**2 / 4 + sagitta.square()) / (2 * sagitta)
        # The half angle by its tangent, which does not lose the arcs that are more than half a circle.
        half = 2 * torch.atan2(sagitta, torch.full_like(sagitta, self.width / 2))
        angle = half * torch.where(upper, 1 - 4 * v, 4 * v - 3)
        y = self.height / 2 - radius + radius * angle.cos()
        return torch.stack([radius * angle.sin(), torch.where(upper, y, -y)], -1)


@dataclass(frozen=True, slots=True, kw_only=True)
class Rectangle:
    """A rectangle; a quarter of v to each side, so that its corners are met by a multiple of 8 points."""

    width: float
    height: float

    def __post_init__(self) -> None:
        """Raise FormatError unless the sizes make a section."""
        _check_size("rectangle", self.width, self.height)

    def outline(self, v: Float[Tensor, "n"]) -> Float[Tensor, "n 2"]:
        """Return points of the outline, see `Section`."""
        return _along(_corners(self.width / 2, self.height / 2, v), v + 0.125)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Polygon:
    """A polygon; v goes along its sides, as much to each."""

    points: Float[Tensor, "corner 2"]

    def __post_init__(self) -> None:
        """Raise FormatError unless there is a polygon."""
        check_shape("polygon.points", self.points, (-1, 2))
        if len(self.points) < 3 or not bool((self.points.abs() <= MOST).all()):
            raise FormatError(
                f"polygon: expected at least 3 corners within {MOST:g}, got {len(self.points)} of which the "
                f"farthest lies at {_farthest(self.points):g}"
            )

    def outline(self, v: Float[Tensor, "n"]) -> Float[Tensor, "n 2"]:
        """Return points of the outline, see `Section`."""
        return _along(self.points.to(v.dtype), v)


@dataclass(frozen=True, slots=True, kw_only=True)
class Hybrid:
    """Pieces of several sections: `sections[k]` up to v = `ends[k]`; the first goes on behind the last end."""

    ends: tuple[float, ...]
    sections: tuple[Section, ...]

    def __post_init__(self) -> None:
        """Raise FormatError unless every piece has its end."""
        rising = all(a < b for a, b in pairwise(self.ends))
        if not self.ends or len(self.ends) != len(self.sections) or not rising or min(self.ends) < 0:
            raise FormatError(
                f"hybrid section: expected one rising division from 0 to 1 for each of its {len(self.sections)} "
                f"sections, got {len(self.ends)}"
            )

    def outline(self, v: Float[Tensor, "n"]) -> Float[Tensor, "n 2"]:
        """Return points of the outline, see `Section`."""
        piece = torch.bucketize(v, v.new_tensor(self.ends), right=True) % len(self.sections)
        points = torch.stack([section.outline(v) for section in self.sections])
        return points[piece, torch.arange(len(v))]


@dataclass(frozen=True, slots=True, kw_only=True)
class Turned:
    """A section turned towards +y by `angle` (radians) and then scaled along x and y."""

    section: Section
    angle: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)

    def __post_init__(self) -> None:
        """Raise FormatError for a scale that leaves nothing."""
        if not all(1 / MOST <= s <= MOST for s in self.scale):
            raise FormatError(f"scaled section: expected factors above 0, got {self.scale[0]:g}, {self.scale[1]:g}")

    def outline(self, v: Float[Tensor, "n"]) -> Float[Tensor, "n 2"]:
        """Return points of the outline, see `Section`."""
        x, y = self.section.outline(v).unbind(-1)
        c, s = math.cos(self.angle), math.sin(self.angle)
        return torch.stack([(c * x - s * y) * self.scale[0], (s * x + c * y) * self.scale[1]], -1)


def _check_size(what: str, width: float, height: float) -> None:
    for name, value in (("width", width), ("height", height)):
        if not 0 < value <= MOST:
            raise FormatError(f"{what}: expected a {name} above 0 and up to {MOST:g}, got {value:g}")


def _farthest(points: Tensor) -> float:
    return float(points.abs().max()) if len(points) else 0.0


def _corners(x: float, y: float, like: Tensor) -> Float[Tensor, "4 2"]:
    return like.new_tensor([[x, -y], [x, y], [-x, y], [-x, -y]])


def _along(points: Float[Tensor, "corner 2"], v: Float[Tensor, "n"]) -> Float[Tensor, "n 2"]:
    """Return the points at `v` (period 1) along the sides of a polygon, as much to each side."""
    place = (v % 1) * len(points)
    corner = place.floor().long() % len(points)
    share = (place - place.floor())[:, None]
    return points[corner] * (1 - share) + points[(corner + 1) % len(points)] * share
