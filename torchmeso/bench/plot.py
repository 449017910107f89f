"""Curves of a suite's rows: error over its dial, and error over run time where rows tell it.

Test: tests/bench/test_plot.py
"""

import re
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from torchmeso.bench.suite import Row
from torchmeso.data.store import replacing
from torchmeso.errors import BackendError, FormatError


def draw(rows: Sequence[Row], path: str | Path) -> None:
    """Write a picture (.png or .svg) with one panel per group of curves.

    Raises:
        BackendError: matplotlib is not installed.
        FormatError: no row belongs to a curve.
    """
    try:
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot
    except ImportError as error:
        raise BackendError("plot: expected matplotlib; install the extra: torchmeso[report]") from error
    groups = _groups(rows)
    if not groups:
        raise FormatError("plot: expected rows that belong to a curve, got none; choose another --only")
    across = min(3, len(groups))
    down = -(-len(groups) // across)
    figure, axes = pyplot.subplots(down, across, figsize=(5.2 * across, 3.8 * down), squeeze=False)
    for axis in axes.flat[len(groups) :]:
        axis.set_visible(False)
    for axis, (title, series) in zip(axes.flat, groups.items(), strict=False):
        for name, members in series.items():
            _line(axis, name, members)
        values = [m.value for members in series.values() for m in members if m.value is not None]
        if min(values) > 0 and max(values) > 1e3 * min(values):
            axis.set_yscale("log")
        axis.set_title(title, fontsize=10)
        axis.set_ylabel(next(iter(series.values()))[0].unit)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    figure.tight_layout()
    with replacing(path) as beside:
        figure.savefig(beside, format=Path(path).suffix.lstrip(".") or "png", dpi=110)
    pyplot.close(figure)


def _groups(rows: Sequence[Row]) -> dict[str, dict[str, list[Row]]]:
    """Return title -> series -> rows; rows of one unit and one beginning of the id share a panel."""
    groups: dict[str, dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        if row.curve is None or row.value is None:
            continue
        head = row.id.split(".")
        groups[f"{head[0]}: {head[1]} ({row.unit})"][str(row.curve["series"])].append(row)
    several = {t: {k: _sorted(v) for k, v in g.items() if len(v) > 1} for t, g in groups.items()}
    return {title: series for title, series in several.items() if series}


def _sorted(members: list[Row]) -> list[Row]:
    """Order a series by its dial where that is a number, or begins with one (12x5)."""

    def key(row: Row) -> float:
        found = re.match(r"[\d.]+", str(row.curve["x"] if row.curve else ""))
        return float(found[0]) if found else 0.0

    return sorted(members, key=key)


def _line(axis, name: str, members: list[Row]) -> None:
    """Draw one series over its dial, with the run time beside each point where it is known."""
    x = [m.curve["x"] for m in members if m.curve is not None]
    if not all(isinstance(v, int | float) for v in x):
        x = [str(v) for v in x]
    axis.plot(x, [m.value for m in members], marker="o", markersize=3, label=name)
    for place, m in zip(x, members, strict=True):
        if m.curve is not None and "ms" in m.curve:
            text = f"{m.curve['ms']:.0f} ms"
            axis.annotate(text, (place, m.value), fontsize=6, xytext=(2, 3), textcoords="offset points")
    if len(x) > 4 and isinstance(x[0], str):
        axis.tick_params(axis="x", rotation=30, labelsize=7)
