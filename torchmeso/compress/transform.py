"""Fit a transform-coded BTF to a budget: an error that may not be exceeded, or a size.

The bases of light, view and colour are eigenvectors of the table's Gram matrices (the best for a product of bases),
the texture is cut into blocks of cosines. All are orthonormal, so an error of a coefficient is the same error of T,
and one step for all coefficients spends bits where variance is: a coefficient below half a step is not stored.

Test: tests/compress/test_transform.py
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.compress import budget
from torchmeso.compress.budget import FREE_BYTES, Budget, Progress
from torchmeso.data.btf import Bands
from torchmeso.data.transform_btf import TransformBtf, cosines, packed
from torchmeso.errors import ConfigError

DEAD = 0.4
"""Added before rounding down: values a little above half a step become 0 too, which saves more than it costs."""

MOST_CODE = 32000


@dataclass(frozen=True, slots=True, kw_only=True)
class TransformOptions:
    """How to compress: exactly one budget, and what a picture may cost.

    Attributes:
        psnr: least PSNR of T in dB; None = not asked for.
        size: most bytes of the file, without an MDF; None = not asked for.
        rank: most components of the view, which is what drawing and memory cost; None = all.
    """

    psnr: float | None = None
    size: int | None = None
    rank: int | None = None


def fit(
    btf: Bands, options: TransformOptions, *, progress: Progress = lambda share: None
) -> tuple[TransformBtf, float]:
    """Return the smallest model within the error, or the best one within the size, and its measured PSNR in dB.

    The PSNR is that of the eigen BTF it opens as: of all steps, bases in halves and eight bits included.

    Raises:
        ConfigError: not exactly one budget, a rank out of range, or a budget that cannot be reached.
        ShapeError: a value of the BTF is not finite.
        SizeError: the table does not fit into memory.
    """
    n_view = len(btf.views)
    wanted = Budget(psnr=options.psnr, size=options.size)
    if options.rank is not None and not 1 <= options.rank <= n_view:
        raise ConfigError(f"compress.rank: expected 1 to {n_view} (the number of views), got {options.rank}")
    T = budget.in_memory(btf)
    peak = budget.peak_of(T)
    bases = [_basis(T, dim) for dim in (0, 1, 4)]
    bases[1] = bases[1][:, : options.rank]
    # (view, light, colour, H, W): one stream after the other
    C = cosines(torch.einsum("lvhwr,lj,vk,rc->kjchw", T, *bases))
    progress(0.3)

    # What bases leave out is lost at any step; the rest is counted among coefficients, without decoding.
    left_out = max(0.0, _energy(T) - _energy(C))

    def estimate(step: float) -> float:
        lost = _energy(C - _codes(C, step).float() * step) + left_out
        return budget.decibels(lost / T.numel(), peak)

    # Steps between the finest that codes can hold and one that leaves nothing.
    most = max(float(C.abs().max()), 1e-30)
    return budget.by_step(
        wanted,
        lambda step: _coded(C, step, bases, btf),
        (most / MOST_CODE, 2 * most),
        estimate=estimate,
        size=size,
        # Eight bits of the eigen maps and halves of the bases take a little more than the estimate knows.
        measure=lambda model: budget.psnr(T, model.expanded(), peak),
        more=", or give more rank" if options.rank else "",
        progress=lambda share: progress(0.3 + 0.6 * share),
    )


def size(model: TransformBtf) -> int:
    """Return the bytes of `model` on disk: streams, bases in halves, and room for the header."""
    bases = sum(x.numel() for x in (model.light_basis, model.view_basis, model.colour_basis))
    return sum(len(packed(codes)) for codes in model.codes) + 2 * bases + FREE_BYTES + 100 * len(model.codes)


def _coded(C: Tensor, step: float, bases: list[Tensor], btf: Bands) -> TransformBtf:
    codes = _codes(C, step)
    # Components and terms behind the last code that is not 0 are not stored.
    rank, terms = (max(1, int(used.nonzero().max()) + 1) if bool(used.any()) else 1 for used in _used(codes))
    light, view, colour = (b.half().float() for b in bases)
    return TransformBtf(
        codes=codes[:rank, :terms].contiguous(),
        light_basis=light[:, :terms],
        view_basis=view[:, :rank],
        colour_basis=colour,
        step=step,
        lights=btf.lights,
        views=btf.views,
    )


def _codes(C: Tensor, step: float) -> Tensor:
    return (C / step).abs_().add_(DEAD).floor_().mul_(C.sign()).clamp_(-MOST_CODE, MOST_CODE).to(torch.int16)


def _energy(x: Tensor) -> float:
    return float(torch.linalg.vector_norm(x, dtype=torch.float64)) ** 2


def _used(codes: Tensor) -> tuple[Tensor, Tensor]:
    used = (codes != 0).flatten(2).any(2)
    return used.any(1), used.any(0)


def _basis(T: Tensor, dim: int) -> Float[Tensor, "n n"]:
    """Return the eigenvectors of the Gram matrix along `dim`, the strongest first."""
    rows = T.movedim(dim, 0).flatten(1)
    gram = torch.zeros(len(rows), len(rows), dtype=torch.float64)
    for part in rows.split(1 << 16, 1):
        gram += (part @ part.T).double()
    return torch.linalg.eigh(gram).eigenvectors.flip(1).float()
