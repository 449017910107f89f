"""The scenes whose frames are timed: the 12k knot, and the six of Table 2 of wang2005mdf, at a set coverage.

Triangle counts, data sizes and materials are the paper's. It names no material for Fig. 1: pipes are the one of Table 1
(bluepipe) that no caption names. Peanut and weave, which it captured, are generated here; grass has no soil, so that
its tables hold entries without a hit. A mesh alone stands before an empty background; the camera's distance sets the
coverage.

Test: tests/bench/test_frames.py
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchmeso import config
from torchmeso.config_sections import Config
from torchmeso.geometry.camera import Camera
from torchmeso.pipeline import scene as scenes
from torchmeso.pipeline.bake import Report, prepare, silent
from torchmeso.render.device_raster import DeviceRaster, upload_mesh
from torchmeso.render.scene import Scene, assemble

SMALL: dict[str, Any] = {
    "btf": {"texels": 64, "lights": "grid(12, 5, 80)", "views": "grid(12, 5, 80)", "samples": 1, "bounces": 0},
    "mdf": {"texels": 64, "views": "grid(12, 5, 87.5)"},
    "eigen": {"rank": 4},
}
LARGE: dict[str, Any] = {
    "btf": {"texels": 128, "lights": "grid(12, 8, 80)", "views": "grid(12, 8, 80)", "samples": 1, "bounces": 0},
    "mdf": {"texels": 128, "views": "grid(12, 8, 87.5)"},
    "eigen": {"rank": 4},
}
"""Table 1: 64 x 64 texels and 12 x 5 directions, or 128 x 128 and 12 x 8; eigen BTFs of four terms (section 5)."""

GRASS: dict[str, Any] = {
    "btf": {"texels": 64, "lights": "grid(12, 8, 80)", "views": "grid(12, 8, 80)", "samples": 1, "bounces": 0},
    "mdf": {"texels": 64, "views": "grid(12, 8, 87.5)"},
    "eigen": {"rank": 4},
}

KNOT = {"shape": "torus_knot", "options": {"triangles": 11952}, "tiles": [40, 4]}
TORUS = {"shape": "torus", "options": {"triangles": 4276}, "tiles": [8, 3]}
EYES = {"knot": (0.3, -1.6, 4.2), "torus": (0.0, 2.6, 3.2)}


class Timed(NamedTuple):
    """A scene to be timed: its configuration, the direction of the eye, the paper's three rates or None."""

    config: Config
    eye: tuple[float, float, float]
    paper: tuple[float, float, float] | None


def knot(rank: int = 4) -> Timed:
    """Return the 12k knot of bricks, alone."""
    tables = {**SMALL, "eigen": {"rank": rank}}
    return Timed(
        _config("knot12k", {"brick": _meso("brick", tables)}, [{**KNOT, "material": "brick"}]), EYES["knot"], None
    )


def table_2() -> Iterator[tuple[str, Timed]]:
    """Yield the rows of Table 2."""
    brick, weave = _meso("brick", SMALL), _meso("weave", LARGE)
    pipes, peanut, blocks = _meso("pipes", SMALL), _meso("peanut", LARGE), _meso("blocks", SMALL)
    grass = _meso("grass", GRASS, backing=False)
    floor = {"shape": "plane", "options": {"size": [12, 12], "triangles": 2}, "tiles": [24, 24]}
    yield "fig1", Timed(_config("fig1", {"m": pipes}, [{**KNOT, "material": "m"}]), EYES["knot"], (186, 75, 47))
    small_torus = {"shape": "torus", "options": {"triangles": 1500}, "tiles": [8, 3], "material": "weave"}
    fig12 = [
        small_torus,
        {**small_torus, "scale": 0.7, "rotate_deg": [62, 20, 0], "translate": [1.25, 0.75, 0.9]},
        {**floor, "options": {"size": [12, 12], "triangles": 200}, "translate": [0, -0.42, 0], "material": "peanut"},
    ]
    yield "fig12", Timed(_config("fig12", {"weave": weave, "peanut": peanut}, fig12), (-0.6, 3.6, 4.6), (110, 42, 27))
    fig13 = [{**KNOT, "material": "brick"}, {**floor, "translate": [0, -1.8, 0], "material": "grass"}]
    yield "fig13", Timed(_config("fig13", {"brick": brick, "grass": grass}, fig13), (0.4, 1.6, 4.4), (115, 30, 18))
    for name, material, paper in (
        ("fig14a", weave, (186, 75, 49)), ("fig14b", blocks, (110, 40, 25)), ("fig14c", brick, (115, 85, 44)),
    ):  # fmt: skip
        yield name, Timed(_config(name, {"m": material}, [{**TORUS, "material": "m"}]), EYES["torus"], paper)


def prepare_all(report: Report) -> None:
    """Bake the materials of all timed scenes into the cache."""
    for timed in (knot(), knot(rank=16), *(t for _, t in table_2())):
        prepare(timed.config, report)


def build(timed: Timed, report: Report = silent) -> Scene:
    """Return the scene, its materials from the cache or baked."""
    return scenes.build(timed.config, prepare(timed.config, report))


def camera_at(scene: Scene, timed: Timed, coverage: float, *, width: int = 800, height: int = 600) -> Camera:
    """Return the view from `timed.eye`'s direction at the distance where `coverage` of the pixels have a fragment.

    Where no distance comes that close to the whole picture, the closest there is.
    """
    world = assemble(scene)
    raster = DeviceRaster(upload_mesh(world.vertices, world.faces), width, height)

    def view(distance: float) -> tuple[Camera, float]:
        away = np.array(timed.eye) / np.linalg.norm(timed.eye) * distance
        eye = tuple(float(x) for x in np.array(timed.config.camera.at) * (coverage > 0.99) + away)
        camera = timed.config.camera.model_copy(update={"eye": eye, "width": width, "height": height}).build()
        return camera, float(len(raster.lists(camera).pixel.unique())) / (width * height)

    if coverage > 0.99:  # a mesh with holes: close to what lies nearest to the eye on the first object
        vertices = scene.objects[0].mesh.vertices.double().numpy()
        toward = np.array(timed.eye) / np.linalg.norm(timed.eye)
        at = vertices[np.argmax(vertices @ toward)]
        timed = timed._replace(
            config=timed.config.model_copy(
                update={"camera": timed.config.camera.model_copy(update={"at": tuple(at.tolist())})}
            )
        )
    near, far = 0.15, 40.0
    best, gap = view(far)
    gap = abs(gap - coverage)
    for _ in range(18):
        middle = (near * far) ** 0.5
        camera, share = view(middle)
        if abs(share - coverage) < gap:
            best, gap = camera, abs(share - coverage)
        if gap < 0.002:
            break
        near, far = (near, middle) if share < coverage else (middle, far)
    return best


def _meso(kind: str, tables: dict[str, Any], **arguments: Any) -> dict[str, Any]:
    return {"meso": {"type": kind, **arguments}, **tables}


def _config(name: str, materials: dict[str, Any], objects: list[dict[str, Any]]) -> Config:
    content = {
        "name": name,
        "materials": materials,
        "objects": objects,
        "lights": [{"type": "directional", "direction": [3, 2, 4]}],
        "camera": {"eye": [0, 0, 5], "width": 800, "height": 600},
        "render": {"shadow_map_size": 768},
    }
    return config.parse(content, folder=Path(), name=name)
