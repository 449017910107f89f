"""Rows of the suite `light` on run time: whole frames of 640 x 480 pixels under environments.

For a picture of 50 lights with shadows between bodies leung2007tileable took 192 and 270 s (section 5, Fig. 13). Lights
turn from frame to frame, so that all their shadow maps are drawn anew, and so do harmonics.

Test: tests/bench/test_light.py
"""

from collections.abc import Iterator
from dataclasses import replace

from torchmeso.bench import frames
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import time_together
from torchmeso.config_sections import EnvironmentConfig, SkyConfig
from torchmeso.pipeline import environment
from torchmeso.render.renderer import Renderer

WIDTH, HEIGHT = 640, 480

GOALS = {"sampling": 1.0, "frequency": 0.3, "transfer": 0.4}
"""Seconds."""


def frames_under_environments(context: Context) -> Iterator[Row]:
    """Frames of the 12k knot at half coverage and at a whole one, by every method."""
    for rank in (4, 16):
        timed = frames.knot(rank)
        scene = replace(frames.build(timed, context.report), lights=(), ambient=0.0)
        for coverage in (0.5, 1.0):
            camera = frames.camera_at(scene, timed, coverage, width=WIDTH, height=HEIGHT)
            for method, goal in GOALS.items():
                settings = EnvironmentConfig.model_validate({"sky": SkyConfig(), "method": method, "lights": 50})
                lit = environment.prepare(
                    timed.config.model_copy(update={"environment": settings}), scene, context.report
                )
                angles = iter(range(1_000_000))
                renderer = Renderer(lit(0.0), timed.config.render)

                def frame(renderer: Renderer = renderer, lit: environment.Lit = lit, angles: Iterator[int] = angles):
                    renderer.update(lit(float(next(angles))))
                    return renderer.render(camera)  # noqa: B023

                took = time_together({"frame": frame}, n=5 if context.quick else 15)["frame"]
                seconds = 1e-3 * min(took.wall, took.cpu)
                yield Row(
                    id=f"light.frame.{method}.rank{rank}.{round(100 * coverage)}",
                    what=f"frame of {WIDTH} x {HEIGHT} pixels under a turning sky by {method}"
                    f"{', 50 lights with shadow maps of 768 x 768' if method == 'sampling' else ''}: "
                    f"12k knot of bricks, rank {rank}, {round(100 * coverage)} % coverage",
                    value=round(seconds, 3), unit="s", better="lower", goal=goal, n=took.n,
                    spread=(round(1e-3 * took.low, 3), round(1e-3 * took.high, 3)),
                    peer=f"wall {1e-3 * took.wall:.3f} s, CPU/cores {1e-3 * took.cpu:.3f} s; the paper 192 to 270 s",
                )  # fmt: skip
