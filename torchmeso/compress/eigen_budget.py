"""Fit an eigen BTF to a budget: the fewest components for an error, or the most that a size holds.

Weights over views are orthonormal, so what a rank leaves out is known from the Gram matrix before anything is fitted,
and what quantisation loses adds to it. With adaptive steps the rank is no choice: there is one step for all components,
and those below it have no codes.

The table is read in bands, once for its Gram matrix, once for the eigen maps of every rank that is tried, and once to
measure the error of each; maps and codes lie in the job's parts, and one of them at a time is in memory.

Test: tests/compress/test_eigen_budget.py
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchmeso.algebra.gram import right_basis
from torchmeso.compress import budget, eigen, quantize
from torchmeso.compress.budget import FREE_BYTES, Budget, Estimate, Progress, Survey
from torchmeso.compress.kept_maps import KeptCodes, KeptMaps
from torchmeso.compress.quantize import Codes, Storage
from torchmeso.data import bands, code_stream
from torchmeso.data.btf import Bands
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.journal import InMemory, Parts
from torchmeso.errors import check_range

WORTH = 0.1
"""Of the squared step, the mean square from which on a component is kept; rounding errs by 1/12 of it."""

FINEST = 1e-6
"""Finest step, of the peak of T: a byte has coarser ones."""

TAIL = 0.01
"""Of the squared error allowed, what all components may have together that are not even looked at."""


class Fitted(NamedTuple):
    """An eigen BTF in parts of a job.

    Attributes:
        weights: (view, rank) W.
        codes: of the eigen maps, as `KeptCodes` keeps them: (H, light, W, 3).
        psnr: measured, in dB.
    """

    weights: Float[Tensor, "view rank"]
    codes: KeptCodes
    psnr: float

    def component(self, k: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return codes (light, H, W, 3), scale (3) and offset (3) of one eigen map."""
        codes, scale, offset = self.codes.of_map(k)
        return codes.movedim(0, 1), scale, offset


def fit(
    btf: Bands,
    wanted: Budget,
    *,
    storage: Storage = "uint8",
    rank: int | None = None,
    progress: Progress = lambda share: None,
) -> tuple[EigenBtf, float]:
    """Return the smallest model within the error, or the best one within the size, and its measured PSNR in dB.

    Args:
        btf: in memory or on disk.
        wanted: the budget.
        storage: of the maps.
        rank: most components; None = all.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the rank is out of range, or the budget cannot be reached.
        ShapeError: a value of the BTF is not finite.
    """
    found = search(btf, wanted, InMemory(), storage=storage, rank=rank, progress=progress)
    codes, scale, offset = zip(*map(found.component, range(found.codes.count)), strict=True)
    eigen_btf = EigenBtf(
        maps=torch.stack(codes, -2), weights=found.weights, scale=torch.stack(scale), offset=torch.stack(offset),
        lights=btf.lights, views=btf.views,
    )  # fmt: skip
    return eigen_btf, found.psnr


def search(
    btf: Bands,
    wanted: Budget,
    parts: Parts,
    *,
    storage: Storage = "uint8",
    rank: int | None = None,
    progress: Progress = lambda share: None,
) -> Fitted:
    """Return what `fit` returns, in `parts`: one map at a time is in memory. Raises as `fit`."""
    n_view = len(btf.views)
    most = n_view if rank is None else rank
    check_range("compress.rank", most, 1, n_view)
    found = budget.survey(btf, parts, ("view",), lambda share: progress(0.2 * share))
    more = ", or give more rank" if most < n_view else ""
    way = _adaptive if storage == "adaptive" else _ranked
    return way(btf, wanted, parts, found, most, storage, more, lambda share: progress(0.2 + 0.8 * share))


