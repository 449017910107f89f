"""Budgets of a fit: an error that may not be exceeded, or a size, and what every search for one shares.

PSNR here is of the values of T themselves, linear, with the 99.5th percentile of T as peak. Tables are read in bands:
once for their peak and their Gram matrices (`survey`), and once for every model that is held against them.

Test: tests/compress/test_budget.py
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra.gram import gram
from torchmeso.data import bands
from torchmeso.data.btf import Bands
from torchmeso.data.journal import Parts
from torchmeso.errors import ConfigError

SAMPLES = 2_000_000
"""Values at least that tell the peak of a table with more than that; torch sorts at most 16 million."""

NEAR, AIM = 0.98, 0.993
"""Share of a size from which on no finer step is looked for, and what is aimed at."""

MOST_TRIES = 8
"""Steps whose file is written to find one for a size."""

FREE_BYTES = 2048
"""Room left for the header of a file."""

Progress = Callable[[float], None]
Axis = Literal["light", "view", "colour"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Budget:
    """Exactly one of both.

    Attributes:
        psnr: least PSNR of T in dB; None = not asked for.
        size: most bytes of the file, without an MDF; None = not asked for.
    """

    psnr: float | None = None
    size: int | None = None

    def __post_init__(self) -> None:
        """Raise ConfigError unless there is exactly one budget."""
        if (self.psnr is None) == (self.size is None):
            raise ConfigError("compress: a budget expects --psnr or --size, and not both")

    def kept(self, psnr: float, size: int) -> bool:
        """Return whether a model of this PSNR and size keeps it."""
        return size <= self.size if self.size is not None else psnr >= (self.psnr or 0.0)


class Survey(NamedTuple):
    """What one pass over a table tells.

    Attributes:
        peak: the 99.5th percentile of T.
        values: how many there are.
        grams: Gram matrices in float64 over the axes that were asked for: light, view, colour.
    """

    peak: float
    values: int
    grams: dict[Axis, Float[Tensor, "n n"]]


def survey(btf: Bands, parts: Parts, over: Sequence[Axis] = (), progress: Progress = lambda share: None) -> Survey:
    """Return the peak of a table and its Gram matrices, from the band on that an earlier run stopped at.

    Matrices are summed texel row by texel row, so that bands of any height give the same bits.

    Raises:
        FormatError: the file on disk is damaged.
        ShapeError: a value of the BTF is not finite.
    """
    height, width = btf.texels
    sizes: dict[Axis, int] = {"light": len(btf.lights), "view": len(btf.views), "colour": 3}
    row_values = sizes["light"] * sizes["view"] * width * 3
    stride = max(1, row_values * height // SAMPLES)
    layout = bands.layout(btf)
    grams: dict[Axis, Tensor] = {axis: torch.zeros(sizes[axis], sizes[axis], dtype=torch.float64) for axis in over}
    fixed = sum(g.numel() for g in grams.values())
    sample: list[Tensor] = []

    def shape(rows: slice) -> tuple[int]:
        return (fixed + sum(len(range(-row * row_values % stride, row_values, stride)) for row in _each(rows)),)

    done = 0
    for rows in layout:
        if not parts.has(_survey_of(rows), shape(rows), torch.float64):
            break
        found = parts.read(_survey_of(rows), shape(rows), torch.float64)
        grams = dict(zip(over, _cut(found[:fixed], list(grams.values())), strict=True))
        sample.append(found[fixed:])
        done += 1
    for band in bands.ahead(btf, layout[done:]):
        own = []
        for row, samples in zip(_each(band.rows), bands.each_row(btf, band), strict=True):
            own.append(samples.flatten()[-row * row_values % stride :: stride].double())
            if over and bool(samples.any()):
                grams = {axis: g + gram([_with_columns(samples, axis)], sizes[axis]) for axis, g in grams.items()}
        sample.append(torch.cat(own))
        parts.write(_survey_of(band.rows), torch.cat([*(g.flatten() for g in grams.values()), sample[-1]]))
        progress(band.rows.stop / height)
    return Survey(_percentile(torch.cat(sample).float()), row_values * height, grams)


def _survey_of(rows: slice) -> str:
    return f"survey.{rows.start}-{rows.stop}"


def _each(rows: slice) -> range:
    return range(rows.start, rows.stop)


def _cut(flat: Tensor, like: list[Tensor]) -> list[Tensor]:
    parts = flat.split([x.numel() for x in like]) if like else []
    return [part.view_as(x) for part, x in zip(parts, like, strict=True)]


def _with_columns(samples: Float[Tensor, "light view W 3"], axis: Axis) -> Float[Tensor, "row n"]:
    """Return a row of texels as the matrix whose columns are lights, views or colours."""
    dim = {"light": 0, "view": 1, "colour": 3}[axis]
    return samples.movedim(dim, -1).reshape(-1, samples.shape[dim])


def squared_error(
    btf: Bands,
    opened: Callable[[slice], Callable[[int], Float[Tensor, "light view W 3"]]],
    progress: Progress = lambda share: None,
) -> float:
    """Return the squared error of a model over all values of its table, which is read in bands.

    Args:
        btf: the table.
        opened: called with a band; returns what gives the values that the model has in row 0, 1, ... of it.
        progress: called with the share done, 0..1.
    """
    total = 0.0
    for band in bands.ahead(btf, bands.layout(btf)):
        row_of = opened(band.rows)
        for at, samples in enumerate(bands.each_row(btf, band)):
            total += float((row_of(at) - samples).square_().sum(dtype=torch.float64))
        progress(band.rows.stop / btf.texels[0])
    return total


def once(parts: Parts, name: str, number: Callable[[], float]) -> float:
    """Return a number that an earlier run found, or find and keep it."""
    if not parts.has(name, (1,), torch.float64):
        parts.write(name, torch.tensor([number()], dtype=torch.float64))
    return float(parts.read(name, (1,), torch.float64))


class Estimate(NamedTuple):
    """What a step is thought to give without trying it: PSNR in dB, bytes of the file."""

    psnr: float
    size: float


def by_step(
    wanted: Budget,
    steps: tuple[float, float],
    *,
    estimate: Callable[[float], Estimate],
    size: Callable[[float], int],
    measure: Callable[[float], float],
    more: str = "",
    progress: Progress = lambda share: None,
) -> tuple[float, float]:
    """Return the coarsest step within the error, or the finest one within the size, and its measured PSNR in dB.

    Sizes and errors are measured a few times only: what an estimate is off by at one step corrects it at the next.

    Args:
        wanted: the budget.
        steps: the finest and the coarsest.
        estimate: of a step; the finer, the larger both.
        size: bytes of the file of a step.
        measure: PSNR of a step.
        more: what would help besides where an error cannot be reached.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the budget cannot be reached.
    """
    finest, coarsest = math.log(steps[0]), math.log(steps[1])
    if wanted.size is not None:
        step = math.exp(_within(wanted.size, finest, coarsest, lambda x: estimate(x).size, size, progress))
        return step, measure(step)
    assert wanted.psnr is not None
    allowed = 10 ** (-wanted.psnr / 10)  # squared error, the peak being 1
    beyond = 0.0  # what estimates do not know of
    log_step = coarsest
    while True:
        limit = -10 * math.log10(allowed - beyond) if allowed > beyond else math.inf
        found = _edge(finest, coarsest, lambda x, limit=limit: estimate(math.exp(x)).psnr >= limit)
        log_step = max(finest, min(found, log_step - 0.02))
        reached = measure(math.exp(log_step))
        if reached >= wanted.psnr:
            return math.exp(log_step), reached
        if log_step <= finest:
            raise too_exact(reached, wanted.psnr, more)
        beyond = 1.02 * (10 ** (-reached / 10) - 10 ** (-estimate(math.exp(log_step)).psnr / 10))


def _within(
    room: int,
    finest: float,
    coarsest: float,
    estimate: Callable[[float], float],
    size: Callable[[float], int],
    progress: Progress,
) -> float:
    """Return the logarithm of the finest step whose file keeps to `room`, to within `NEAR` of it."""
    too_fine, fits, factor = finest, coarsest, 1.0
    known = False  # whether `fits` was tried
    for at in range(MOST_TRIES):
        step = _edge(coarsest, finest, lambda x, factor=factor: factor * estimate(math.exp(x)) <= AIM * room)
        if not too_fine < step < fits:
            step = coarsest if not known and step >= coarsest else (too_fine + fits) / 2
        found = size(math.exp(step))
        if found > room and step >= coarsest:
            raise too_small(found, room)
        too_fine, fits, known = (too_fine, step, True) if found <= room else (step, fits, known)
        progress((at + 1) / MOST_TRIES)
        if (found <= room and found >= NEAR * room) or fits - too_fine < 0.003:
            break
        factor = found / max(1.0, estimate(math.exp(step)))
    if not known and (least := size(math.exp(fits))) > room:
        raise too_small(least, room)
    return fits


def too_small(least: float, room: int) -> ConfigError:
    """Return what to say where no model is as small as asked for."""
    return ConfigError(f"compress.size: {room} bytes cannot be reached, {least:.0f} is the least; give more room")


def too_exact(best: float, wanted: float, more: str = "") -> ConfigError:
    """Return what to say where no model is as exact as asked for; `more` is what would help besides."""
    said = f"compress.psnr: {wanted:g} dB cannot be reached, {best:.1f} dB is the best here"
    return ConfigError(f"{said}; ask for less{more}")


def _edge(good: float, bad: float, fits: Callable[[float], bool]) -> float:
    """Return the value next to `bad` that still fits, between `good` and `bad`."""
    for _ in range(16):
        middle = (good + bad) / 2
        good, bad = (middle, bad) if fits(middle) else (good, middle)
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


def psnr_of(T: Float[Tensor, "light view H W 3"], shown: Float[Tensor, "light view H W 3"]) -> float:
    """Return the PSNR in dB of a decoded table, measured as `psnr` does."""
    return decibels(float((shown - T).square().mean(dtype=torch.float64)), peak_of(T))


def decibels(error: float, peak: float) -> float:
    """Return the PSNR in dB of a mean squared error."""
    return math.inf if error <= 0 else 10 * math.log10(peak**2 / error)


def peak_of(T: Float[Tensor, "light view H W 3"]) -> float:
    """Return the 99.5th percentile of a table in memory, from the values that `survey` takes."""
    stride = max(1, T.numel() // SAMPLES)
    size = T[:, :, 0].numel()
    return _percentile(torch.cat([T[:, :, r].flatten()[-r * size % stride :: stride] for r in range(T.shape[2])]))


def _percentile(values: Float[Tensor, "value"]) -> float:
    return max(float(torch.quantile(values, 0.995)), 1e-30)
