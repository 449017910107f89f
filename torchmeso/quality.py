"""How far apart two pictures or two masks are.

Pictures in linear radiance are first brought to the screen the same way: the reference's 99.5th percentile of
brightness becomes 1, then clip, then sRGB. PSNR, SSIM and FLIP are taken there.

Test: tests/test_quality.py
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso.errors import ShapeError

EXPOSURE_PERCENTILE = 99.5
"""Percentile of the reference's largest channel that is shown as white."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Differences between a picture and its reference.

    Attributes:
        psnr: in dB on sRGB; inf where they are equal.
        ssim: mean structural similarity, 1 = equal.
        flip: mean FLIP error, 0 = equal; None where flip-evaluator is not installed (extra `report`).
        max_error: largest difference of linear values.
        exposure: factor that was applied to both.
    """

    psnr: float
    ssim: float
    flip: float | None
    max_error: float
    exposure: float


def compare(reference: Float[Tensor, "H W 3"], picture: Float[Tensor, "H W 3"]) -> Comparison:
    """Return how far `picture` (linear) is from `reference`.

    Raises:
        ShapeError: their sizes differ, or a value is not finite.
    """
    if reference.shape != picture.shape:
        raise ShapeError(f"compare: expected pictures of one size, got {_size(reference)} and {_size(picture)}")
    if not bool(torch.isfinite(reference).all() and torch.isfinite(picture).all()):
        raise ShapeError("compare: expected finite values, got NaN or infinity")
    exposure = find_exposure(reference)
    a, b = to_screen(reference, exposure), to_screen(picture, exposure)
    return Comparison(
        psnr=psnr(a, b),
        ssim=ssim(a, b),
        flip=flip(a, b),
        max_error=float((reference - picture).abs().max()),
        exposure=exposure,
    )


def find_exposure(reference: Float[Tensor, "*batch 3"]) -> float:
    """Return the factor that brings the 99.5th percentile of the largest channel to 1."""
    bright = float(np.percentile(reference.detach().amax(-1).float().numpy(), EXPOSURE_PERCENTILE))
    return 1 / bright if bright > 0 else 1.0


def to_screen(linear: Float[Tensor, "*batch H W 3"], exposure: float) -> Float[Tensor, "*batch H W 3"]:
    """Return sRGB values in [0, 1] of `linear` times `exposure`."""
    from kornia.color import linear_rgb_to_rgb

    shown = (linear.detach().float() * exposure).clamp(0, 1)
    return linear_rgb_to_rgb(shown.movedim(-1, -3)).movedim(-3, -1)


def difference(reference: Float[Tensor, "H W 3"], picture: Float[Tensor, "H W 3"]) -> Float[Tensor, "H W 3"]:
    """Return four times the absolute difference on the screen (sRGB values in [0, 1]), for looking at."""
    exposure = find_exposure(reference)
    return (4 * (to_screen(reference, exposure) - to_screen(picture, exposure)).abs()).clamp(max=1)


def psnr(reference: Float[Tensor, "*batch"], picture: Float[Tensor, "*batch"]) -> float:
    """Return the peak signal-to-noise ratio in dB of values with peak 1; inf where they are equal."""
    error = float((reference.double() - picture.double()).square().mean())
    return float("inf") if error == 0 else float(-10 * np.log10(error))


def ssim(reference: Float[Tensor, "H W 3"], picture: Float[Tensor, "H W 3"]) -> float:
    """Return the mean structural similarity (wang2004image; 11 x 11 Gaussian window, peak 1)."""
    from kornia.metrics import ssim as similarity

    a, b = (x.permute(2, 0, 1)[None] for x in (reference, picture))
    return float(similarity(a, b, 11).mean())


def flip(reference: Float[Tensor, "H W 3"], picture: Float[Tensor, "H W 3"]) -> float | None:
    """Return the mean FLIP error (andersson2020flip) of two sRGB pictures; None where it is not installed."""
    try:
        import flip_evaluator
    except ImportError:
        return None
    a, b = (np.ascontiguousarray(x.numpy(), dtype=np.float32) for x in (reference, picture))
    return float(flip_evaluator.evaluate(a, b, "LDR", inputsRGB=True, applyMagma=False)[1])


def iou(a: Bool[Tensor, "*batch"], b: Bool[Tensor, "*batch"]) -> float:
    """Return the intersection over the union of two masks; 1 where both are empty."""
    union = int((a | b).sum())
    return 1.0 if union == 0 else int((a & b).sum()) / union


def boundary_distance(a: Bool[Tensor, "H W"], b: Bool[Tensor, "H W"]) -> float:
    """Return the mean distance in pixels from each mask's outline to the other's, both ways; 0 where both are empty.

    The outline is the pixels of a mask with a neighbour outside it.
    """
    from scipy.ndimage import binary_erosion, distance_transform_edt

    outlines = [x.numpy() & ~binary_erosion(x.numpy(), border_value=1) for x in (a, b)]
    if not outlines[0].any() or not outlines[1].any():
        return 0.0 if outlines[0].any() == outlines[1].any() else float("inf")
    away = [np.asarray(distance_transform_edt(~outline)) for outline in outlines]
    return float((away[1][outlines[0]].mean() + away[0][outlines[1]].mean()) / 2)


def psnr_by_picture(
    reference: Float[Tensor, "light view H W 3"], approximation: Float[Tensor, "light view H W 3"]
) -> Float[Tensor, "light view"]:
    """Return the PSNR in dB of every picture of a BTF, all at the exposure of the whole reference."""
    if reference.shape != approximation.shape:
        raise ShapeError(f"quality: expected one shape, got {tuple(reference.shape)} and {tuple(approximation.shape)}")
    exposure = find_exposure(reference)
    error = torch.stack(
        [
            (to_screen(a, exposure) - to_screen(b, exposure)).square().mean((1, 2, 3))
            for a, b in zip(reference, approximation, strict=True)
        ]
    )
    return -10 * torch.log10(error)


def _size(picture: Tensor) -> str:
    return f"{picture.shape[1]} x {picture.shape[0]}"
