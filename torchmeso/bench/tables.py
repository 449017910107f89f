"""The suite `tables`: Table 2 of wang2005mdf, our frames per second beside the paper's.

An absolute figure is judged by the better of wall time and CPU time over cores: these machines are shared.

Test: tests/bench/test_tables.py
"""

from collections.abc import Iterator
from functools import partial

import torch

from torchmeso.bench import frames
from torchmeso.bench.speed import renderer
from torchmeso.bench.suite import Context, Measurement, Row
from torchmeso.bench.timing import time_together
from torchmeso.render.silhouette import Silhouette

COLUMNS: tuple[tuple[str, Silhouette, bool], ...] = (
    ("btf", "none", False),
    ("silhouette", "paper", False),
    ("shadow", "paper", True),
)
"""Columns of the table with the test the paper describes; `curved` is reported beside them."""


def table_2(context: Context) -> Iterator[Row]:
    """Six scenes at three coverages, one light, shadow maps of 768^2 drawn every frame, 800 x 600."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for name, timed in frames.table_2():
            assert timed.paper is not None
            scene = frames.build(timed, context.report)
            for coverage in (0.5,) if context.quick else (0.28, 0.5, 1.0):
                camera = frames.camera_at(scene, timed, coverage)
                drawn = {c: renderer(scene, s, shadows=shadow) for c, s, shadow in COLUMNS}
                drawn |= {"curved silhouette": renderer(scene, "curved", shadows=False)}
                drawn |= {"curved shadow": renderer(scene, "curved", shadows=True)}
                timing = time_together(
                    {c: partial(r.show, camera) for c, r in drawn.items()},
                    n=9 if context.quick else 25, warm=3, settle=4,
                )  # fmt: skip
                pixels = drawn["btf"].counts
                reached = round(100 * pixels["pixels with a fragment"] / pixels["pixels"])
                for column, t in timing.items():
                    paper = timed.paper[0 if "btf" in column else 1 if "silhouette" in column else 2]
                    fps = 1000 / t.wall
                    judged = column in ("silhouette", "shadow") and coverage == 0.5
                    yield Row(
                        id=f"table2.{name}.{column.replace(' ', '_')}.{round(100 * coverage)}",
                        what=f"{name}, {column}, {reached} % coverage: our FPS over the paper's {paper}",
                        value=round(fps / paper, 2), unit="x", better="higher", goal=1.0 if judged else None, n=t.n,
                        peer=f"{fps:.0f} FPS ({1000 / t.low:.0f} at best), paper {paper}",
                    )  # fmt: skip
    finally:
        torch.set_num_threads(threads)


MEASUREMENTS = [Measurement("table2", table_2)]
