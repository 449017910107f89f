"""Fit PTM and HSH maps to RTI picture sets, by least squares over the lights.

With B the basis at the lights, the coefficients of a texel are pinv(B) times its values: pictures are added up one
after the other, so that one is in memory at a time. Values are sRGB codes, as other programs for these maps have
them. LRGB keeps one colour per texel, the mean over the lights, and fits what each picture is along it.

Test: tests/compress/test_rti.py
"""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data import hsh, ptm
from torchmeso.data.hsh import TERMS, Hsh
from torchmeso.data.ptm import Ptm
from torchmeso.data.rti import LightSet
from torchmeso.errors import ConfigError


def fit_ptm(lights: LightSet, *, per_channel: bool = False) -> Ptm:
    """Return the polynomial texture map of `lights`: LRGB, or RGB where each channel has its own polynomial.

    Raises:
        ConfigError: the lights cannot tell the six coefficients apart.
        FormatError: a picture is damaged.
    """
    solve = _pseudo_inverse(ptm.basis(lights.directions.double()), "six coefficients of a PTM")
    pictures = (picture.float() for picture in lights.pictures())
    if per_channel:
        coefficients, colour = _accumulate(solve, pictures), None
    else:
        mean = _mean(lights)
        colour = (mean * 255 / mean.amax(-1, keepdim=True).clamp(min=1e-3)).round().clamp(0, 255)
        along = colour / colour.square().sum(-1, keepdim=True).clamp(min=1) * 255
        coefficients = _accumulate(solve, ((picture * along).sum(-1, keepdim=True) for picture in pictures))
    low, high = coefficients.amin((0, 1, 2)), coefficients.amax((0, 1, 2))
    # Two codes are left for the bias, which is a whole number.
    scale = torch.where(high > low, high - low, low.abs().clamp(min=1)) / 253
    bias = (1 - low / scale).round()
    codes = (coefficients / scale + bias).round().clamp(0, 255).to(torch.uint8)
    return Ptm(codes=codes, scale=scale, bias=bias, colour=None if colour is None else colour.to(torch.uint8))


def fit_hsh(lights: LightSet, terms: int = 9) -> Hsh:
    """Return the hemispherical harmonics map of `lights` with 4, 9 or 16 terms.

    Raises:
        ConfigError: another number of terms, or the lights cannot tell them apart.
        FormatError: a picture is damaged.
    """
    if terms not in TERMS:
        raise ConfigError(f"rti.terms: expected 4, 9 or 16, got {terms}")
    solve = _pseudo_inverse(hsh.basis(lights.directions.double(), terms), f"{terms} terms of an HSH map")
    coefficients = _accumulate(solve, (picture.float() / 255 for picture in lights.pictures()))
    bias = coefficients.amin((0, 1, 2))
    scale = coefficients.amax((0, 1, 2)) - bias
    codes = ((coefficients - bias) / scale.clamp(min=1e-30) * 255).round().clamp(0, 255).to(torch.uint8)
    return Hsh(codes=codes, scale=scale, bias=bias)


def _pseudo_inverse(B: Float[Tensor, "light term"], what: str) -> Float[Tensor, "term light"]:
    rank = int(torch.linalg.matrix_rank(B, rtol=1e-4))
    if rank < B.shape[1]:
        raise ConfigError(
            f"rti: {len(B)} lights can tell {rank} terms apart, not the {what}; add lights at other heights, "
            "or take fewer terms"
        )
    return torch.linalg.pinv(B)


def _accumulate(solve: Tensor, pictures: Iterable[Tensor]) -> Float[Tensor, "H W channel term"]:
    """Return pinv(B) times the values of each texel, summed picture by picture."""
    total = None
    for weights, picture in zip(solve.T.float(), pictures, strict=True):
        part = picture.unsqueeze(-1) * weights
        total = part if total is None else total.add_(part)
    assert total is not None
    return total


def _mean(lights: LightSet) -> Float[Tensor, "H W 3"]:
    total = None
    for picture in lights.pictures():
        total = picture.float() if total is None else total.add_(picture)
    assert total is not None
    return total / len(lights.files)
