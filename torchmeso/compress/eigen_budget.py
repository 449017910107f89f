"""Fit an eigen BTF to a budget: the fewest components for an error, or the most that a size holds.

Weights over views are orthonormal, so what a rank leaves out is known from the Gram matrix before anything is fitted,
and what quantisation loses adds to it. With adaptive steps the rank is no choice: there is one step for all components,
and those below it have no codes.

Test: tests/compress/test_eigen_budget.py
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra.gram import right_basis
from torchmeso.compress import budget, eigen, quantize
from torchmeso.compress.budget import FREE_BYTES, Budget, Progress
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.quantize import Storage
from torchmeso.data import code_stream
from torchmeso.data.btf import Bands, Btf
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.errors import check_range

WORTH = 0.1
"""Of the squared step, the mean square from which on a component is kept; rounding errs by 1/12 of it."""

FINEST = 1e-6
"""Finest step, of the peak of T: a byte has coarser ones."""


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
        btf: up to `budget.MOST_BYTES` of values.
        wanted: the budget.
        storage: of the maps.
        rank: most components; None = all.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the rank is out of range, or the budget cannot be reached.
        ShapeError: a value of the BTF is not finite.
        SizeError: the table does not fit into memory.
    """
    n_view = len(btf.views)
    most = n_view if rank is None else rank
    check_range("compress.rank", most, 1, n_view)
    T = budget.in_memory(btf)
    table = Btf(images=T, lights=btf.lights, views=btf.views)
    total = eigen.gram_over_views(table, lambda share: progress(0.2 * share))
    more = ", or give more rank" if most < n_view else ""
    search = _adaptive if storage == "adaptive" else _ranked
    return search(table, wanted, total, most, storage, more, lambda share: progress(0.2 + 0.8 * share))


def _ranked(
    table: Btf,
    wanted: Budget,
    total: Float[Tensor, "view view"],
    most: int,
    storage: Storage,
    more: str,
    progress: Progress,
) -> tuple[EigenBtf, float]:
    """Choose a rank of maps that all have the same bits."""
    T = table.pictures()
    peak = budget.peak_of(T)
    left_out = _left_out(total) / T.numel()

    def model(rank: int) -> tuple[EigenBtf, float]:
        found = eigen.fit(table, EigenOptions(rank=rank, storage=storage))
        return found, budget.psnr(T, found, peak)

    if wanted.size is not None:
        each = T[:, 0].numel() * quantize.dtype_of(storage).itemsize + 4 * len(table.views) + 124
        if FREE_BYTES + each > wanted.size:
            raise budget.too_small(FREE_BYTES + each, wanted.size)
        return model(min(most, (wanted.size - FREE_BYTES) // each))
    assert wanted.psnr is not None
    lost = 0.0  # by quantisation
    rank = 1
    while True:
        # The first rank that leaves out little enough; a rank that was tried and missed is not tried again.
        while rank < most and budget.decibels(float(left_out[rank]) + lost, peak) < wanted.psnr:
            rank += 1
        found, reached = model(rank)
        if reached >= wanted.psnr:
            return found, reached
        if rank == most:
            raise budget.too_exact(reached, wanted.psnr, more)
        lost = max(0.0, peak**2 / 10 ** (reached / 10) - float(left_out[rank]))
        progress(rank / most)
        rank += 1


def _adaptive(
    table: Btf,
    wanted: Budget,
    total: Float[Tensor, "view view"],
    most: int,
    storage: Storage,
    more: str,
    progress: Progress,
) -> tuple[EigenBtf, float]:
    """Choose the step of all components."""
    T = table.pictures()
    peak = budget.peak_of(T)
    W = right_basis(total, most).vectors.float()
    maps = eigen.maps_of(table, W)
    spreads = [quantize.spread(maps[..., k, :]) for k in range(most)]
    gain = torch.full((most,), 1 / len(table.views))
    left_out = _left_out(total)

    # Mean squares of the maps, the largest first.
    power = (left_out[:-1] - left_out[1:]) / T[:, 0].numel()

    def model(d: float) -> EigenBtf:
        step = quantize.equal_steps(spreads, gain, d)
        # Of a component below its step next to all codes are 0: it would cost a picture more than it adds to it.
        rank = max(1, int((power[:most] > WORTH * step.amin(1).double().square()).sum()))
        found = quantize.one_by_one(maps[..., :rank, :], storage, step[:rank])
        return EigenBtf(
            maps=found.codes, weights=W[:, :rank], scale=found.scale, offset=found.offset,
            lights=table.lights, views=table.views,
        )  # fmt: skip

    def estimate(d: float) -> float:
        found = model(d)
        lost = float(left_out[found.rank])
        for k in range(found.rank):
            shown = found.offset[k] + found.scale[k] * found.maps[..., k, :].float()
            lost += float((shown - maps[..., k, :]).square_().sum(dtype=torch.float64))
        return budget.decibels(lost / T.numel(), peak)

    return budget.by_step(
        wanted,
        model,
        (FINEST * peak, quantize.coarsest(spreads, gain)),
        estimate=estimate,
        size=file_size,
        measure=lambda found: budget.psnr(T, found, peak),
        more=more,
        progress=progress,
    )


def file_size(model: EigenBtf) -> int:
    """Return the bytes of the file of a model with streams of codes."""
    streams = sum(len(code_stream.packed(codes)) for codes in model.maps.unbind(-2) if bool(codes.any()))
    return FREE_BYTES + streams + (4 * len(model.views) + 124) * model.rank


def _left_out(total: Float[Tensor, "view view"]) -> Float[Tensor, "rank"]:
    """Return the squared error of 0, 1, ..., all components."""
    values = torch.linalg.eigvalsh(total).clamp(min=0)
    return torch.cat([torch.zeros(1, dtype=torch.float64), values.cumsum(0)]).flip(0)
