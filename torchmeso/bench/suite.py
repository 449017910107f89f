"""What every benchmark shares: rows, goals, the machine, and the JSON file.

A suite is a list of measurements; a measurement has a name, which begins the ids of its rows, and yields rows.
What was not measured is a row without a value and with the reason, never an invented figure.

Test: tests/bench/test_suite.py
"""

import contextlib
import fnmatch
import json
import os
import re
import resource
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import torch

from torchmeso.bench import peers
from torchmeso.bench.timing import time_together
from torchmeso.data.store import replacing
from torchmeso.errors import ConfigError, did_you_mean
from torchmeso.pipeline.bake import Report, silent


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One figure.

    Attributes:
        id: dotted name, stable between versions.
        what: one sentence.
        value: the figure; None where it was not measured.
        unit: of the value.
        better: which way is good.
        goal: what is aimed at; None where the figure is only reported.
        spread: smallest and largest of the repetitions.
        peer: what it was compared with, and that one's own figure.
        n: repetitions.
        why: why there is no value.
        curve: place in a plot: {"series", "x", ...}.
        peak_mb: largest resident memory of the process since the row before.
    """

    id: str
    what: str
    value: float | None
    unit: str
    better: Literal["higher", "lower"]
    goal: float | None = None
    spread: tuple[float, float] | None = None
    peer: str | None = None
    n: int = 1
    why: str | None = None
    curve: dict[str, Any] | None = None
    peak_mb: int | None = None

    @property
    def met(self) -> bool | None:
        """Whether the goal is met; None without a value or a goal."""
        if self.value is None or self.goal is None:
            return None
        return self.value >= self.goal if self.better == "higher" else self.value <= self.goal

    def to_json(self) -> dict[str, Any]:
        """Return the row as JSON, empty fields left out."""
        whole = {**asdict(self), "met": self.met}
        return {k: v for k, v in whole.items() if v is not None or k in ("value", "met")}


@dataclass(frozen=True, slots=True, kw_only=True)
class Context:
    """How to measure.

    Attributes:
        quick: fewer repetitions and sweep points, never a smaller size than a goal names.
        report: progress.
    """

    quick: bool = False
    report: Report = field(default=silent)


class Measurement(NamedTuple):
    """A group of rows: how their ids begin, and what measures them."""

    name: str
    run: Callable[[Context], Iterator[Row]]


def select(measurements: Sequence[Measurement], only: Sequence[str]) -> list[Measurement]:
    """Return the measurements that `only` asks for: names, beginnings of ids such as btf.rank, patterns with *.

    All where `only` is empty.

    Raises:
        ConfigError: a name fits none.
    """
    if not only:
        return list(measurements)
    chosen: list[Measurement] = []
    for wanted in only:
        fits = [m for m in measurements if wanted.startswith(f"{m.name}.") or fnmatch.fnmatch(m.name, wanted)]
        if not fits:
            known = did_you_mean(wanted, [m.name for m in measurements])
            raise ConfigError(f"bench --only: no row begins with '{wanted}'{known}")
        chosen += [m for m in fits if m not in chosen]
    return chosen


def run(measurements: Sequence[Measurement], context: Context, only: Sequence[str] = ()) -> list[Row]:
    """Return the rows of all chosen measurements."""
    rows: list[Row] = []
    for m in select(measurements, only):
        context.report(f"bench {m.name}", 0)
        resident_peak()
        found = [replace(row, peak_mb=resident_peak()) for row in m.run(context)]
        patterns = [wanted for wanted in only if wanted.startswith(f"{m.name}.")]
        rows += [r for r in found if not patterns or any(_fits(r.id, p) for p in patterns)]
        context.report(f"bench {m.name}", 1)
    return rows


def resident_peak() -> int:
    """Return the largest resident memory since the last call, in MB; where that is not known, of the whole process."""
    status = Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    found = re.search(r"VmHWM:\s*(\d+) kB", status.read_text())
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return int(found[1]) >> 10 if found else 0


def _fits(row_id: str, wanted: str) -> bool:
    return row_id.startswith(wanted) or fnmatch.fnmatch(row_id, wanted)


def describe_device() -> dict[str, Any]:
    """Return the machine and two probes of how fast it is right now."""
    from torchmeso.backends import opencl
    from torchmeso.pipeline.report import processor

    devices = [f"{d.device} ({d.version})" for d in opencl.list_devices() if d.chosen]
    return {
        "cpu": processor(),
        "cores": os.cpu_count(),
        "opencl": devices[0] if devices else None,
        "threads": torch.get_num_threads(),
        "torch": torch.__version__,
        "load": round(os.getloadavg()[0], 2),
        "probe": {"llvmpipe_z_ms": peers.llvmpipe_probe(), "gemm2048_ms": _gemm_probe()},
    }


def to_json(suite: str, rows: Sequence[Row], device: dict[str, Any]) -> dict[str, Any]:
    """Return a run of a suite as JSON."""
    return {"suite": suite, "device": device, "rows": [row.to_json() for row in rows]}


def write_json(path: str | Path, content: dict[str, Any]) -> None:
    """Write a run of a suite, whole or not at all."""
    with replacing(path) as beside:
        beside.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _gemm_probe() -> float:
    a = torch.rand(2048, 2048)
    return round(time_together({"gemm": lambda: a @ a}, n=5)["gemm"].wall, 2)
