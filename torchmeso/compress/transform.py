"""Fit a transform-coded BTF to a budget: an error that may not be exceeded, or a size.

The bases of light, view and colour are eigenvectors of the table's Gram matrices (the best for a product of bases),
the texture is cut into blocks of cosines. All are orthonormal, so an error of a coefficient is the same error of T,
and one step for all coefficients spends bits where variance is: a coefficient below half a step is not stored.

The table is read in bands: for its Gram matrices, for its coefficients, and to measure the error. Coefficients lie in
the job's parts, four bytes for each value of the table, and those of one component of the view are in memory at a time.
Their histogram tells the error of every step without quantising anything, and about how large its file is.

Test: tests/compress/test_transform.py
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int16
from torch import Tensor

from torchmeso.algebra.gram import right_basis
from torchmeso.compress import budget, eigen_budget
from torchmeso.compress.budget import FREE_BYTES, Budget, Estimate, Progress, Survey
from torchmeso.compress.kept_maps import KeptMaps
from torchmeso.data import bands, transform_btf
from torchmeso.data.btf import Bands
from torchmeso.data.journal import InMemory, Parts
from torchmeso.data.transform_btf import TransformBtf, cosines, packed
from torchmeso.errors import ConfigError

DEAD = 0.4
"""Added before rounding down: values a little above half a step become 0 too, which saves more than it costs."""

MOST_CODE = 32000

OCTAVE, LOWEST, BINS = 32, -80, 5120
"""Bins of the histogram of absolute coefficients: to an octave, the logarithm of the lowest one, and in all."""

WIDE = 8
"""Steps from which on codes are taken to be spread evenly over what they stand for."""

TAIL = 1e-3
"""Of the squared error allowed, what components of the view have together that are not even looked at."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TransformOptions:
    """How to compress, to a budget.

    Attributes:
        rank: most components of the view, which is what drawing and memory cost; None = all.
    """

    rank: int | None = None


class Fitted(NamedTuple):
    """A transform-coded BTF in parts of a job.

    Attributes:
        maps: coefficients (term, 3, H, W) of each component, cosines along rows alone.
        rank: components that have codes.
        terms: of the light that have codes.
        bases: of light, view and colour, in halves, cut to these.
        step: of the codes.
        psnr: measured, in dB.
    """

    maps: KeptMaps
    rank: int
    terms: int
    bases: tuple[Tensor, Tensor, Tensor]
    step: float
    psnr: float

    def codes(self) -> Iterator[Int16[Tensor, "term 3 H W"]]:
        """Yield the codes of one component after the other."""
        return (_codes(_component(self.maps, k, self.terms), self.step) for k in range(self.rank))


def fit(
    btf: Bands,
    wanted: Budget,
    options: TransformOptions | None = None,
    *,
    progress: Progress = lambda share: None,
) -> tuple[TransformBtf, float]:
    """Return the smallest model within the error, or the best one within the size, and its measured PSNR in dB.

    The PSNR is that of the eigen BTF it opens as: of all steps, bases in halves and eight bits included.

    Args:
        btf: in memory or on disk.
        wanted: the budget.
        options: the rank.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the rank is out of range, or the budget cannot be reached.
        ShapeError: a value of the BTF is not finite.
    """
    found = search(btf, wanted, options or TransformOptions(), InMemory(), progress)
    light, view, colour = found.bases
    model = TransformBtf(
        codes=torch.stack(list(found.codes())), light_basis=light, view_basis=view, colour_basis=colour,
        step=found.step, lights=btf.lights, views=btf.views,
    )  # fmt: skip
    return model, found.psnr


