"""Tileable height fields: from pictures (displacement and albedo) and from GelSight .tmd scans.

Heights are in tile units in [-h, 0], 0 = top; one texture tile is one unit wide.

Test: tests/data/test_height_field.py
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data import image
from torchmeso.errors import FormatError, check_range, check_shape


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class HeightField:
    """A surface z(u, v) over one tile, sampled at texel centres.

    Attributes:
        height: (H, W) in [-h, 0] tile units, row 0 at v near 1.
        albedo: (H', W', 3) linear RGB, or None.
        h: slab depth in tile units.
    """

    height: Float[Tensor, "H W"]
    albedo: Float[Tensor, "H2 W2 3"] | None
    h: float

    def __post_init__(self) -> None:
        """Raise ShapeError or ConfigError unless the parts match."""
        check_shape("height_field.height", self.height, (-1, -1))
        check_range("height_field.h", self.h, 1e-6, 10)
        check_range("height_field.height", float(self.height.min()), -self.h * (1 + 1e-5), 0)
        check_range("height_field.height", float(self.height.max()), -self.h, 1e-9)


def from_pictures(displacement: str | Path, albedo: str | Path | None, *, h: float, texels: int = 256) -> HeightField:
    """Return a height field of depth `h` from a displacement picture (white = top) that tiles.

    Args:
        displacement: one-channel picture, data (no gamma).
        albedo: colour picture (sRGB), or None.
        h: depth in tile units between black and white.
        texels: side of the result; pictures are averaged down, never up.

    Raises:
        FormatError: a picture is missing or unreadable.
    """
    z = (image.read_data(displacement) - 1) * h
    colour = None if albedo is None else _shrink(image.read(albedo).permute(2, 0, 1), texels).permute(1, 2, 0)
    z = _shrink(z[None], texels)[0]
    return HeightField(height=z - z.max(), albedo=colour, h=h)


def from_tmd(path: str | Path, *, relief: float | None = None, texels: int = 256, blend: float = 0.1) -> HeightField:
    """Return the height field of a GelSight .tmd scan; its side is one tile.

    Args:
        path: a "Binary TrueMap Data File v2.0".
        relief: depth in tile units to stretch the relief to; None keeps the true proportion.
        texels: side of the result; never larger than the scan.
        blend: share of the tile over which opposite borders are blended into each other, so that it repeats.

    Raises:
        FormatError: the file is missing, truncated, or of another kind.
    """
    heights, size = read_tmd(path)
    z = _shrink(heights[None], texels)[0] / size
    z = make_tileable(z, blend)
    z = z - z.max()
    depth = float(-z.min())
    if depth == 0:
        raise FormatError(f"{path}: expected a relief, got a flat surface")
    scale = 1.0 if relief is None else relief / depth
    return HeightField(height=(z * scale).clamp(min=-depth * scale), albedo=None, h=depth * scale)


def read_tmd(path: str | Path) -> tuple[Float[Tensor, "H W"], float]:
    """Return the heights of a .tmd file and the length of its longer side, both in millimetres; row 0 on top.

    Raises:
        FormatError: the file is missing, truncated, or of another kind.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: expected a .tmd scan, found none; check the path")
    raw = path.read_bytes()
    if not raw.startswith(b"Binary TrueMap Data File v2.0"):
        raise FormatError(f"{path}: expected a Binary TrueMap Data File v2.0, got another file")
    start = raw.index(b"\0", 32) + 1  # a comment ended by zero follows the 32-byte signature
    if len(raw) < start + 24:
        raise FormatError(f"{path}: header ends after {len(raw)} bytes; the copy may be incomplete")
    width, height, length_x, length_y, _, _ = struct.unpack_from("<2i4f", raw, start)
    expected = start + 24 + 4 * width * height
    if min(width, height) < 2 or len(raw) < expected:
        raise FormatError(
            f"{path}: header says {width} x {height} heights ({expected} bytes), the file has {len(raw)}; "
            "the copy may be incomplete"
        )
    values = np.frombuffer(raw, dtype="<f4", count=width * height, offset=start + 24).reshape(height, width)
    return torch.from_numpy(values.copy()), max(length_x, length_y)


def make_tileable(z: Float[Tensor, "H W"], blend: float) -> Float[Tensor, "H W"]:
    """Return `z` with opposite borders blended over the share `blend` of each side, so that it repeats.

    A linear ramp moves half of the jump to each side: nothing beyond the ramp changes.
    """
    check_range("blend", blend, 0, 0.5)
    for dim in (0, 1):
        n = z.shape[dim]
        width = round(n * blend)
        if width == 0:
            continue
        jump = z.select(dim, 0) - z.select(dim, n - 1)
        ramp = torch.zeros(n, dtype=z.dtype)
        steps = (torch.arange(width, dtype=z.dtype) + 0.5) / width
        ramp[:width] = -(1 - steps) / 2
        ramp[n - width :] = steps / 2
        z = z + (ramp[:, None] * jump[None, :] if dim == 0 else ramp[None, :] * jump[:, None])
    return z


def _shrink(x: Tensor, texels: int) -> Tensor:
    """Average (C, H, W) down so that neither side is longer than `texels`."""
    height, width = x.shape[-2:]
    factor = min(1.0, texels / max(height, width))
    size = (max(2, round(height * factor)), max(2, round(width * factor)))
    if size == (height, width):
        return x
    return torch.nn.functional.interpolate(x[None], size=size, mode="area")[0]
