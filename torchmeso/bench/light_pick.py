"""Rows of the suite `light` on what to pick: every method on one scene, time of a frame against error to the truth.

Bricks on a knot over a floor under the built-in sky. The truth is path-traced over the displaced triangles: direct
light of many lights, and light over two bounces of fewer. What the BTF itself cannot show, of few directions and a low
rank, is in every method's error: that of thousands of lights.

Test: tests/bench/test_light.py
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso import config
from torchmeso.bench.frames import KNOT
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import time_together
from torchmeso.config_sections import Config
from torchmeso.data.store import cache_dir
from torchmeso.pipeline import environment, truth
from torchmeso.pipeline import scene as scenes
from torchmeso.pipeline.bake import prepare
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Scene

LIGHTS, DEGREES = (12, 25, 50, 100, 200, 400), (1, 2, 3, 5, 7)

DIRECT, INDIRECT = 3000, 60
"""Lights of the truth: what comes at once, and what comes over bounces."""

BRICK = {
    "meso": {"type": "brick"},
    "btf": {"texels": 64, "lights": "grid(12, 6, 80)", "views": "grid(12, 6, 80)", "samples": 1, "bounces": 1},
    "mdf": {"texels": 64, "views": "grid(12, 5, 87.5)"},
    "eigen": {"rank": 16},
}


def methods(context: Context) -> Iterator[Row]:
    """Sampling by three rules, the frequency domain and transfer, over their dials."""
    settings = _scene(*((160, 120) if context.quick else (480, 360)))
    dressed = scenes.build(settings, prepare(settings, context.report))
    wanted = _truth(settings, context)
    for method, dial, values in (
        ("quadtree", "lights", (*LIGHTS, DIRECT)),
        ("median_cut", "lights", LIGHTS),
        ("uniform", "lights", LIGHTS),
        ("frequency", "degree", DEGREES),
        ("transfer", "degree", DEGREES),
    ):
        for k, value in enumerate(values[: 3 if context.quick else None]):
            context.report(f"frames by {method}", k / len(values))
            by = {"method": method, dial: value} if dial == "degree" else {"sampling": method, dial: value}
            yield _row(method, dial, value, _under(settings, **by), dressed, wanted, context)


def _row(
    method: str, dial: str, value: int, settings: Config, scene: Scene, wanted: truth.Truth, context: Context
) -> Row:
    lit = environment.prepare(settings, scene, context.report)
    camera, angles = settings.camera.build(), iter(range(1, 1_000_000))
    renderer = Renderer(lit(0.0), settings.render)
    error = relative_error(renderer.render(camera).rgb.clone(), wanted)

    def frame() -> None:
        renderer.update(lit(float(next(angles))))
        renderer.render(camera)

    many = value > LIGHTS[-1]
    took = time_together({"frame": frame}, n=3 if context.quick or many else 9, warm=1)["frame"]
    ms = round(min(took.wall, took.cpu), 2)
    return Row(
        id=f"light.pick.{method}.{value}",
        what=f"bricks on a knot over a floor, {camera.width} x {camera.height}, a turning sky by {method}, "
        f"{value if dial == 'lights' else ''}{' lights' if dial == 'lights' else f'degree {value}'}: RMS error to the "
        "path-traced picture over its mean",
        value=round(error, 4), unit="relative", better="lower", n=took.n,
        peer=f"frame {ms} ms (wall {took.wall:.1f}, CPU/cores {took.cpu:.1f})",
        curve=None if many else {"series": method, "x": ms, "x_label": "ms of a frame"},
    )  # fmt: skip


def relative_error(rgb: Float[Tensor, "H W 3"], wanted: truth.Truth, within: int = 1) -> float:
    """Return the RMS difference over the truth's mean where no outline is nearer than `within` pixels."""
    owner = torch.nn.functional.pad(wanted.owner[None, None].float(), (within,) * 4, mode="replicate")
    around = owner[0].unfold(1, 2 * within + 1, 1).unfold(2, 2 * within + 1, 1).flatten(3)[0]
    inside = (around.amax(-1) == around.amin(-1)) & (wanted.owner >= 0)
    truly = wanted.rgb[inside].double()
    return float((rgb[inside].double() - truly).square().mean().sqrt() / truly.mean())


def _scene(width: int, height: int) -> Config:
    content: dict[str, Any] = {
        "materials": {"brick": BRICK, "floor": {"albedo": [0.5, 0.5, 0.5]}},
        "objects": [
            {**KNOT, "material": "brick"},
            {"shape": "plane", "options": {"size": [12, 12], "triangles": 7200}, "translate": [0, -1.75, 0],
             "material": "floor"},
        ],
        "environment": {"sky": {"elevation_deg": 40, "azimuth_deg": 120, "turbidity": 4}, "exposure": -0.3},
        "camera": {"eye": [0.4, 1.3, 4.4], "at": [0, -0.15, 0], "width": width, "height": height},
        "render": {"silhouette": "curved", "shadow_map_size": 768},
    }  # fmt: skip
    return config.parse(content, folder=cache_dir(), name="light.pick")


def _under(settings: Config, **changes: Any) -> Config:
    assert settings.environment is not None
    return settings.model_copy(update={"environment": settings.environment.model_copy(update=changes)})


def _truth(settings: Config, context: Context) -> truth.Truth:
    """Return the path-traced picture: bounces are noisy and smooth over lights, direct light is neither."""

    def traced(lights: int, samples: int, bounces: int) -> truth.Truth:
        dials = settings.truth.model_copy(update={"samples": samples, "bounces": bounces})
        return truth.render(_under(settings, lights=lights).model_copy(update={"truth": dials}), context.report)

    direct = traced(DIRECT, 1, 0)
    paths = 4 if context.quick else 32
    return replace(direct, rgb=direct.rgb + traced(INDIRECT, paths, 2).rgb - traced(INDIRECT, 1, 0).rgb)
