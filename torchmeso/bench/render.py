"""The suite `render`: accuracy of rasteriser, silhouettes, shadows, MDF and BTF, and time beside peers.

Test: tests/bench/test_render.py
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Bool
from torch import Tensor

from torchmeso import config, quality
from torchmeso.bench import colour, limits, million, minify, peers, scenes, speed
from torchmeso.bench.peers import PeerMissing
from torchmeso.bench.suite import Context, Measurement, Row
from torchmeso.bench.timing import Timing, time_together
from torchmeso.config_sections import Config
from torchmeso.data.address import texel_centres
from torchmeso.data.mdf import Mdf
from torchmeso.errors import BackendError
from torchmeso.geometry import hemisphere, shapes
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.directions import from_angles
from torchmeso.geometry.light import Light, illuminate
from torchmeso.geometry.mesh import Mesh
from torchmeso.geometry.rays import RayScene
from torchmeso.meso import bake_mdf, generators
from torchmeso.meso.bake_mdf import MdfOptions, RayCastMdf
from torchmeso.meso.displace import displace
from torchmeso.meso.mesostructure import Mesostructure
from torchmeso.pipeline import scene as pipeline_scene
from torchmeso.pipeline import truth
from torchmeso.pipeline.demo import built_in
from torchmeso.render import frame, shadow_map
from torchmeso.render.device_raster import DeviceRaster, upload_mesh
from torchmeso.render.frame import FrameOptions
from torchmeso.render.rasterize import rasterize
from torchmeso.render.scene import DistanceFunction, Material, Object, Scene, assemble
from torchmeso.render.silhouette import Silhouette
from torchmeso.transport.tracer import MeshTracer

MATERIALS = ("brick", "weave")
TESTS: tuple[Silhouette, ...] = ("paper", "curved")

MAX_EDGE = 0.1
"""Longest edge of the displaced truth's triangles in tile units; `silhouette.truth_converged` watches it."""

FEW_PIXELS = 200
"""Carves below this many pixels are judged by the distance between outlines: an IoU of a few pixels says little."""


def raster(context: Context) -> Iterator[Row]:
    """All layers of the 12k knot in torch, beside llvmpipe's peels and Embree's first hits."""
    knot, camera = shapes.torus_knot(), scenes.knot_view()
    calls: dict[str, Callable[[], object]] = {"torch": lambda: rasterize(camera, knot.vertices, knot.faces)}
    missing: dict[str, str] = {}
    try:
        peer = peers.Llvmpipe(camera, knot.vertices, knot.faces)
        calls |= {"llvmpipe 4 peels": lambda: peer.peel(4), "llvmpipe z pass": lambda: peer.peel(1)}
    except PeerMissing as error:
        missing["llvmpipe 4 peels"] = missing["llvmpipe z pass"] = str(error)
    try:
        calls["Embree first hit"] = peers.embree_first_hit(camera, knot.vertices, knot.faces)
    except PeerMissing as error:
        missing["Embree first hit"] = str(error)
    try:
        device = DeviceRaster(upload_mesh(knot.vertices, knot.faces), camera.width, camera.height)
        calls["opencl"] = lambda: device.draw(camera)
    except BackendError as error:
        missing["opencl"] = str(error)
    timing = time_together(calls, n=15 if context.quick else 41, warm=4, settle=4)
    ours = timing["torch"]
    for name, short, goal in (
        ("llvmpipe 4 peels", "llvmpipe_4peels", 1.3),
        ("llvmpipe z pass", "llvmpipe_z", None),
        ("Embree first hit", "embree_first_hit", None),
    ):
        other = timing.get(name)
        yield Row(
            id=f"raster.knot12k.vs_{short}",
            what=f"all layers of the 12k knot, 800 x 600, torch, over the time of {name}",
            value=None if other is None else round(ours.wall / other.wall, 3),
            unit="x",
            better="lower",
            goal=goal,
            spread=None if other is None else (round(ours.low / other.wall, 3), round(ours.high / other.wall, 3)),
            peer=None if other is None else f"{name} {other.wall:.1f} ms (CPU/cores {other.cpu:.1f})",
            n=ours.n,
            why=missing.get(name),
        )
    yield from _opencl_rows(timing, missing)
    layers = rasterize(camera, knot.vertices, knot.faces)
    yield Row(
        id="raster.knot12k.ms",
        what=f"the same, {len(layers.t)} fragments in {int(layers.start.diff().max())} layers",
        value=round(ours.wall, 2),
        unit="ms",
        better="lower",
        spread=(round(ours.low, 2), round(ours.high, 2)),
        n=ours.n,
        peer=f"CPU/cores {ours.cpu:.1f} ms",
    )