def search(
    btf: Bands,
    wanted: Budget,
    options: TransformOptions,
    parts: Parts,
    progress: Progress = lambda share: None,
) -> Fitted:
    """Return what `fit` returns, in `parts`: one component at a time is in memory. Raises as `fit`."""
    n_view = len(btf.views)
    if options.rank is not None and not 1 <= options.rank <= n_view:
        raise ConfigError(f"compress.rank: expected 1 to {n_view} (the number of views), got {options.rank}")
    found = budget.survey(btf, parts, ("light", "view", "colour"), lambda share: progress(0.2 * share))
    left_out = eigen_budget.left_out(found.grams["view"])
    most = n_view if options.rank is None else options.rank
    if wanted.psnr is not None:
        allowed = found.peak**2 / 10 ** (wanted.psnr / 10) * found.values
        most = min(most, max(1, int((left_out > TAIL * allowed).sum())))
    ranks = len(btf.lights), most, 3
    bases = [right_basis(gram, n).vectors.float() for gram, n in zip(found.grams.values(), ranks, strict=True)]
    maps = _kept(btf, bases, parts, lambda share: progress(0.2 + 0.3 * share))
    histogram, largest = _statistics(maps, parts, lambda share: progress(0.5 + 0.1 * share))
    step, psnr = _step(
        btf, wanted, found, float(left_out[most]), bases, maps, histogram, largest,
        more=", or give more rank" if options.rank else "", progress=lambda share: progress(0.6 + 0.4 * share),
    )  # fmt: skip
    rank, terms = _used(largest, step)
    return Fitted(maps, rank, terms, _in_halves(bases, rank, terms), step, psnr)


def _step(
    btf: Bands,
    wanted: Budget,
    survey: Survey,
    left_out: float,
    bases: Sequence[Tensor],
    maps: KeptMaps,
    histogram: Float[Tensor, "2 bin"],
    largest: Float[Tensor, "rank term"],
    *,
    more: str,
    progress: Progress,
) -> tuple[float, float]:
    """Return the step that keeps the budget, and its measured PSNR in dB."""
    parts = maps.parts

    def estimate(step: float) -> Estimate:
        lost, bits = _expected(histogram, step)
        # What bases leave out is lost at any step.
        return Estimate(budget.decibels((lost + left_out) / survey.values, survey.peak), bits / 8 + FREE_BYTES)

    def size(step: float) -> int:
        rank, terms = _used(largest, step)
        streams = sum(len(packed(_codes(_component(maps, k, terms), step))) for k in range(rank))
        return streams + _fixed(len(btf.lights) * terms + len(btf.views) * rank + 9, rank)

    def measured(step: float) -> float:
        """Open the model: eight bits of the eigen maps and halves of the bases take a little too."""
        rank, terms = _used(largest, step)
        light, view, colour = _in_halves(bases, rank, terms)
        codes = eigen_budget.kept_codes(parts, f"opened.{step!r}", btf, rank, torch.uint8)
        for k in range(rank):
            opened = transform_btf.opened(_codes(_component(maps, k, terms), step), step, light, colour)
            codes.keep(k, opened[0].movedim(1, 0), *opened[1:])
        reached = eigen_budget.measured(btf, view, codes, survey.peak)
        codes.drop()
        return reached

    # Steps between the finest that codes can hold and one that leaves nothing.
    most = max(float(largest.max()), 1e-30)
    return budget.by_step(
        wanted,
        (most / MOST_CODE, 2 * most),
        estimate=estimate,
        size=lambda step: int(budget.once(parts, f"size.{step!r}", lambda: size(step))),
        measure=lambda step: budget.once(parts, f"psnr.{step!r}", lambda: measured(step)),
        more=more,
        progress=progress,
    )


def size(model: TransformBtf) -> int:
    """Return the bytes of `model` on disk: streams, bases in halves, and room for the header."""
    bases = sum(x.numel() for x in (model.light_basis, model.view_basis, model.colour_basis))
    return sum(len(packed(codes)) for codes in model.codes) + _fixed(bases, len(model.codes))


def _fixed(bases: int, rank: int) -> int:
    return 2 * bases + FREE_BYTES + 100 * rank