def _ranked(
    btf: Bands,
    wanted: Budget,
    parts: Parts,
    survey: Survey,
    most: int,
    storage: Storage,
    more: str,
    progress: Progress,
) -> Fitted:
    """Choose a rank of maps that all have the same bits."""
    total, peak = survey.grams["view"], survey.peak
    lost_behind = left_out(total) / survey.values

    def model(rank: int) -> Fitted:
        W = right_basis(total, rank).vectors.float()
        codes = kept_codes(parts, f"codes.{rank}", btf, rank, quantize.dtype_of(storage))
        if not codes.complete():
            maps = kept_scores(btf, W, parts, f"E.{rank}", lambda share: progress(0.5 * share))
            for k in range(rank):
                _keep(codes, k, quantize.quantize(maps.collected(k)[0][..., None, :], storage))
            maps.drop()
        found = budget.once(parts, f"psnr.{rank}", lambda: measured(btf, W, codes, peak, progress))
        return Fitted(W, codes, found)

    if wanted.size is not None:
        each = survey.values // len(btf.views) * quantize.dtype_of(storage).itemsize + 4 * len(btf.views) + 124
        if FREE_BYTES + each > wanted.size:
            raise budget.too_small(FREE_BYTES + each, wanted.size)
        return model(min(most, (wanted.size - FREE_BYTES) // each))
    assert wanted.psnr is not None
    lost = 0.0  # by quantisation
    rank = 1
    while True:
        # The first rank that leaves out little enough; a rank that was tried and missed is not tried again.
        while rank < most and budget.decibels(float(lost_behind[rank]) + lost, peak) < wanted.psnr:
            rank += 1
        found = model(rank)
        if found.psnr >= wanted.psnr:
            return found
        found.codes.drop()
        if rank == most:
            raise budget.too_exact(found.psnr, wanted.psnr, more)
        lost = max(0.0, peak**2 / 10 ** (found.psnr / 10) - float(lost_behind[rank]))
        rank += 1


def _adaptive(
    btf: Bands,
    wanted: Budget,
    parts: Parts,
    survey: Survey,
    most: int,
    storage: Storage,
    more: str,
    progress: Progress,
) -> Fitted:
    """Choose the step of all components."""
    total, peak, n_view = survey.grams["view"], survey.peak, len(btf.views)
    tail = left_out(total)
    if wanted.psnr is not None:
        # Components behind these are below the step of any model that just keeps the error: `WORTH` leaves them out.
        allowed = peak**2 / 10 ** (wanted.psnr / 10) * survey.values
        most = min(most, max(1, int((tail > TAIL * allowed).sum())))
    W = right_basis(total, most).vectors.float()
    maps = kept_scores(btf, W, parts, "E", lambda share: progress(0.4 * share))
    spreads = [quantize.spread(maps.collected(k)[0]) for k in range(most)]
    sample, gain = torch.stack([s.sample for s in spreads]), torch.full((most,), 1 / n_view)
    n_map = survey.values // n_view
    power = (tail[:-1] - tail[1:])[:most] / n_map  # mean squares of the maps, the largest first

    def coded(d: float) -> Float[Tensor, "rank 3"]:
        """Return the steps of the components that are kept."""
        step = quantize.equal_steps(spreads, gain, d)
        # Of a component below its step next to all codes are 0: it would cost a picture more than it adds to it.
        return step[: max(1, int((power > WORTH * step.amin(1).double().square()).sum()))]

    def estimate(d: float) -> Estimate:
        step = coded(d)[:, None]
        code = (sample[: len(step)] / step).round_()
        error = (sample[: len(step)] - code * step).square_().mean(dtype=torch.float64, dim=(1, 2)).sum() * n_map
        bits = (1 + code.abs()).log2_().mul_(1.5).mean(dtype=torch.float64, dim=(1, 2)).sum() * n_map
        lost = float(tail[len(step)] + error) / survey.values
        return Estimate(budget.decibels(lost, peak), FREE_BYTES + float(bits) / 8 + (4 * n_view + 124) * len(step))

    def quantised(k: int, step: Tensor) -> Codes:
        return quantize.quantize(maps.collected(k)[0][..., None, :], storage, step[k, None])

    def size(d: float) -> int:
        step = coded(d)
        streams = (_stream_bytes(quantised(k, step).codes[..., 0, :]) for k in range(len(step)))
        return FREE_BYTES + sum(streams) + (4 * n_view + 124) * len(step)

    def model(d: float) -> tuple[Tensor, KeptCodes]:
        step = coded(d)
        codes = kept_codes(parts, f"codes.{d!r}", btf, len(step), torch.uint8)
        if not codes.complete():
            for k in range(len(step)):
                _keep(codes, k, quantised(k, step))
        return W[:, : len(step)], codes

    d, found = budget.by_step(
        wanted,
        (FINEST * peak, quantize.coarsest(spreads, gain)),
        estimate=estimate,
        size=lambda d: int(budget.once(parts, f"size.{d!r}", lambda: size(d))),
        measure=lambda d: budget.once(parts, f"psnr.{d!r}", lambda: measured(btf, *model(d), peak)),
        more=more,
        progress=lambda share: progress(0.4 + 0.6 * share),
    )
    return Fitted(*model(d), found)


def kept_scores(
    btf: Bands, W: Float[Tensor, "view rank"], parts: Parts, name: str, progress: Progress = lambda share: None
) -> KeptMaps:
    """Return the eigen maps E = A W, (light, H, W, 3) each, those of bands that are not in `parts` yet computed."""
    layout, width = tuple(bands.layout(btf)), btf.texels[1]
    maps = KeptMaps(
        parts=parts, name=name, layout=layout, count=W.shape[1], before=(len(btf.lights),), after=(width, 3),
        dtype=torch.float32,
    )  # fmt: skip
    maps.keep_rows(btf, lambda samples: eigen.scores_of(samples, W), progress)
    return maps


def kept_codes(parts: Parts, name: str, btf: Bands, rank: int, dtype: torch.dtype) -> KeptCodes:
    """Return where the codes of eigen maps lie."""
    height, width = btf.texels
    shape = (height, len(btf.lights), width, 3)
    return KeptCodes(parts=parts, name=name, count=rank, shape=shape, dtype=dtype)


def _keep(codes: KeptCodes, k: int, found: Codes) -> None:
    codes.keep(k, found.codes[..., 0, :].movedim(1, 0), found.scale[0], found.offset[0])


def measured(
    btf: Bands,
    weights: Float[Tensor, "view rank"],
    codes: KeptCodes,
    peak: float,
    progress: Progress = lambda share: None,
) -> float:
    """Return the PSNR in dB of an eigen BTF whose maps are in parts, over all values of the table."""

    def opened(rows: slice) -> Callable[[int], Tensor]:
        row_of = codes.opened(rows)

        def shown(at: int) -> Tensor:
            E = row_of(at)  # (rank, light, W, 3)
            return (weights @ E.flatten(1)).unflatten(1, E.shape[1:]).movedim(0, 1)

        return shown

    error = budget.squared_error(btf, opened, progress)
    values = len(btf.lights) * len(btf.views) * btf.texels[0] * btf.texels[1] * 3
    return budget.decibels(error / values, peak)


def file_size(model: EigenBtf) -> int:
    """Return the bytes of the file of a model with streams of codes."""
    streams = sum(_stream_bytes(codes) for codes in model.maps.unbind(-2))
    return FREE_BYTES + streams + (4 * len(model.views) + 124) * model.rank


def _stream_bytes(codes: UInt8[Tensor, "light H W 3"]) -> int:
    return len(code_stream.packed(codes)) if bool(codes.any()) else 0


def left_out(total: Float[Tensor, "view view"]) -> Float[Tensor, "rank"]:
    """Return the squared error of 0, 1, ..., all components."""
    values = torch.linalg.eigvalsh(total).clamp(min=0)
    return torch.cat([torch.zeros(1, dtype=torch.float64), values.cumsum(0)]).flip(0)
