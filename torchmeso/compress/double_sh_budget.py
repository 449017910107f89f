"""Fit a double-SH BTF to a budget: the coefficients of light and view that an error needs, or that a size holds.

What coefficients leave out follows from no matrix at hand: their energy is bounded, texel by texel. All pairs of whole
bands that the directions tell apart are therefore fitted to a few rows of texels, which tells size and error of each,
and the best one to the whole texture; where that is not what its rows promised, the next best. With adaptive steps
every pair is tried with finer and coarser ones.

Test: tests/compress/test_double_sh_budget.py
"""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra.spherical_harmonics import basis, degree_of
from torchmeso.backends import BackendChoice
from torchmeso.compress import budget, double_sh, quantize
from torchmeso.compress.budget import FREE_BYTES, Budget, Progress
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.data import code_stream
from torchmeso.data.btf import Bands, Btf
from torchmeso.data.sh_btf import ShBtf, bands
from torchmeso.errors import ConfigError
from torchmeso.geometry.hemisphere import DirectionSet

TERMS = (1, 4, 9, 16, 25, 36)

SHARES = (quantize.SHARE, 0.15, 0.6)
"""Of the squared error that a pair has, what adaptive steps are tried to add to it."""

APART = 2
"""Degrees by which light and view may differ: pairs that are farther apart never came out best."""

COLUMNS = 512
"""Texels and channels that tell size and error of a pair, at least."""

MARGIN_DB, MARGIN = 0.2, 1.25
"""By which a few rows may say less, and in bytes more, than is true of the whole texture."""

MOST_TRIES = 6
"""Fits of the whole texture."""


class Candidate(NamedTuple):
    """Coefficients and steps, and what a few rows say of their size and error."""

    light_terms: int
    view_terms: int
    share: float
    psnr: float
    size: float


def fit(
    btf: Bands,
    wanted: Budget,
    options: DoubleShOptions,
    *,
    backend: BackendChoice = "torch",
    progress: Progress = lambda share: None,
) -> tuple[ShBtf, float]:
    """Return the smallest model within the error, or the best one within the size, and its measured PSNR in dB.

    Args:
        btf: up to `budget.MOST_BYTES` of values.
        wanted: the budget.
        options: bound of the energy and storage, and the most coefficients.
        backend: torch, opencl, or auto.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the budget cannot be reached.
        ShapeError: a value of the BTF is not finite.
        SizeError: the table does not fit into memory.
    """
    T = budget.in_memory(btf)
    peak = budget.peak_of(T)
    table = Btf(images=T, lights=btf.lights, views=btf.views)
    found = list(_candidates(table, peak, options, backend, lambda share: progress(0.7 * share)))
    kept: list[tuple[float, ShBtf]] = []
    reached, least = max(x.psnr for x in found), min(x.size for x in found)
    tried: list[Candidate] = []
    while len(tried) < MOST_TRIES and (candidate := _next(found, tried, wanted, bool(kept))) is not None:
        model = _fitted(table, candidate, options, backend)
        error, size = psnr(T, model, peak), file_size(model, coded=options.storage == "adaptive")
        # What was measured counts, not what rows said.
        reached, least = (max(reached, error), min(least, size)) if tried else (error, size)
        if wanted.kept(error, size):
            kept.append((error, model))
            if wanted.psnr is not None or options.storage != "adaptive":
                break
        # Streams of a few rows are longer for what they hold: all sizes are corrected by what this one was off.
        found = [x._replace(size=x.size * size / candidate.size) for x in found]
        tried = [*tried, candidate]
        progress(0.7 + 0.3 * len(tried) / MOST_TRIES)
    progress(1.0)
    if kept:
        best, model = max(kept, key=lambda x: x[0])
        return model, best
    if wanted.psnr is not None:
        raise budget.too_exact(reached, wanted.psnr)
    assert wanted.size is not None
    raise budget.too_small(least, wanted.size)