def _opencl_rows(timing: dict[str, Timing], missing: dict[str, str]) -> Iterator[Row]:
    """The OpenCL rasteriser, vertices to sorted layers, beside llvmpipe: how often as fast."""
    for name, short, goal in (("llvmpipe 4 peels", "llvmpipe_4peels", 10.0), ("llvmpipe z pass", "llvmpipe_z", 2.0)):
        unmeasured = Row(
            id=f"raster.opencl.vs_{short}",
            what=f"time of {name} over all layers of the 12k knot, 800 x 600, on OpenCL",
            value=None,
            unit="x",
            better="higher",
            goal=goal,
            why=missing.get("opencl", missing.get(name)),
        )
        if unmeasured.why is not None:
            yield unmeasured
            continue
        ours, other = timing["opencl"], timing[name]
        yield replace(
            unmeasured,
            value=round(other.wall / ours.wall, 3),
            spread=(round(other.wall / ours.high, 3), round(other.wall / ours.low, 3)),
            peer=f"{name} {other.wall:.1f} ms, ours {ours.wall:.1f} ms (CPU/cores {ours.cpu:.1f})",
            n=ours.n,
        )


def sheet(context: Context) -> Iterator[Row]:
    """A flat sheet of depth h on a cylinder: the paper's planar test carves h/2, the truth is h."""
    depth = 0.1
    camera = scenes.view((0.98, 0, 4), (0.98, 0, 0), projection="orthographic", view_height=0.4, width=400, height=400)
    pixel = 0.4 / 400
    body = shapes.cylinder(height=2 * math.pi / 8 * 3, tiles=(8, 3), triangles=60_000)
    tile = generators.sheet(h=depth / (2 * math.pi / 8))
    carves: dict[Silhouette, float] = {"none": 0.0, "paper": depth / 2, "curved": depth}
    for silhouette, expected in carves.items():
        mask = _mask(body, RayCastMdf(tile), camera, silhouette)[100:300]
        outline = 0.98 - 0.2 + pixel * float(mask.double().sum(1).mean())
        yield Row(
            id=f"sheet.cylinder.{silhouette}",
            what=f"outline of a sheet {depth / pixel:.0f} px deep on a cylinder: pixels off the expected carve of "
            f"{expected / pixel:.0f} px",
            value=round(abs(1 - outline - expected) / pixel, 3), unit="px", better="lower", goal=1.0,
        )  # fmt: skip


def silhouettes(context: Context) -> Iterator[Row]:
    """Carved pixels: the table against the ray-cast limit, both tests against the displaced mesh."""
    for name in MATERIALS:
        meso = generators.GENERATORS[name]()
        table, limit = bake_mdf.in_memory(meso, MdfOptions()), RayCastMdf(meso)
        table.depth(torch.zeros(1, 2))  # makes the relief, once per model: no part of a frame's time
        for case, (body, camera) in scenes.silhouette_cases().items():
            bare, seen = _mask(body, None, camera, "none"), _displaced_mask(body, meso, camera, MAX_EDGE)
            removed = bare & ~seen
            by_test: dict[str, float] = {}
            for test in TESTS:
                start = time.perf_counter()
                by_table = _mask(body, table, camera, test)
                seconds = time.perf_counter() - start
                by_limit = _mask(body, limit, camera, test)
                yield _table_row(test, name, case, bare, by_limit, by_table)
                for kind, mask in (("limit", by_limit), ("table", by_table)):
                    by_test[f"{test} {kind}"] = quality.iou(bare & ~mask, removed)
                    yield Row(
                        id=f"silhouette.{kind}_vs_truth.{test}.{name}.{case}",
                        what=f"{test} test with {'ray-cast D' if kind == 'limit' else 'the table'}, {name} on {case}: "
                        f"IoU of carved pixels with the displaced mesh ({int(removed.sum())} px)",
                        value=round(by_test[f"{test} {kind}"], 4),
                        unit="IoU",
                        better="higher",
                        peer=f"outlines {quality.boundary_distance(mask, seen):.2f} px apart, frame {seconds:.2f} s",
                        curve={"series": f"{name}, {test}, {kind}", "x": case},
                    )
            yield Row(
                id=f"silhouette.curved_gain.{name}.{case}",
                what=f"IoU with the displaced mesh, curved minus paper, both with the table, {name} on {case}",
                value=round(by_test["curved table"] - by_test["paper table"], 4),
                unit="IoU",
                better="higher",
                goal=0.0,
                peer=f"paper {by_test['paper table']:.3f}",
            )
    if not context.quick:
        yield from _truth_converged()


