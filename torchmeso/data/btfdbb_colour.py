"""Colour models of Bonn's `.btf` files: what the three numbers of a texel stand for, and the way to linear RGB.

With e = 1e-5 and (Y, U, V) = M^-1 (R, G, B): 0 RGB; 1 YUV; 2 CIE L*a*b* (D65, primaries of sRGB); 3 PCA,
x = A (rgb - mean); 4 YCoCg; 9 (log(Y + e), U, V); 10 logarithms of Y + e, U + e, V + e; 11 (log(Y + e), U / (Y + e),
V / (Y + e)); 12 logarithms of R + e, G + e, B + e. Models 5 and 6 (spectra) are refused: what their channels mean is
not told. Nothing is clamped: highlights are values above 1 here as they were for the camera.

Model 11 is inverted as U = u (Y + e); readers that take U = u Y + e have wrong colours in the dark.

Test: tests/data/test_btfdbb_colour.py
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import FormatError, ShapeError

EPSILON = 1e-5
"""Added before logarithms and to divisors."""

NAMES = {
    0: "RGB", 1: "YUV", 2: "Lab", 3: "PCA", 4: "YCoCg", 5: "spectral", 6: "spectral, linear", 9: "log Y, U, V",
    10: "log Y, log U, log V", 11: "log Y, U/Y, V/Y", 12: "log RGB",
}  # fmt: skip

READ = (0, 1, 2, 3, 4, 9, 10, 11, 12)
"""Models that become RGB."""

YUV_TO_RGB = ((1.0, 0.0, 1.13983), (1.0, -0.39465, -0.5806), (1.0, 2.03211, 0.0))
YCOCG_TO_RGB = ((1.0, 1.0, -1.0), (1.0, 0.0, 1.0), (1.0, -1.0, -1.0))
XYZ_TO_RGB = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
WHITE = (0.95047, 1.0, 1.08883)
"""X, Y, Z of D65."""

LAB_KNEE = 6 / 29
"""Where the cube root of L*a*b* becomes a line."""

_IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class Colour:
    """A colour model.

    Attributes:
        model: its number.
        mean: of RGB, model 3.
        transform: A, rows first, model 3.
    """

    model: int = 0
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    transform: tuple[float, ...] = _IDENTITY

    def __post_init__(self) -> None:
        """Raise FormatError unless the model is one that becomes RGB."""
        if self.model not in READ:
            what = NAMES.get(self.model, "unknown")
            raise FormatError(
                f"colour model {self.model} ({what}): expected one of {', '.join(map(str, READ))}; "
                "convert the file to RGB with the program that made it"
            )
        if self.model == 3 and abs(float(torch.linalg.det(self._matrix()))) < 1e-12:
            raise FormatError("colour model 3 (PCA): expected a transform that can be inverted, got a singular one")

    @property
    def name(self) -> str:
        """What the three numbers are."""
        return NAMES[self.model]

    def _matrix(self) -> Tensor:
        return torch.tensor(self.transform, dtype=torch.float64).reshape(3, 3)


def to_rgb(colour: Colour, x: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Return linear RGB of the numbers of a file, unclamped; a logarithm beyond the dtype becomes inf."""
    first, rest = x[..., :1], x[..., 1:]
    match colour.model:
        case 1:
            return _times(x, YUV_TO_RGB)
        case 2:
            return _from_lab(x)
        case 3:
            return x @ torch.linalg.inv(colour._matrix()).mT.to(x.dtype) + x.new_tensor(colour.mean)
        case 4:
            return _times(x, YCOCG_TO_RGB)
        case 9:
            return _times(torch.cat([first.exp() - EPSILON, rest], -1), YUV_TO_RGB)
        case 10:
            return _times(x.exp() - EPSILON, YUV_TO_RGB)
        case 11:
            lifted = first.exp()  # Y + e
            return _times(torch.cat([lifted - EPSILON, rest * lifted], -1), YUV_TO_RGB)
        case 12:
            return x.exp() - EPSILON
    return x


def from_rgb(colour: Colour, rgb: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Return the numbers of a file for linear RGB: the inverse of `to_rgb`.

    Raises:
        ShapeError: the model takes the logarithm of a value that is negative.
    """
    match colour.model:
        case 1:
            return _divided(rgb, YUV_TO_RGB)
        case 2:
            return _to_lab(rgb)
        case 3:
            return (rgb - rgb.new_tensor(colour.mean)) @ colour._matrix().mT.to(rgb.dtype)
        case 4:
            return _divided(rgb, YCOCG_TO_RGB)
        case 9:
            yuv = _divided(rgb, YUV_TO_RGB)
            return torch.cat([_log(colour, yuv[..., :1]), yuv[..., 1:]], -1)
        case 10:
            return _log(colour, _divided(rgb, YUV_TO_RGB))
        case 11:
            yuv = _divided(rgb, YUV_TO_RGB)
            return torch.cat([_log(colour, yuv[..., :1]), yuv[..., 1:] / (yuv[..., :1] + EPSILON)], -1)
        case 12:
            return _log(colour, rgb)
    return rgb


def _times(x: Tensor, matrix: tuple[tuple[float, ...], ...]) -> Tensor:
    return x @ x.new_tensor(matrix).mT


def _divided(rgb: Tensor, matrix: tuple[tuple[float, ...], ...]) -> Tensor:
    return rgb @ torch.linalg.inv(torch.tensor(matrix, dtype=torch.float64)).mT.to(rgb.dtype)


def _log(colour: Colour, x: Tensor) -> Tensor:
    lifted = x + EPSILON
    if bool((lifted <= 0).any()):
        raise ShapeError(
            f"colour model {colour.model} ({colour.name}): expected values from 0 on, got {float(x.min()):g}; "
            "take a model without logarithms"
        )
    return lifted.log()


def _from_lab(lab: Tensor) -> Tensor:
    L, a, b = lab.unbind(-1)
    fy = (L + 16) / 116
    f = torch.stack([fy + a / 500, fy, fy - b / 200], -1)
    t = torch.where(f > LAB_KNEE, f**3, 3 * LAB_KNEE**2 * (f - 4 / 29))
    return _times(t * lab.new_tensor(WHITE), XYZ_TO_RGB)


def _to_lab(rgb: Tensor) -> Tensor:
    t = _divided(rgb, XYZ_TO_RGB) / rgb.new_tensor(WHITE)
    f = torch.where(t > LAB_KNEE**3, t.clamp(min=0) ** (1 / 3), t / (3 * LAB_KNEE**2) + 4 / 29)
    fx, fy, fz = f.unbind(-1)
    return torch.stack([116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)], -1)