def _kept(btf: Bands, bases: Sequence[Tensor], parts: Parts, progress: Progress) -> KeptMaps:
    """Return the coefficients of all components, those of bands that are not in `parts` yet computed."""
    maps = KeptMaps(
        parts=parts, name="C", layout=tuple(bands.layout(btf)), count=bases[1].shape[1],
        before=(bases[0].shape[1], 3), after=(btf.texels[1],), dtype=torch.float32,
    )  # fmt: skip
    light, view, colour = bases

    def of_row(samples: Float[Tensor, "light view W 3"]) -> Float[Tensor, "rank term 3 W"]:
        over_view = view.T @ samples.flatten(2)  # (light, rank, W 3)
        over_light = (light.T @ over_view.flatten(1)).unflatten(1, (-1, samples.shape[2], 3))
        return cosines((over_light @ colour).permute(1, 0, 3, 2), along=(-1,))

    maps.keep_rows(btf, of_row, progress)
    return maps


def _component(maps: KeptMaps, k: int, terms: int | None = None) -> Float[Tensor, "term 3 H W"]:
    return cosines(maps.collected(k)[0, :terms], along=(-2,))


def _statistics(
    maps: KeptMaps, parts: Parts, progress: Progress
) -> tuple[Float[Tensor, "2 bin"], Float[Tensor, "rank term"]]:
    """Return the histogram of absolute coefficients (counts, sums of squares) and the largest one of each term."""
    shapes = {"histogram": (2, BINS), "largest": (maps.count, maps.before[0])}
    if not all(parts.has(name, shape, torch.float64) for name, shape in shapes.items()):
        histogram, largest = (torch.zeros(shape, dtype=torch.float64) for shape in shapes.values())
        for k in range(maps.count):
            C = _component(maps, k).abs_()
            largest[k] = C.flatten(1).amax(1)
            for term in C:  # copies of all would be large
                live = term[term > 0]
                place = ((live.log2() - LOWEST) * OCTAVE).long().clamp_(0, BINS - 1)
                histogram[0] += torch.bincount(place, minlength=BINS)
                histogram[1] += torch.bincount(place, live.double().square_(), minlength=BINS)
            progress((k + 1) / maps.count)
        parts.write("histogram", histogram)
        parts.write("largest", largest)
    histogram, largest = (parts.read(name, shape, torch.float64) for name, shape in shapes.items())
    return histogram, largest


def _expected(histogram: Float[Tensor, "2 bin"], step: float) -> tuple[float, float]:
    """Return the squared error of a step, and about how many bits its codes have."""
    count, square = histogram
    size = (square / count.clamp(min=1)).sqrt() / step
    code = (size + DEAD).floor()
    # Rounding errs evenly between -DEAD and 1 - DEAD steps where codes are large.
    spread = (DEAD**3 + (1 - DEAD) ** 3) / 3
    lost = torch.where(size > WIDE, spread, (size - code).square()) * count * step**2
    lost = torch.where(code > 0, lost, square)
    return float(lost.sum()), float((count * (code > 0) * (2 + (1 + code).log2())).sum())


def _used(largest: Float[Tensor, "rank term"], step: float) -> tuple[int, int]:
    """Return up to where components and terms have a code that is not 0; what is behind is not stored."""
    live = largest.float() / step + DEAD >= 1
    return _extent(live.any(1)), _extent(live.any(0))


def _extent(used: Bool[Tensor, "n"]) -> int:
    return int(used.nonzero().max()) + 1 if bool(used.any()) else 1


def _in_halves(bases: Sequence[Tensor], rank: int, terms: int) -> tuple[Tensor, Tensor, Tensor]:
    light, view, colour = (basis.half().float() for basis in bases)
    return light[:, :terms], view[:, :rank], colour


def _codes(C: Tensor, step: float) -> Int16[Tensor, "*batch"]:
    codes = (C / step).abs_().add_(DEAD).floor_()
    return codes.copysign_(C).clamp_(-MOST_CODE, MOST_CODE).to(torch.int16)
