"""Many frames of a configuration: around the subject, or with the lights or the environment going around it.

Test: tests/pipeline/test_animate.py
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import torch

from torchmeso.config_sections import Config, Vector
from torchmeso.data import store, video
from torchmeso.errors import ConfigError, check_range
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.light import Light
from torchmeso.pipeline import environment
from torchmeso.pipeline import scene as scenes
from torchmeso.pipeline.bake import CODE, Report, code_hash, file_hash, prepare, silent
from torchmeso.pipeline.render import Painter

Way = Literal["turntable", "light", "environment"]


def render(
    config: Config,
    out: str | Path,
    *,
    frames: int,
    way: Way = "turntable",
    fps: float = 25.0,
    report: Report = silent,
) -> list[Path]:
    """Render `frames` frames of one whole turn to `out` (.png sequence, .gif or .mp4) and return the files.

    Raises:
        MesoError: a file is missing or unreadable, or an option is out of range.
    """
    check_range("frames", frames, 1, 100_000)
    check_range("fps", fps, 1, 1000)
    if way == "environment" and config.environment is None:
        raise ConfigError("frames: expected an environment to turn, got none; name one with --env F, or --env sky")
    lit = environment.prepare(config, scenes.build(config, prepare(config, report)), report)
    painter = Painter(lit(0.0), config.render, config.backend)
    with video.record(out, fps=fps, count=frames, job=_job(config, way)) as reel:
        for i, (camera, lights) in enumerate(turn(config, frames, way)):
            report("frames", i / frames)
            if reel.skip():
                continue
            if way == "environment":
                painter.change(lit(360.0 * i / frames))
            own = config.environment is not None or way == "environment"
            reel.add(painter.show(camera, None if own else lights))
    report("frames", 1)
    return video.paths(out, frames)


def turn(config: Config, frames: int, way: Way) -> Iterator[tuple[Camera, tuple[Light, ...]]]:
    """Yield the cameras and lights of one turn around the camera's `at` and `up`; the first is the configuration's."""
    for i in range(frames):
        angle = 360.0 * i / frames
        view, lights = config.camera, config.lights
        if way == "turntable":
            view = view.model_copy(update={"eye": _around(view.eye, view.at, view.up, angle)})
        elif way == "light":
            # Directions turn around the origin, places around what the camera looks at.
            lights = [
                light.model_copy(
                    update={
                        name: _around(
                            getattr(light, name), (0.0, 0.0, 0.0) if name == "direction" else view.at, view.up, angle
                        )
                        for name in ("direction", "position", "at")
                        if hasattr(light, name)
                    }
                )
                for light in lights
            ]
        yield view.build(), tuple(light.build() for light in lights)


def _job(config: Config, way: Way) -> str:
    """Return a hash of all that decides what the frames show."""
    files = [] if config.environment is None else [config.environment.map]
    files += [o.mesh for o in config.objects] + [m.model for m in config.materials.values()]
    for material in config.materials.values():
        files += material.meso.files if material.meso else []
    return store.content_hash(repr(config), way, [file_hash(f) for f in files if f], code_hash((*CODE, "render")))


def _around(point: Vector, centre: Vector, axis: Vector, angle_deg: float) -> Vector:
    """Return `point` turned around the line through `centre` along `axis`."""
    p, c, k = (torch.tensor(x, dtype=torch.float64) for x in (point, centre, axis))
    k = k / k.norm()
    a = torch.tensor(angle_deg, dtype=torch.float64).deg2rad()
    v = p - c
    turned = v * a.cos() + torch.linalg.cross(k, v) * a.sin() + k * (k @ v) * (1 - a.cos())
    x, y, z = (turned + c).tolist()
    return x, y, z