class _Interpolated:
    """An MDF that answers every question by interpolating its table, as `evaluate` does."""

    def __init__(self, mdf: Mdf):
        self.h, self.no_hit, self.delta_max = mdf.h, mdf.no_hit, mdf.delta_max
        self.evaluate = self.distance = mdf.evaluate
        self.depth = mdf.depth


def linear(context: Context) -> Iterator[Row]:
    """The table with D interpolated between its azimuths, for what the relief gains."""
    meso = generators.brick()
    table, limit = bake_mdf.in_memory(meso, MdfOptions()), RayCastMdf(meso)
    for case, (body, camera) in scenes.silhouette_cases().items():
        bare = _mask(body, None, camera, "none")
        carved = [bare & ~_mask(body, mdf, camera, "paper") for mdf in (_Interpolated(table), table, limit)]
        yield Row(
            id=f"linear.brick.{case}",
            what=f"paper test, brick on {case}, D interpolated in the table: IoU of carved pixels with ray-cast D",
            value=round(quality.iou(carved[0], carved[2]), 4),
            unit="IoU",
            better="higher",
            peer=f"relief {quality.iou(carved[1], carved[2]):.4f}",
        )


def mdf_resolution(context: Context) -> Iterator[Row]:
    """Directions and texels of the table against the ray-cast limit, brick on the torus of 3 x 1 tiles."""
    meso = generators.brick()
    body, camera = scenes.silhouette_cases()["torus3x1"]
    bare = _mask(body, None, camera, "none")
    limit: dict[Silhouette, Tensor] = {t: bare & ~_mask(body, RayCastMdf(meso), camera, t) for t in TESTS}
    texels = (64, 256) if context.quick else (32, 64, 128, 256, 512)
    grids = ("15, 10",) if context.quick else ("6, 4", "15, 10", "30, 20")
    sweep = [("texels", n, MdfOptions(texels=n)) for n in texels]
    for grid in grids:
        views = f"grid({grid}, 87.5)"
        sweep.append(("directions", len(hemisphere.parse(views)), MdfOptions(views=views)))
    for series, x, options in sweep:
        table = bake_mdf.in_memory(meso, options)
        table.depth(torch.zeros(1, 2))  # makes the relief, once per model: no part of a frame's time
        for test in TESTS:
            start = time.perf_counter()
            mask = _mask(body, table, camera, test)
            ms = round(1e3 * (time.perf_counter() - start), 1)
            yield Row(
                id=f"mdf_resolution.{series}.{x}.{test}",
                what=f"{test} test, brick on torus3x1, {options.views} x {options.texels} texels: IoU of carved pixels "
                "with ray-cast D",
                value=round(quality.iou(bare & ~mask, limit[test]), 4),
                unit="IoU",
                better="higher",
                curve={"series": f"{series}, {test}", "x": x, "ms": ms, "bytes": table.delta.numel()},
            )


def shadow(context: Context) -> Iterator[Row]:
    """Fig. 12: tori on a floor; pixels shadowed by another object, against ray-traced truth."""
    settings = figure12()
    mesos = {name: m.meso.build() for name, m in settings.materials.items() if m.meso is not None}
    tables = {name: Material(mdf=bake_mdf.in_memory(m, MdfOptions())) for name, m in mesos.items()}
    objects = tuple(
        Object(mesh=pipeline_scene.build_mesh(o), material=tables[str(o.material)]) for o in settings.objects
    )
    light, camera = settings.lights[0].build(), settings.camera.build()
    geometries = truth.geometries(settings)
    owner, depth, *rays = truth.first_hits(MeshTracer(*geometries), camera)
    expected = torch.zeros_like(owner, dtype=torch.bool)
    for i in range(len(objects)):
        rest = MeshTracer(*geometries[:i], *geometries[i + 1 :])
        expected |= _cast_on(owner, depth, i, (rays[0], rays[1]), partial(_occluded, rest, light=light))
    for test in TESTS:
        options = replace(settings.render, silhouette=test)
        picture = frame.render(Scene(objects=objects, lights=(light,)), camera, options)
        ours = torch.zeros_like(expected)
        for i in range(len(objects)):
            others = Scene(objects=objects[:i] + objects[i + 1 :], lights=(light,))
            size = options.shadow_map_size
            drawn = shadow_map.build(others, assemble(others), light, size=size, silhouette=test)
            ours |= _cast_on(picture.owner, picture.depth, i, (rays[0], rays[1]), partial(shadow_map.blocked, drawn))
        both = picture.owner == owner
        apart = quality.boundary_distance(ours & both, expected & both)
        yield Row(
            id=f"shadow.fig12.{test}",
            what=f"tori on a floor, {test} test, {options.shadow_map_size}^2 map: IoU of the "
            f"{int((expected & both).sum())} pixels shadowed by another object with ray-traced truth",
            value=round(quality.iou(ours & both, expected & both), 4),
            unit="IoU",
            better="higher",
            goal=0.95,
            peer=f"outlines {apart:.2f} px apart",
        )


