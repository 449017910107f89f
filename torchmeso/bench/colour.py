"""Rows of the suite `render` on colour: what rank, storage, texels and directions of a BTF cost and give.

Test: tests/bench/test_colour.py
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from torch import Tensor

from torchmeso import config, quality
from torchmeso.bench.suite import Context, Row
from torchmeso.compress import eigen
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.quantize import Storage
from torchmeso.config_sections import Config
from torchmeso.data import btf as btf_data
from torchmeso.data.btf import Evaluable
from torchmeso.pipeline import bake, truth
from torchmeso.pipeline import scene as pipeline_scene
from torchmeso.render import frame
from torchmeso.render.frame import FrameOptions
from torchmeso.render.scene import Material, Object, Scene

STORAGES: tuple[Storage, ...] = ("uint8", "float16", "float32")


def btf(context: Context) -> Iterator[Row]:
    """Colour of the BTF: rank, storage, texels and directions, against the full table and against truth."""
    base = close_up()
    reference = truth.render(base, context.report).rgb
    table = btf_data.load(_btf_table(base, context))
    full, ms = _shaded(base, table)
    whole = {"series": "whole table", "x": "float16", "ms": ms}
    yield from _colour_rows("btf.full", "the whole table, float16", full, None, reference, whole)
    best = eigen.fit(table, EigenOptions(rank=16, storage="float32"))
    for rank in (1, 4, 16) if context.quick else (1, 2, 3, 4, 6, 8, 12, 16):
        rgb, ms = _shaded(base, best.truncated(rank))
        curve = {"series": "rank", "x": rank, "ms": ms, "bytes": 4 * best.maps[..., :rank, :].numel()}
        yield from _colour_rows(f"btf.rank.{rank}", f"eigen BTF of rank {rank}, float32", rgb, full, reference, curve)
    # The base point of the sweeps over texels and directions.
    rgb, ms = _shaded(base, best.truncated(8))
    for series, x in (("texels", "64"), ("directions", "12x5")):
        what = f"eigen BTF of rank 8, float32, {series} {x}"
        yield from _colour_rows(f"btf.{series}.{x}", what, rgb, None, reference, {"series": series, "x": x, "ms": ms})
    for storage in STORAGES:
        model = eigen.fit(table, EigenOptions(rank=8, storage=storage))
        rgb, ms = _shaded(base, model)
        size = model.maps.numel() * model.maps.element_size()
        curve = {"series": "storage", "x": storage, "ms": ms, "bytes": size}
        what = f"eigen BTF of rank 8, {storage}"
        yield from _colour_rows(f"btf.storage.{storage}", what, rgb, full, reference, curve)
    changes: dict[str, dict[str, Any]] = {f"btf.texels.{n}": {"texels": n} for n in (32, 128)}
    for n_phi, n_theta in ((6, 3), (16, 8)):
        directions = f"grid({n_phi}, {n_theta}, 80)"
        changes[f"btf.directions.{n_phi}x{n_theta}"] = {"lights": directions, "views": directions}
    for name, change in changes.items():
        what = "eigen BTF of rank 8, float32, " + ", ".join(f"{k} {v}" for k, v in change.items())
        material = base.materials["brick"]
        other = material.model_copy(update={"btf": replace(material.btf, **change)})
        if context.quick and not bake.table_paths(other)[0].exists():
            row_id = f"{name}.psnr_vs_truth"
            yield Row(id=row_id, what=what, value=None, unit="dB", better="higher", why="full run only")
            continue
        baked = btf_data.load(bake.bake_tables("brick", other, context.report, {})[0])
        rgb, ms = _shaded(base, eigen.fit(baked, EigenOptions(rank=8, storage="float32")))
        curve = {"series": name.split(".")[1], "x": name.split(".")[2], "ms": ms}
        yield from _colour_rows(name, what, rgb, None, reference, curve)


def prepare(context: Context) -> None:
    """Bake what these rows look at into the cache."""
    base = close_up()
    truth.render(base, context.report)
    _btf_table(base, context)


def close_up() -> Config:
    """Return a brick cylinder that fills the picture, so that every pixel counts."""
    content = {
        "name": "close-up",
        "materials": {"brick": {"meso": {"type": "brick"}, "btf": {"texels": 64, "samples": 9}}},
        "objects": [
            {
                "shape": "cylinder",
                "tiles": [8, 3],
                "material": "brick",
                "options": {"height": 2.356194, "triangles": 20000},
            }
        ],
        "lights": [{"type": "directional", "direction": [0.5, 0.6, 0.7]}],
        "camera": {"eye": [0.2, 0.3, 2.3], "fov_deg": 35, "width": 400, "height": 300},
        "truth": {"samples": 32, "bounces": 2, "max_edge": 0.1},
    }
    return config.parse(content, folder=Path())


def _btf_table(settings: Config, context: Context) -> Path:
    return bake.bake_tables("brick", settings.materials["brick"], context.report, {})[0]


def _shaded(settings: Config, reflectance: Evaluable) -> tuple[Tensor, float]:
    """Return the picture of the BTF on the bare mesh, and the milliseconds of its shading."""
    material = Material(btf=reflectance)
    objects = tuple(Object(mesh=pipeline_scene.build_mesh(o), material=material) for o in settings.objects)
    lights = tuple(light.build() for light in settings.lights)
    scene = Scene(objects=objects, lights=lights, ambient=settings.ambient)
    options = FrameOptions(silhouette="none", shadows=False)
    camera = settings.camera.build()
    pictures = [frame.render(scene, camera, options) for _ in range(3)]
    return pictures[0].rgb, round(1e3 * min(p.seconds["shading"] for p in pictures), 1)


def _colour_rows(name: str, what: str, rgb: Tensor, full: Tensor | None, true: Tensor, curve: dict) -> Iterator[Row]:
    """Yield PSNR and FLIP against the whole table (where given) and against truth."""
    for other, reference in (("full", full), ("truth", true)):
        if reference is None:
            continue
        found = quality.compare(reference, rgb)
        against = "the whole table" if other == "full" else "path-traced truth"
        for kind, value, better in (("psnr", found.psnr, "higher"), ("flip", found.flip, "lower")):
            place = {**curve, "series": f"{curve['series']} {kind} vs {other}"}
            if value is None or math.isinf(value):
                continue
            yield Row(
                id=f"{name}.{kind}_vs_{other}",
                what=f"{what}: {kind.upper()} against {against}",
                value=round(value, 4),
                unit="dB" if kind == "psnr" else "FLIP",
                better="higher" if better == "higher" else "lower",
                curve=place,
            )
