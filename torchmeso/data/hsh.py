r"""Hemispherical harmonics maps (.rti): per texel and channel 4, 9 or 16 coefficients over the light's direction.

The basis is the spherical harmonics with their polar angle squeezed onto the hemisphere, P_lm(2 cos(theta) - 1),
orthonormal there: 1; then cos(phi), the middle, sin(phi) of degree 1; then degree 2 from cos(2 phi) to sin(2 phi);
then degree 3. Written out with X = sqrt(c - c^2) cos(phi), Y = sqrt(c - c^2) sin(phi), c = cos(theta), in `basis`.
Values are those of the pictures it was fitted to, sRGB codes over 255; `evaluate` makes linear RGB of them.

File: lines that begin with "#" ("#HSH1.2"), "3" (hemispherical harmonics), "width height channels", "terms kind bytes"
(kind 2: each channel for itself, one byte a coefficient), then little-endian float32 scale and bias of each term, then
texel after texel, channel after channel the bytes of all terms, with coefficient = byte / 255 scale + bias.
Source: the headers and loops of public writers of such files; there is no published text of the layout at hand. Rows
are taken from the top; files whose rows begin at the bottom come out upside down.

Test: tests/data/test_hsh.py
"""

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchmeso.data import address, image, rti, store
from torchmeso.errors import FormatError, ShapeError, check_finite, check_shape

TERMS = (4, 9, 16)

HEADER = re.compile(rb"((?:#[^\n]{0,500}\n)*)(\d+)\s+(\d{1,7}) (\d{1,7}) (\d)\s+(\d{1,3}) (\d) (\d)[ \t]*\r?\n")


@dataclass(frozen=True, eq=False, kw_only=True)
class Hsh:
    """A hemispherical harmonics map.

    Attributes:
        codes: (H, W, 3, term) coefficients, 4, 9 or 16 of them.
        scale: (term) coefficient = code / 255 scale + bias.
        bias: (term).
    """

    codes: UInt8[Tensor, "H W 3 term"]
    scale: Float[Tensor, "term"]
    bias: Float[Tensor, "term"]

    def __post_init__(self) -> None:
        """Raise ShapeError unless the parts match."""
        n = self.codes.shape[-1]
        check_shape("hsh.codes", self.codes, (-1, -1, 3, -1))
        if n not in TERMS:
            raise ShapeError(f"hsh.codes: expected 4, 9 or 16 terms, got {n}")
        for name, values in (("scale", self.scale), ("bias", self.bias)):
            check_shape(f"hsh.{name}", values, (n,))
            check_finite(f"hsh.{name}", values)

    def evaluate(self, uv: Float[Tensor, "*batch 2"], wi: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Return T(uv, wi), linear RGB, seen from above; it fades to 0 over the last degrees above the horizon.

        Coefficients, which are linear, are interpolated between texels.
        """
        taps = address.bilinear(uv, self.codes.shape[0], self.codes.shape[1])
        codes = (self.codes.flatten(0, 1)[taps.texel].to(uv.dtype) * taps.weight[..., None, None]).sum(-3)
        coefficients = codes / 255 * self.scale.to(uv.dtype) + self.bias.to(uv.dtype)
        srgb = (coefficients * basis(wi, self.codes.shape[-1]).unsqueeze(-2)).sum(-1)
        return image.to_linear(srgb.clamp(min=0)) * rti.fade(wi)


def basis(wi: Float[Tensor, "*batch 3"], terms: int) -> Float[Tensor, "*batch term"]:
    """Return the first `terms` hemispherical harmonics of directions; below the horizon those at the horizon."""
    x, y, c = wi.unbind(-1)
    c = c.clamp(min=0)
    # sqrt(c - c^2) cos(phi) = x sqrt(c / (1 + c)), which is smooth at the pole; the tiny number keeps the gradient
    # finite at the horizon.
    squeeze = (c / (1 + c) + torch.finfo(wi.dtype).tiny).sqrt()
    X, Y, z = x * squeeze, y * squeeze, 2 * c - 1
    cos2, sin2 = X * X - Y * Y, 2 * X * Y
    of_degree = [[torch.ones_like(c) / math.sqrt(2 * math.pi)]]
    of_degree.append([math.sqrt(6 / math.pi) * X, math.sqrt(1.5 / math.pi) * z, math.sqrt(6 / math.pi) * Y])
    a = math.sqrt(30 / math.pi)
    of_degree.append([-a * cos2, a * z * X, math.sqrt(2.5 / math.pi) * (1 - 6 * c + 6 * c * c), a * z * Y, -a * sin2])
    a, b = 2 * math.sqrt(35 / math.pi), math.sqrt(210 / math.pi)
    middle = 2 * math.sqrt(21 / math.pi) * (1 - 5 * c + 5 * c * c)
    of_degree.append(
        [
            a * (X * X - 3 * Y * Y) * X,
            -b * z * cos2,
            middle * X,
            math.sqrt(3.5 / math.pi) * (-1 + 12 * c - 30 * c**2 + 20 * c**3),
            middle * Y,
            -b * z * sin2,
            a * (3 * X * X - Y * Y) * Y,
        ]
    )
    return torch.stack([values for degree in of_degree for values in degree][:terms], -1)


def read(path: str | Path) -> Hsh:
    """Return a hemispherical harmonics map.

    Raises:
        FormatError: the file is missing, damaged, or of another kind.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: expected a hemispherical harmonics map (.rti), found none; check the path")
    with store.reading(path):
        return _decode(path.read_bytes(), path)


def _decode(data: bytes, path: Path) -> Hsh:
    header = HEADER.match(data[:8192])
    if header is None:
        raise FormatError(f"{path}: expected the header of an RTI file, got something else")
    kind, width, height, channels, terms, basis_kind, size = (int(x) for x in header.groups()[1:])
    if (kind, channels, basis_kind, size) != (3, 3, 2, 1) or terms not in TERMS:
        raise FormatError(
            f"{path}: expected hemispherical harmonics (3) of 3 channels, with 4, 9 or 16 terms of kind 2 in one byte, "
            f"got ({kind}), {channels} channels, {terms} terms of kind {basis_kind} in {size} bytes"
        )
    n = width * height * 3 * terms
    if not 0 < n + 8 * terms <= len(data) - header.end():
        raise FormatError(
            f"{path}: expected {n + 8 * terms} bytes for {width} x {height} texels, got {len(data) - header.end()}; "
            "the copy may be incomplete"
        )
    floats = torch.from_numpy(np.frombuffer(data, "<f4", 2 * terms, header.end()).astype(np.float32))
    codes = np.frombuffer(data, np.uint8, n, header.end() + 8 * terms).reshape(height, width, 3, terms)
    return Hsh(codes=torch.from_numpy(codes.copy()), scale=floats[:terms], bias=floats[terms:])


def write(hsh: Hsh, path: str | Path) -> None:
    """Write a hemispherical harmonics map.

    Raises:
        StorageError: the place cannot be written to.
    """
    height, width, _, terms = hsh.codes.shape
    with store.replacing(path) as beside, beside.open("wb") as file:
        file.write(f"#HSH1.2\r\n3\r\n{width} {height} 3\r\n{terms} 2 1\r\n".encode())
        file.write(torch.cat([hsh.scale, hsh.bias]).float().numpy().astype("<f4").tobytes())
        file.write(hsh.codes.contiguous().numpy().tobytes())
