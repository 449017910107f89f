"""The errors torchmeso raises on purpose, and the checks that raise them.

A text says name, expected, got, and the next step, in one or two sentences. Checks stand at three doors
only: where a container is made, where a file is read, and at public operations.
"""

import difflib
import math
from collections.abc import Iterable, Sequence
from typing import Any


class MesoError(Exception):
    """Base class: the command line prints its text and leaves with status 2."""


class ShapeError(MesoError, ValueError):
    """An array has the wrong shape or dtype."""


class FormatError(MesoError, ValueError):
    """A file is missing, or is not what its name or header says."""


class StorageError(MesoError, OSError):
    """A file cannot be written: the disk is full, or the place cannot be written to."""


class ConfigError(MesoError, ValueError):
    """An option or a configuration has an unknown key or a value out of range."""


class SizeError(MesoError, ValueError):
    """A request would need more memory than the stated limit."""


class GeometryError(MesoError, ValueError):
    """A mesh lacks what an operation needs, such as texture coordinates."""


class BackendError(MesoError, RuntimeError):
    """OpenCL is missing, a kernel did not build, or a backend cannot do what is asked."""


class RigError(MesoError, RuntimeError):
    """A rig does not answer, refuses a command, or stands where it should not."""


def check_shape(name: str, x: Any, expected: Sequence[int]) -> None:
    """Raise ShapeError unless `x` has exactly the shape `expected` (-1 matches any size)."""
    fits = len(x.shape) == len(expected) and all(e in (-1, n) for n, e in zip(x.shape, expected, strict=True))
    if not fits:
        wanted = ", ".join("any" if e == -1 else str(e) for e in expected)
        raise ShapeError(f"{name}: expected shape ({wanted}), got {tuple(x.shape)}")


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise ConfigError unless low <= value <= high."""
    if not low <= value <= high:
        got = f"{value:g}" if abs(value) < 1e300 else f"{value!s:.12}"  # a whole number may be beyond all floats
        raise ConfigError(f"{name}: expected a value from {low:g} to {high:g}, got {got}")


def check_finite(name: str, x: Any, low: float = -math.inf, high: float = math.inf) -> None:
    """Raise ShapeError unless every value of the tensor `x` is finite and from `low` to `high`; count the others."""
    if x.numel() == 0:
        return
    least, most = (float(v) for v in x.aminmax())  # a NaN among the values becomes both; no memory is taken
    if math.isfinite(least) and math.isfinite(most) and least >= low and most <= high:
        return
    wrong = ~(x.isfinite() & (x >= low) & (x <= high))
    count = int(wrong.sum())
    if count:
        bounds = "" if math.isinf(high) else f" from {low:g} to {high:g}"
        first = tuple(wrong.nonzero()[0].tolist())
        more = f" at {first} and {count - 1} more of {x.numel()}" if count > 1 else ""
        raise ShapeError(f"{name}: expected finite values{bounds}, got {float(x[first]):g}{more}")


def check_memory(name: str, needed: float, limit: float, remedy: str) -> None:
    """Raise SizeError if `needed` bytes exceed `limit` bytes; `remedy` names the dial to turn."""
    if needed > limit:
        raise SizeError(f"{name}: needs {human_size(needed)} of memory, the limit is {human_size(limit)}; {remedy}")


def human_size(n_bytes: float) -> str:
    """Return `n_bytes` as text with a binary unit: 22.1 MiB."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if n_bytes < 1024:
            return f"{n_bytes:.0f} B" if unit == "B" else f"{n_bytes:.1f} {unit}"
        n_bytes /= 1024
    return f"{n_bytes:.1f} TiB"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the nearest known name, or the list of names where none is near."""
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"; did you mean '{near[0]}'?" if near else f"; known: {', '.join(names)}"