def mdf(context: Context) -> Iterator[Row]:
    """D(u, v, wo) of sheet, groove and sphere field against their closed forms, at and between the samples."""
    texels, rng = 256, torch.Generator().manual_seed(0)
    tiles = {
        "sheet": (generators.sheet(), _sheet_depth),
        "groove": (generators.groove(), _groove_depth),
        "spheres": (generators.spheres(segments=512), _spheres_depth),
    }
    for name, (meso, closed_form) in tiles.items():
        table = bake_mdf.in_memory(meso, MdfOptions(texels=texels))
        views = table.directions.directions()
        chosen = torch.randperm(texels**2, generator=rng)[:4096]
        uv = texel_centres(texels, texels).reshape(-1, 2)[chosen]
        errors = []
        for v in range(0, len(views), 10):
            exact = closed_form(uv, views[v].expand(len(uv), 3)) * views[v, 2] / meso.h
            errors.append(255 * (table.delta[v].flatten()[chosen].float() / 255 - exact).abs())
        error = torch.cat(errors)
        # Where D jumps, a ray at the very edge may fall on either side: rounding decides, not the table.
        torn = error > 2
        yield Row(
            id=f"mdf.closed_form.{name}",
            what=f"largest error of the drop of {name} at the samples in codes of 1/255, "
            f"{float(torn.float().mean()):.3%} of them on a jump left out",
            value=round(float(error[~torn].max()), 3),
            unit="codes",
            better="lower",
            goal=1.0,
        )
        theta = torch.rand(4096, generator=rng) * math.radians(80)
        wo = from_angles(theta, torch.rand(4096, generator=rng) * 2 * math.pi)
        place = torch.rand(4096, 2, generator=rng)
        between = table.drop(place, wo)[0] - closed_form(place, wo) * wo[:, 2] / meso.h
        yield Row(
            id=f"mdf.between.{name}",
            what=f"mean error of the drop of {name} between the samples",
            value=round(float(between.abs().mean()), 5),
            unit="of h",
            better="lower",
        )


MEASUREMENTS = [
    Measurement("raster", raster),
    Measurement("sheet", sheet),
    Measurement("silhouette", silhouettes),
    Measurement("linear", linear),
    Measurement("mdf_resolution", mdf_resolution),
    Measurement("shadow", shadow),
    Measurement("btf", colour.btf),
    Measurement("mdf", mdf),
    Measurement("frame", speed.frame),
    Measurement("growth", speed.growth),
    Measurement("million", million.million),
    Measurement("minify", minify.minify),
    Measurement("limits", limits.limits),
    Measurement("compiled", speed.compiled),
]
"""In the order they run."""


def figure12() -> Config:
    """Return Fig. 12's scene: weave on tori, peanuts on the floor."""
    return config.load(built_in("fig12"))


def _mask(body: Mesh, mdf: DistanceFunction | None, camera: Camera, silhouette: Silhouette) -> Bool[Tensor, "H W"]:
    scene = Scene(objects=(Object(mesh=body, material=Material(mdf=mdf)),), lights=())
    return frame.render(scene, camera, FrameOptions(silhouette=silhouette, shadows=False)).owner >= 0