def psnr(T: Float[Tensor, "light view H W 3"], model: ShBtf, peak: float) -> float:
    """Return the PSNR in dB of `model` beside its table, as `budget.psnr` has it."""
    C = model.decoded()
    y_light, y_view = _bases(model)
    total = 0.0
    for y, pictures in zip(y_light, T, strict=True):
        shown = torch.einsum("i,vj,ijhwc->vhwc", y, y_view, C)
        total += float((shown - pictures).square().sum(dtype=torch.float64))
    return budget.decibels(total / T.numel(), peak)


def file_size(model: ShBtf, *, coded: bool) -> int:
    """Return the bytes of the file of a model, or a little more."""
    k_l, k_v = model.terms
    if not coded:
        return FREE_BYTES + 100 * len(bands(k_l)) * len(bands(k_v)) + model.maps.nbytes + 24 * k_l * k_v
    streams = [
        len(code_stream.packed(codes)) + 100
        for row in model.maps
        for codes in (row[view] for view in bands(k_v))
        if bool(codes.any())
    ]
    return FREE_BYTES + sum(streams) + 24 * k_l * k_v


def _candidates(
    table: Btf, peak: float, options: DoubleShOptions, backend: BackendChoice, progress: Progress
) -> Iterator[Candidate]:
    """Yield every pair of whole bands that the directions tell apart, with every step."""
    T = table.pictures()
    height, width = table.texels
    count = min(height, max(double_sh.ROWS, -(-COLUMNS // (3 * width))))
    rows = torch.arange(count) * height // count
    few = Btf(images=T[:, :, rows].contiguous(), lights=table.lights, views=table.views)
    coded = options.storage == "adaptive"
    sides = [
        [n for n in TERMS if n <= most and _told_apart(what, directions, n, options)]
        for what, directions, most in (
            ("light", table.lights, options.light_terms),
            ("view", table.views, options.view_terms),
        )
    ]
    pairs = [(k_l, k_v) for k_l, k_v in itertools.product(*sides) if abs(degree_of(k_l) - degree_of(k_v)) <= APART]
    for at, (light_terms, view_terms) in enumerate(pairs):
        chosen = replace(options, light_terms=light_terms, view_terms=view_terms)
        light, view = double_sh.sides(few, chosen)
        c = double_sh.whole(few, light, view, backend=backend)
        for share in SHARES if coded else SHARES[:1]:
            model = double_sh.model_of(few, light, view, c, options.storage, share)
            fixed = FREE_BYTES + 24 * light_terms * view_terms
            size = fixed + (file_size(model, coded=coded) - fixed) * height / count
            yield Candidate(light_terms, view_terms, share, psnr(few.pictures(), model, peak), size)
        progress((at + 1) / len(pairs))


def _told_apart(what: str, directions: DirectionSet, terms: int, options: DoubleShOptions) -> bool:
    try:
        double_sh.side(what, directions, terms, options)
    except ConfigError:
        return False
    return True


def _next(found: list[Candidate], tried: list[Candidate], wanted: Budget, kept: bool) -> Candidate | None:
    """Return the best that was not tried and may keep the budget; once it is `kept`, only one that promises more."""
    done = [x[:3] for x in tried]
    if wanted.psnr is not None:
        left = (x for x in found if x.psnr > wanted.psnr - MARGIN_DB and x[:3] not in done)
        return min(left, key=lambda x: x.size, default=None)
    room = wanted.size or 0
    fitting = [x for x in found if x.size <= room]
    left = [x for x in fitting if x[:3] not in done]
    if left and max(x.psnr for x in left) >= max(x.psnr for x in fitting):
        return max(left, key=lambda x: x.psnr)
    if kept:
        return None
    return min((x for x in found if x.size <= MARGIN * room and x[:3] not in done), key=lambda x: x.size, default=None)


def _fitted(table: Btf, candidate: Candidate, options: DoubleShOptions, backend: BackendChoice) -> ShBtf:
    chosen = replace(options, light_terms=candidate.light_terms, view_terms=candidate.view_terms)
    light, view = double_sh.sides(table, chosen)
    c = double_sh.whole(table, light, view, backend=backend)
    return double_sh.model_of(table, light, view, c, options.storage, candidate.share)


def _bases(model: ShBtf) -> list[Tensor]:
    sides = zip((model.lights, model.views), model.terms, strict=True)
    return [basis(side.directions(), degree_of(n)).float() for side, n in sides]
