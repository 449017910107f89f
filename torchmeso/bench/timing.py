"""Time of calls, taken in turns: wall time and CPU time side by side, because these machines are shared.

Test: tests/bench/test_timing.py
"""

import os
import time
from collections.abc import Callable
from statistics import median
from typing import NamedTuple


class Timing(NamedTuple):
    """Milliseconds of one call: median, smallest, largest of wall time; median of CPU time over cores; calls."""

    wall: float
    low: float
    high: float
    cpu: float
    n: int


def time_together(
    calls: dict[str, Callable[[], object]], *, n: int, warm: int = 2, settle: int = 0
) -> dict[str, Timing]:
    """Return the timing of each call, taken in turns so that all meet the same noise.

    With `settle` each timed call follows that many untimed ones: what it costs again and again, not after the others
    have taken the cache.
    """
    for call in calls.values():
        for _ in range(warm):
            call()
    wall: dict[str, list[float]] = {name: [] for name in calls}
    cpu: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(n):
        for name, call in calls.items():
            for _ in range(settle):
                call()
            before, start = time.process_time(), time.perf_counter()
            call()
            wall[name].append(1e3 * (time.perf_counter() - start))
            cpu[name].append(1e3 * (time.process_time() - before) / (os.cpu_count() or 1))
    return {k: Timing(median(w), min(w), max(w), median(cpu[k]), n) for k, w in wall.items()}
