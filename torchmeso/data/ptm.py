"""Polynomial texture maps (.ptm): per texel a quadratic polynomial in the light's direction.

With (x, y) the light's direction in the plane of the texture, x right and y up,

    L(x, y) = a0 x^2 + a1 y^2 + a2 x y + a3 x + a4 y + a5,   0 to 255,

of luminance times a colour (LRGB) or of each channel (RGB), in the values of the pictures it was fitted to: sRGB
codes. `evaluate` makes linear RGB of them.

File: "PTM_1.2", the format, width and height, six scales and six integer biases as text with
a_i = (byte_i - bias_i) scale_i; then rows from the bottom, of LRGB all coefficients (six bytes a texel) and after
them all colours (three bytes), of RGB all coefficients of red, of green, of blue.
Source: Malzbender and Gelb, "Polynomial Texture Map (.ptm) File Format", version 1.2, Hewlett-Packard 2001
(HPL-2001-104). Of its formats LRGB and RGB are read and written; JPEG, JPEG-LS, LUM and look-up tables are not.

Test: tests/data/test_ptm.py
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchmeso.data import address, image, rti, store
from torchmeso.errors import FormatError, check_finite, check_shape

NUMBER = rb"[-+]?[\d.]{1,30}(?:[eE][-+]?\d{1,4})?"
HEADER = re.compile(
    rb"PTM_1\.2\s+(PTM_FORMAT_\w{1,20})\s+(\d{1,7})\s+(\d{1,7})((?:\s+" + NUMBER + rb"){12})[ \t]*\r?\n"
)


@dataclass(frozen=True, eq=False, kw_only=True)
class Ptm:
    """A polynomial texture map.

    Attributes:
        codes: (H, W, plane, 6) coefficients; one plane with a colour (LRGB), three without (RGB).
        scale: (6) a = (code - bias) scale.
        bias: (6) whole numbers.
        colour: (H, W, 3), of LRGB.
    """

    codes: UInt8[Tensor, "H W plane 6"]
    scale: Float[Tensor, "6"]
    bias: Float[Tensor, "6"]
    colour: UInt8[Tensor, "H W 3"] | None = None

    def __post_init__(self) -> None:
        """Raise ShapeError unless the parts match."""
        height, width = self.codes.shape[:2]
        check_shape("ptm.codes", self.codes, (-1, -1, 3 if self.colour is None else 1, 6))
        if self.colour is not None:
            check_shape("ptm.colour", self.colour, (height, width, 3))
        for name, values in (("scale", self.scale), ("bias", self.bias)):
            check_shape(f"ptm.{name}", values, (6,))
            check_finite(f"ptm.{name}", values)

    def evaluate(self, uv: Float[Tensor, "*batch 2"], wi: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Return T(uv, wi), linear RGB, seen from above; it fades to 0 over the last degrees above the horizon.

        Coefficients, which are linear, are interpolated between texels.
        """
        taps = address.bilinear(uv, self.codes.shape[0], self.codes.shape[1])
        codes = _interpolate(self.codes.flatten(0, 1), taps)
        a = (codes - self.bias.to(uv.dtype)) * self.scale.to(uv.dtype)
        srgb = (a * basis(wi).unsqueeze(-2)).sum(-1) / 255
        if self.colour is not None:
            srgb = srgb * _interpolate(self.colour.flatten(0, 1), taps) / 255
        return image.to_linear(srgb.clamp(min=0)) * rti.fade(wi)


def basis(wi: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 6"]:
    """Return x^2, y^2, x y, x, y, 1 of the directions."""
    x, y, _ = wi.unbind(-1)
    return torch.stack([x * x, y * y, x * y, x, y, torch.ones_like(x)], -1)


def _interpolate(table: Tensor, taps: address.Taps) -> Tensor:
    weight = taps.weight.reshape(*taps.weight.shape, *[1] * (table.ndim - 1))
    return (table[taps.texel].to(weight.dtype) * weight).sum(taps.weight.ndim - 1)


def read(path: str | Path) -> Ptm:
    """Return a polynomial texture map.

    Raises:
        FormatError: the file is missing, damaged, or of a format that is not read.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: expected a polynomial texture map (.ptm), found none; check the path")
    with store.reading(path):
        return _decode(path.read_bytes(), path)


def _decode(data: bytes, path: Path) -> Ptm:
    header = HEADER.match(data[:4096])
    if header is None:
        raise FormatError(f"{path}: expected the header of a PTM_1.2 file, got something else")
    kind, width, height = header[1].decode(), int(header[2]), int(header[3])
    if kind not in ("PTM_FORMAT_LRGB", "PTM_FORMAT_RGB"):
        raise FormatError(f"{path}: {kind} cannot be read; write it anew as PTM_FORMAT_LRGB or PTM_FORMAT_RGB")
    n, planes = width * height, 1 if kind == "PTM_FORMAT_LRGB" else 3
    size = n * (9 if planes == 1 else 18)
    if not 0 < size <= len(data) - header.end():
        raise FormatError(
            f"{path}: expected {size} bytes for {width} x {height} texels, got {len(data) - header.end()}; "
            "the copy may be incomplete"
        )
    numbers = torch.tensor([float(x) for x in header[4].split()], dtype=torch.float32)
    bytes_ = np.frombuffer(data, np.uint8, size, header.end())
    codes = np.ascontiguousarray(bytes_[: n * planes * 6].reshape(planes, height, width, 6).transpose(1, 2, 0, 3)[::-1])
    colour = None
    if planes == 1:
        colour = torch.from_numpy(np.ascontiguousarray(bytes_[n * 6 :].reshape(height, width, 3)[::-1]))
    return Ptm(codes=torch.from_numpy(codes), scale=numbers[:6], bias=numbers[6:], colour=colour)


def write(ptm: Ptm, path: str | Path) -> None:
    """Write a polynomial texture map, LRGB or RGB.

    Raises:
        StorageError: the place cannot be written to.
    """
    height, width, planes, _ = ptm.codes.shape
    scales = " ".join(f"{x:.9g}" for x in ptm.scale.tolist())
    biases = " ".join(str(round(x)) for x in ptm.bias.tolist())
    header = f"PTM_1.2\nPTM_FORMAT_{'LRGB' if planes == 1 else 'RGB'}\n{width}\n{height}\n{scales} \n{biases} \n"
    with store.replacing(path) as beside, beside.open("wb") as file:
        file.write(header.encode())
        file.write(ptm.codes.flip(0).permute(2, 0, 1, 3).contiguous().numpy().tobytes())
        if ptm.colour is not None:
            file.write(ptm.colour.flip(0).contiguous().numpy().tobytes())
