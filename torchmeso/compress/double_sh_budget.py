"""Fit a double-SH BTF to a budget: the coefficients of light and view that an error needs, or that a size holds.

What coefficients leave out follows from no matrix at hand: their energy is bounded, texel by texel. All pairs of whole
bands that the directions tell apart are therefore fitted to a few rows of texels, which tells size and error of each,
and the best one to the whole texture; where that is not what its rows promised, the next best. With adaptive steps
every pair is tried with finer and coarser ones.

The table is read in bands: once for its peak, its few rows, and twice for every pair that is fitted to all of it, to
fit and to measure. Coefficients and codes lie in the job's parts.

Test: tests/compress/test_double_sh_budget.py
"""

import itertools
import math
from collections.abc import Callable, Iterator
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
from torchmeso.compress.kept_maps import KeptCodes, KeptMaps
from torchmeso.data import bands as rows_of
from torchmeso.data import code_stream
from torchmeso.data.btf import Bands, Btf
from torchmeso.data.journal import InMemory, Parts
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


class Fitted(NamedTuple):
    """A double-SH BTF in parts of a job.

    Attributes:
        terms: k_l and k_v.
        codes: of the coefficients (0,0), (0,1), ..., as `KeptCodes` keeps them.
        psnr: measured, in dB.
    """

    terms: tuple[int, int]
    codes: KeptCodes
    psnr: float

    def coefficients(self, i: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return codes (k_v, H, W, 3), scale (k_v, 3) and offset (k_v, 3) of coefficients (i, 0), (i, 1), ..."""
        first = i * self.terms[1]
        found = zip(*map(self.codes.of_map, range(first, first + self.terms[1])), strict=True)
        codes, scale, offset = (torch.stack(x) for x in found)
        return codes, scale, offset


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
        btf: in memory or on disk.
        wanted: the budget.
        options: bound of the energy and storage, and the most coefficients.
        backend: torch, opencl, or auto.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the budget cannot be reached.
        ShapeError: a value of the BTF is not finite.
    """
    found = search(btf, wanted, options, InMemory(), backend=backend, progress=progress)
    maps, scale, offset = (torch.stack(x) for x in zip(*map(found.coefficients, range(found.terms[0])), strict=True))
    return ShBtf(maps=maps, scale=scale, offset=offset, lights=btf.lights, views=btf.views), found.psnr


def search(
    btf: Bands,
    wanted: Budget,
    options: DoubleShOptions,
    parts: Parts,
    *,
    backend: BackendChoice = "torch",
    progress: Progress = lambda share: None,
) -> Fitted:
    """Return what `fit` returns, in `parts`: the coefficients of one of the light are in memory. Raises as `fit`."""
    peak = budget.survey(btf, parts, (), lambda share: progress(0.2 * share)).peak
    found = list(_candidates(btf, peak, options, backend, lambda share: progress(0.2 + 0.4 * share)))
    coded = options.storage == "adaptive"
    best: tuple[Candidate, float] | None = None
    reached, least = max(x.psnr for x in found), min(x.size for x in found)
    tried: list[Candidate] = []
    while len(tried) < MOST_TRIES and (candidate := _next(found, tried, wanted, best is not None)) is not None:
        codes = _fitted(btf, candidate, options, parts, backend)
        name = f"{codes.name}.tried"
        size = int(budget.once(parts, f"{name}.size", lambda c=candidate, q=codes: _size(c, q, coded)))
        error = budget.once(parts, f"{name}.psnr", lambda c=candidate, q=codes: _measured(btf, c, q, peak))
        # What was measured counts, not what rows said.
        reached, least = (max(reached, error), min(least, size)) if tried else (error, size)
        if wanted.kept(error, size) and (best is None or error > best[1]):
            best = candidate, error
        if best is not None and (wanted.psnr is not None or not coded):
            break
        # Streams of a few rows are longer for what they hold: all sizes are corrected by what this one was off.
        found = [x._replace(size=x.size * size / candidate.size) for x in found]
        tried = [*tried, candidate]
        progress(0.6 + 0.4 * len(tried) / MOST_TRIES)
    if best is not None:
        progress(1.0)
        terms = best[0].light_terms, best[0].view_terms
        return Fitted(terms, _fitted(btf, best[0], options, parts, backend), best[1])
    if wanted.psnr is not None:
        raise budget.too_exact(reached, wanted.psnr)
    assert wanted.size is not None
    raise budget.too_small(least, wanted.size)


def _fitted(
    btf: Bands, candidate: Candidate, options: DoubleShOptions, parts: Parts, backend: BackendChoice
) -> KeptCodes:
    """Return the codes of a pair, fitted to the whole texture where they are not in `parts` yet."""
    height, width = btf.texels
    k_l, k_v, share = candidate[:3]
    codes = KeptCodes(
        parts=parts, name=f"codes.{k_l}.{k_v}.{share}", count=k_l * k_v, shape=(height, width, 3),
        dtype=quantize.dtype_of(options.storage),
    )  # fmt: skip
    if codes.complete():
        return codes
    light, view = double_sh.sides(btf, replace(options, light_terms=k_l, view_terms=k_v))
    maps = KeptMaps(
        parts=parts, name=f"c.{k_l}.{k_v}", layout=tuple(rows_of.layout(btf)), count=k_l * k_v, before=(),
        after=(width * 3,), dtype=torch.float16,
    )  # fmt: skip
    maps.keep(double_sh.coefficients(btf, light, view, maps.todo(), backend=backend))
    step = None
    if options.storage == "adaptive":
        lost = double_sh.left_out(btf, light, view, maps.row)
        spreads = [quantize.spread(maps.collected(k)[0].unflatten(1, (width, 3))) for k in range(codes.count)]
        step = quantize.steps(spreads, double_sh.gain(light, view), lost, share)
    for k in range(codes.count):
        c = maps.collected(k).unflatten(2, (width, 3))
        found, scale, offset = double_sh.quantised(c, options.storage, None if step is None else step[k : k + 1])
        codes.keep(k, found[0], scale[0], offset[0])
    return codes


def _measured(btf: Bands, candidate: Candidate, codes: KeptCodes, peak: float) -> float:
    """Return the PSNR in dB of a pair over all values of the table."""
    terms = candidate.light_terms, candidate.view_terms
    y_light, y_view = _bases((btf.lights, btf.views), terms)

    def opened(rows: slice) -> Callable[[int], Tensor]:
        row_of = codes.opened(rows)

        def shown(at: int) -> Tensor:
            c = row_of(at).flatten(1).unflatten(0, terms)  # (k_l, k_v, W 3)
            return (y_light @ (y_view @ c).flatten(1)).unflatten(1, (len(y_view), -1, 3))

        return shown

    error = budget.squared_error(btf, opened)
    values = len(btf.lights) * len(btf.views) * btf.texels[0] * btf.texels[1] * 3
    return budget.decibels(error / values, peak)


def _size(candidate: Candidate, codes: KeptCodes, coded: bool) -> int:
    """Return the bytes of the file of a pair, or a little more."""
    k_l, k_v = candidate.light_terms, candidate.view_terms
    whole = math.prod(codes.shape) * codes.dtype.itemsize * codes.count
    if not coded:
        return _plain_bytes(k_l, k_v, whole)

    def stream(i: int, view: slice) -> int:
        band = torch.stack([codes.of_map(i * k_v + k)[0] for k in range(view.start, view.stop)])
        return _stream_bytes(band)

    return FREE_BYTES + sum(stream(i, view) for i in range(k_l) for view in bands(k_v)) + 24 * k_l * k_v


def file_size(model: ShBtf, *, coded: bool) -> int:
    """Return the bytes of the file of a model, or a little more."""
    k_l, k_v = model.terms
    if not coded:
        return _plain_bytes(k_l, k_v, model.maps.nbytes)
    streams = (_stream_bytes(row[view]) for row in model.maps for view in bands(k_v))
    return FREE_BYTES + sum(streams) + 24 * k_l * k_v


def _plain_bytes(k_l: int, k_v: int, maps: int) -> int:
    return FREE_BYTES + 100 * len(bands(k_l)) * len(bands(k_v)) + maps + 24 * k_l * k_v


def _stream_bytes(codes: Tensor) -> int:
    return len(code_stream.packed(codes)) + 100 if bool(codes.any()) else 0


def _candidates(
    btf: Bands, peak: float, options: DoubleShOptions, backend: BackendChoice, progress: Progress
) -> Iterator[Candidate]:
    """Yield every pair of whole bands that the directions tell apart, with every step."""
    height, width = btf.texels
    count = min(height, max(double_sh.ROWS, -(-COLUMNS // (3 * width))))
    rows = [n * height // count for n in range(count)]
    T = torch.cat([btf.rows(row, row + 1) for row in rows], 2)
    few = Btf(images=T, lights=btf.lights, views=btf.views)
    coded = options.storage == "adaptive"
    sides = [
        [n for n in TERMS if n <= most and _told_apart(what, directions, n, options)]
        for what, directions, most in (
            ("light", btf.lights, options.light_terms),
            ("view", btf.views, options.view_terms),
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
            yield Candidate(light_terms, view_terms, share, _psnr(T, model, peak), size)
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


def _psnr(T: Float[Tensor, "light view H W 3"], model: ShBtf, peak: float) -> float:
    """Return the PSNR in dB of a model beside a small table."""
    y_light, y_view = _bases((model.lights, model.views), model.terms)
    shown = torch.einsum("li,vj,ijhwc->lvhwc", y_light, y_view, model.decoded())
    return budget.decibels(float((shown - T).square().mean(dtype=torch.float64)), peak)


def _bases(directions: tuple[DirectionSet, DirectionSet], terms: tuple[int, int]) -> list[Tensor]:
    return [basis(side.directions(), degree_of(n)).float() for side, n in zip(directions, terms, strict=True)]
