"""Budgets of a fit: an error that may not be exceeded, or a size, and what every search for one shares.

PSNR here is of the values of T themselves, linear, with the 99.5th percentile of T as peak.

Test: tests/compress/test_budget.py
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data.btf import Bands
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.errors import ConfigError, SizeError

MOST_BYTES = 4 << 30
"""Of the table as float32, which lies in memory twice while fitting."""

FREE_BYTES = 2048
"""Room left for the header of a file."""

Progress = Callable[[float], None]
Model = TypeVar("Model")


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


def in_memory(btf: Bands) -> Float[Tensor, "light view H W 3"]:
    """Return all values of a table.

    Raises:
        ShapeError: a value of the BTF is not finite.
        SizeError: the table does not fit into memory.
    """
    height, width = btf.texels
    needed = 12 * len(btf.lights) * len(btf.views) * height * width
    if needed > MOST_BYTES:
        raise SizeError(
            f"compress: a budget is kept in memory, up to {MOST_BYTES / 2**30:g} GiB of values, this table has "
            f"{needed / 2**30:.1f}; take --method eigen with --rank"
        )
    return btf.rows(0, height)


def by_step(
    wanted: Budget,
    model: Callable[[float], Model],
    steps: tuple[float, float],
    *,
    estimate: Callable[[float], float],
    size: Callable[[Model], int],
    measure: Callable[[Model], float],
    more: str = "",
    progress: Progress = lambda share: None,
) -> tuple[Model, float]:
    """Return the coarsest model within the error, or the finest one within the size, and its measured PSNR in dB.

    Args:
        wanted: the budget.
        model: of a step.
        steps: the finest and the coarsest.
        estimate: PSNR of a step, quicker than to measure it.
        size: bytes of the file of a model.
        measure: PSNR of a model.
        more: what would help besides where an error cannot be reached.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the budget cannot be reached.
    """
    finest, coarsest = math.log(steps[0]), math.log(steps[1])
    if wanted.size is not None:
        room = wanted.size
        if (least := size(model(steps[1]))) > room:
            raise too_small(least, room)
        step = _edge(coarsest, finest, lambda x: size(model(math.exp(x))) <= room, progress)
        found = model(math.exp(step))
        return found, measure(found)
    assert wanted.psnr is not None
    asked = wanted.psnr
    log_step = _edge(finest, coarsest, lambda x: estimate(math.exp(x)) >= asked, progress)
    while True:
        found = model(math.exp(log_step))
        reached = measure(found)
        if reached >= asked:
            return found, reached
        if log_step <= finest:
            raise too_exact(reached, asked, more)
        log_step = max(finest, log_step - max(0.02, 0.12 * (asked - reached)))


def too_small(least: float, room: int) -> ConfigError:
    """Return what to say where no model is as small as asked for."""
    return ConfigError(f"compress.size: {room} bytes cannot be reached, {least:.0f} is the least; give more room")


def too_exact(best: float, wanted: float, more: str = "") -> ConfigError:
    """Return what to say where no model is as exact as asked for; `more` is what would help besides."""
    said = f"compress.psnr: {wanted:g} dB cannot be reached, {best:.1f} dB is the best here"
    return ConfigError(f"{said}; ask for less{more}")


def _edge(good: float, bad: float, fits: Callable[[float], bool], progress: Progress) -> float:
    """Return the value next to `bad` that still fits, between `good` and `bad`."""
    for i in range(12):
        middle = (good + bad) / 2
        good, bad = (middle, bad) if fits(middle) else (good, middle)
        progress((i + 1) / 12)
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


def psnr(T: Float[Tensor, "light view H W 3"], model: EigenBtf, peak: float | None = None) -> float:
    """Return the PSNR in dB of `model` beside the table, linear, the 99.5th percentile of T as peak."""
    peak = peak_of(T) if peak is None else peak
    total = 0.0
    E = model.decoded()
    for light, pictures in enumerate(T):
        shown = torch.einsum("hwkr,vk->vhwr", E[light], model.weights)
        total += float((shown - pictures).square().sum(dtype=torch.float64))
    return decibels(total / T.numel(), peak)


def psnr_of(T: Float[Tensor, "light view H W 3"], shown: Float[Tensor, "light view H W 3"]) -> float:
    """Return the PSNR in dB of a decoded table, measured as `psnr` does."""
    return decibels(float((shown - T).square().mean(dtype=torch.float64)), peak_of(T))


def decibels(error: float, peak: float) -> float:
    """Return the PSNR in dB of a mean squared error."""
    return math.inf if error <= 0 else 10 * math.log10(peak**2 / error)


def peak_of(T: Float[Tensor, "*batch"]) -> float:
    """Return the 99.5th percentile of T, by every so many values: torch sorts at most 16 million."""
    values = T.flatten()[:: max(1, T.numel() // 2_000_000)]
    return max(float(torch.quantile(values, 0.995)), 1e-30)