def _displaced_mask(body: Mesh, meso: Mesostructure, camera: Camera, max_edge: float) -> Bool[Tensor, "H W"]:
    laid = displace(body, meso, max_edge=max_edge)
    origin, direction, _ = camera.rays(camera.pixel_centres().reshape(-1, 2))
    return (RayScene(laid.vertices, laid.faces).first_hit(origin, direction).face >= 0).reshape(camera.height, -1)


def _table_row(test: str, name: str, case: str, bare: Tensor, limit: Tensor, table: Tensor) -> Row:
    """Judge the table by IoU of the carved pixels, or by the distance of outlines where the carve is small."""
    carved = int((bare & ~limit).sum())
    iou, apart = quality.iou(bare & ~table, bare & ~limit), quality.boundary_distance(table, limit)
    row_id = f"silhouette.table_vs_limit.{test}.{name}.{case}"
    what = f"{test} test, {name} on {case}: grid(15, 10, 87.5) x 256 against ray-cast D, {carved} px carved"
    if carved < FEW_PIXELS:
        return Row(
            id=row_id, what=what, value=round(apart, 3), unit="px", better="lower", goal=1.0, peer=f"IoU {iou:.3f}"
        )
    peer = f"outlines {apart:.3f} px apart"
    return Row(id=row_id, what=what, value=round(iou, 4), unit="IoU", better="higher", goal=0.95, peer=peer)


def _truth_converged() -> Iterator[Row]:
    """How much the displaced outline moves when its triangles are halved."""
    for name in MATERIALS:
        meso = generators.GENERATORS[name]()
        body, camera = scenes.silhouette_cases()["torus3x1"]
        coarse, fine = (_displaced_mask(body, meso, camera, e) for e in (MAX_EDGE, MAX_EDGE / 2))
        yield Row(
            id=f"silhouette.truth_converged.{name}",
            what=f"pixels of the displaced {name} torus that change when its longest edge {MAX_EDGE:g} is halved",
            value=round(100 * float((coarse != fine).sum() / fine.sum()), 4),
            unit="%",
            better="lower",
            goal=0.2,
        )


def _cast_on(owner: Tensor, depth: Tensor, i: int, rays: tuple[Tensor, Tensor], blocked) -> Bool[Tensor, "H W"]:
    """Return the pixels of object `i` whose point lies in the dark by `blocked`."""
    which = (owner.flatten() == i).nonzero()[:, 0]
    origin, direction = rays
    place = origin[which] + depth.flatten()[which, None] * direction[which]
    result = torch.zeros(owner.numel(), dtype=torch.bool)
    result[which] = blocked(place)
    return result.reshape(owner.shape)


def _occluded(tracer: MeshTracer, place: Tensor, light: Light) -> Bool[Tensor, "n"]:
    towards, distance, _ = illuminate(light, place)
    return tracer.occluded(place + 1e-4 * towards, towards, distance)


def _sheet_depth(uv: Tensor, wo: Tensor) -> Tensor:
    return 0.1 / wo[:, 2]


def _groove_depth(uv: Tensor, wo: Tensor) -> Tensor:
    """Down to the wall ahead or to the bottom, whichever is higher."""
    low, high, h = 0.3, 0.7, 0.1
    u = uv[:, 0] % 1
    drift = -wo[:, 0] / wo[:, 2]  # along u per unit of depth
    ahead = torch.where(drift > 0, high - u, u - low) / drift.abs().clamp(min=1e-12)
    depth = torch.where((u > low) & (u < high), ahead.clamp(max=h), 0)
    return depth / wo[:, 2]


def _spheres_depth(uv: Tensor, wo: Tensor) -> Tensor:
    """The nearest of all spheres a ray passes on its way to the floor."""
    radius, h, count = 0.22, 0.3, 2
    result = h / wo[:, 2]
    origin, way = torch.cat([uv % 1, torch.zeros(len(uv), 1)], 1).double(), -wo.double()
    reach = math.ceil(float((h * wo[:, :2].norm(dim=-1) / wo[:, 2]).max())) + 1
    for i in range(-reach * count, (reach + 1) * count):
        for j in range(-reach * count, (reach + 1) * count):
            centre = torch.tensor([(i + 0.5) / count, (j + 0.5) / count, -radius], dtype=torch.float64)
            offset = origin - centre
            b = (offset * way).sum(-1)
            root = b.square() - offset.square().sum(-1) + radius**2
            t = -b - root.clamp(min=0).sqrt()
            result = torch.where((root >= 0) & (t >= 0) & (t < result), t, result.double())
    return result.to(uv.dtype)
