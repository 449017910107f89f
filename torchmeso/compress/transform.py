"""Fit a transform-coded BTF to a budget: an error that may not be exceeded, or a size.

The bases of light, view and colour are eigenvectors of the table's Gram matrices (the best for a product of bases),
the texture is cut into blocks of cosines. All are orthonormal, so an error of a coefficient is the same error of T,
and one step for all coefficients spends bits where variance is: a coefficient below half a step is not stored.

PSNR here is of the values of T themselves, linear, with the 99.5th percentile of T as peak.

Test: tests/compress/test_transform.py
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data.btf import Bands
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.transform_btf import TransformBtf, cosines, packed
from torchmeso.errors import ConfigError, SizeError

MOST_BYTES = 4 << 30
"""Of the table as float32, which lies in memory twice while fitting."""

DEAD = 0.4
"""Added before rounding down: values a little above half a step become 0 too, which saves more than it costs."""

MOST_CODE = 32000
FREE_BYTES = 2048
"""Room left for the header of the file."""

Progress = Callable[[float], None]


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
    height, width = btf.texels
    n_view = len(btf.views)
    if (options.psnr is None) == (options.size is None):
        raise ConfigError("compress: --method transform expects --psnr or --size, and not both")
    if options.rank is not None and not 1 <= options.rank <= n_view:
        raise ConfigError(f"compress.rank: expected 1 to {n_view} (the number of views), got {options.rank}")
    needed = 12 * len(btf.lights) * n_view * height * width
    if needed > MOST_BYTES:
        raise SizeError(
            f"compress: a transform-coded BTF is fitted in memory, up to {MOST_BYTES / 2**30:g} GiB, "
            f"this one has {needed / 2**30:.1f}; take --method eigen"
        )
    T = btf.rows(0, height)
    peak = _peak(T)
    bases = [_basis(T, dim) for dim in (0, 1, 4)]
    bases[1] = bases[1][:, : options.rank]
    # (view, light, colour, H, W): one stream after the other
    C = cosines(torch.einsum("lvhwr,lj,vk,rc->kjchw", T, *bases))
    progress(0.3)

    # What bases leave out is lost at any step; the rest is counted among coefficients, without decoding.
    left_out = max(0.0, _energy(T) - _energy(C))

    def coded(step: float) -> TransformBtf:
        return _coded(C, step, bases, btf)

    def estimate(step: float) -> float:
        lost = _energy(C - _codes(C, step).float() * step) + left_out
        return 10 * math.log10(peak**2 * T.numel() / max(lost, 1e-300))

    # Steps between the finest that codes can hold and one that leaves nothing.
    most = max(float(C.abs().max()), 1e-30)
    finest, coarsest = math.log(most / MOST_CODE), math.log(2 * most)
    if options.size is not None:
        room = options.size
        least = size(coded(math.exp(coarsest)))
        if least > room:
            raise ConfigError(f"compress.size: {room} bytes cannot be reached, {least} is the least; give more room")
        step = math.exp(_edge(coarsest, finest, lambda x: size(coded(math.exp(x))) <= room, progress))
        model = coded(step)
        return model, psnr(T, model.expanded(), peak)
    assert options.psnr is not None
    wanted = options.psnr
    log_step = _edge(finest, coarsest, lambda x: estimate(math.exp(x)) >= wanted, progress)
    while True:
        # Eight bits of the eigen maps and halves of the bases take a little more than the estimate knows.
        model = coded(math.exp(log_step))
        found = psnr(T, model.expanded(), peak)
        if found >= wanted:
            return model, found
        if log_step <= finest:
            raise ConfigError(
                f"compress.psnr: {wanted:g} dB cannot be reached, {found:.1f} dB is the best here; "
                f"ask for less{', or give more rank' if options.rank else ''}"
            )
        log_step = max(finest, log_step - max(0.02, 0.12 * (wanted - found)))


def _edge(good: float, bad: float, fits: Callable[[float], bool], progress: Progress) -> float:
    """Return the value next to `bad` that still fits, between `good` and `bad`."""
    for i in range(12):
        middle = (good + bad) / 2
        good, bad = (middle, bad) if fits(middle) else (good, middle)
        progress(0.3 + 0.05 * i)
    return good


def parse_size(text: str) -> int:
    """Return the bytes that "4MB", "300 kB" or "65536" say; units are powers of 1000.

    Raises:
        ConfigError: it is no size.
    """
    found = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?)\s*(k|M|G)?B?\s*", text)
    if found is None:
        raise ConfigError(f"compress.size: expected a size like 4MB, 300kB or 65536, got '{text}'")
    return int(float(found[1]) * {None: 1, "k": 1e3, "M": 1e6, "G": 1e9}[found[2]])


def size(model: TransformBtf) -> int:
    """Return the bytes of `model` on disk: streams, bases in halves, and room for the header."""
    bases = sum(x.numel() for x in (model.light_basis, model.view_basis, model.colour_basis))
    return sum(len(packed(codes)) for codes in model.codes) + 2 * bases + FREE_BYTES + 100 * len(model.codes)


def psnr(T: Float[Tensor, "light view H W 3"], model: EigenBtf, peak: float | None = None) -> float:
    """Return the PSNR in dB of `model` beside the table, linear, the 99.5th percentile of T as peak."""
    peak = _peak(T) if peak is None else peak
    total = 0.0
    E = model.decoded()
    for light, pictures in enumerate(T):
        shown = torch.einsum("hwkr,vk->vhwr", E[light], model.weights)
        total += float((shown - pictures).square().sum(dtype=torch.float64))
    return math.inf if total == 0 else 10 * math.log10(peak**2 * T.numel() / total)


def psnr_of(T: Float[Tensor, "light view H W 3"], shown: Float[Tensor, "light view H W 3"]) -> float:
    """Return the PSNR in dB of a decoded table, measured as `psnr` does."""
    error = float((shown - T).square().mean(dtype=torch.float64))
    return math.inf if error == 0 else 10 * math.log10(_peak(T) ** 2 / error)


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


def _peak(T: Tensor) -> float:
    """Return the 99.5th percentile of T, by every so many values: torch sorts at most 16 million."""
    values = T.flatten()[:: max(1, T.numel() // 2_000_000)]
    return max(float(torch.quantile(values, 0.995)), 1e-30)
