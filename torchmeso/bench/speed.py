"""Rows of the suite `render` on time: whole frames beside peers, growth, the first frame, memory.

Frames are what a screen shows, steady: each timed call follows four untimed ones, and shadow maps are drawn every time
unless a row says otherwise.

Test: tests/bench/test_speed.py
"""

import itertools
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from statistics import median

import torch

from torchmeso.bench import frames, peers
from torchmeso.bench.peers import PeerMissing
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import Timing, time_together
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.mdf import Mdf
from torchmeso.geometry import shapes
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.light import DirectionalLight
from torchmeso.meso import generators
from torchmeso.meso.displace import displace
from torchmeso.render import frame as torch_frame
from torchmeso.render.frame import FrameOptions, Skips
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Material, Object, Scene, in_double
from torchmeso.render.silhouette import Silhouette

MAP = 768
"""Side of shadow maps in timed frames."""


def renderer(scene: Scene, silhouette: Silhouette, *, shadows: bool, filtering: bool = True) -> Renderer:
    """Return a renderer that draws its shadow maps anew every frame."""
    options = FrameOptions(
        silhouette=silhouette,
        shadows=shadows,
        shadow_map_size=MAP,
        filtering=filtering,
        skips=Skips(resting=False),
    )
    return Renderer(scene, options)


def frame(context: Context) -> Iterator[Row]:
    """Frames beside peers, the first frame, memory."""
    for measure in (against_embree, against_itself, updates, first_frame, memory):
        yield from measure(context)


def against_embree(context: Context) -> Iterator[Row]:
    """Frames of the 12k knot beside rays on the displaced mesh: Embree, and Mitsuba's whole picture."""
    timed = frames.knot()
    scene = frames.build(timed, context.report)
    light = scene.lights[0]
    assert isinstance(light, DirectionalLight)
    displaced = displace(scene.objects[0].mesh, generators.brick())
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for coverage in (0.28, 0.5):
            camera = frames.camera_at(scene, timed, coverage)
            calls: dict[str, Callable[[], object]] = {}
            for silhouette in ("paper", "curved"):
                for shadows in (False, True):
                    drawn = renderer(scene, silhouette, shadows=shadows, filtering=False)  # a ray sees a point
                    calls[f"{silhouette}{' + shadows' * shadows}"] = partial(drawn.show, camera)
            missing, rays = None, None
            try:
                rays = peers.Embree(displaced.vertices, displaced.faces, camera, light.direction)
                calls |= rays.calls
            except PeerMissing as error:
                missing = str(error)
            timing = time_together(calls, n=9 if context.quick else 25, warm=3, settle=4)
            if rays is not None:
                timing |= {f"Embree {x}": rays.faster(timing, x) for x in ("primary", "primary + shadow")}
            percent = round(100 * coverage)
            n = len(displaced.faces)
            for silhouette in ("paper", "curved"):
                for shadows, peer, goal in (
                    ("", "Embree primary", 4.5),
                    (" + shadows", "Embree primary + shadow", 3.5),
                ):
                    yield ratio(
                        f"frame.{silhouette}{'.shadow' * bool(shadows)}.vs_embree.{percent}",
                        f"BTF, {silhouette} silhouette{shadows}, 12k knot at {percent} % coverage: times as fast as "
                        f"{peer.removeprefix('Embree ')} rays of Embree on {n} displaced triangles",
                        timing, f"{silhouette}{shadows}", peer, goal if coverage == 0.28 else None, missing,
                    )  # fmt: skip
            if coverage == 0.28:
                yield from _mitsuba(displaced.vertices, displaced.faces, camera, light, timing, context)
    finally:
        torch.set_num_threads(threads)


def _mitsuba(vertices, faces, camera: Camera, light: DirectionalLight, timing: dict[str, Timing], context: Context):
    row = Row(
        id="frame.curved.shadow.vs_mitsuba", unit="x", better="higher", goal=2.5, value=None,
        what="BTF, curved silhouette and shadows, 12k knot: times as fast as Mitsuba llvm on the displaced triangles",
    )  # fmt: skip
    try:
        ms = peers.mitsuba(vertices, faces, camera, light.direction, n=9 if context.quick else 25)
    except PeerMissing as error:
        yield replace(row, why=str(error))
        return
    ours = timing["curved + shadows"]
    yield replace(
        row, value=round(median(ms) / ours.wall, 2), n=ours.n,
        peer=f"Mitsuba {median(ms):.1f} ms, ours {ours.wall:.1f} ms",
    )  # fmt: skip


def ratio(
    name: str,
    what: str,
    timing: dict[str, Timing],
    ours: str,
    peer: str,
    goal: float | None,
    missing: str | None = None,
) -> Row:
    """Return how often `ours` is as fast as `peer`."""
    row = Row(id=name, what=what, value=None, unit="x", better="higher", goal=goal, why=missing)
    if missing is not None:
        return row
    a, b = timing[ours], timing[peer]
    return replace(
        row, value=round(b.wall / a.wall, 2), spread=(round(b.low / a.high, 2), round(b.high / a.low, 2)), n=a.n,
        peer=f"{peer} {b.wall:.1f} ms, ours {a.wall:.1f} ms (fastest {a.low:.1f}, CPU/cores {a.cpu:.1f})",
    )  # fmt: skip


def against_itself(context: Context) -> Iterator[Row]:
    """OpenCL beside torch, and a frame without mesostructure beside one whose code knows of none."""
    timed = frames.knot()
    scene = frames.build(timed, context.report)
    camera = frames.camera_at(scene, timed, 0.28)
    options = FrameOptions(silhouette="curved", shadow_map_size=MAP)
    fast = renderer(scene, "curved", shadows=True)
    calls: dict[str, Callable[[], object]] = {
        "torch": lambda: torch_frame.render(scene, camera, options),
        "opencl": lambda: fast.render(camera),
    }
    timing = time_together(calls, n=3 if context.quick else 9, warm=1, settle=0)
    yield ratio(
        "frame.opencl_vs_torch", "curved silhouette, shadows, all outputs, 12k knot: opencl over torch", timing,
        "opencl", "torch", 4.0,
    )  # fmt: skip
    exact = torch_frame.render(in_double(scene), camera, options)
    picture = fast.render(camera)
    wrong = (picture.rgb - exact.rgb).abs().amax(-1) > 1 / 255
    yield Row(
        id="frame.opencl_vs_torch.pixels_off",
        what="pixels of the same frame that differ by more than 1/255 from torch in float64, all causes",
        value=round(100 * float(wrong.double().mean()), 5), unit="%", better="lower", goal=0.05,
        peer=f"largest difference elsewhere {float((picture.rgb - exact.rgb).abs().amax(-1)[~wrong].max()):.1e}",
    )  # fmt: skip

    bare = Scene(
        objects=tuple(Object(mesh=o.mesh, material=Material(btf=o.material.btf)) for o in scene.objects),
        lights=scene.lights,
    )
    plain = renderer(bare, "curved", shadows=False)
    options = FrameOptions(silhouette="none", shadows=False, skips=Skips(resting=False))
    least = Renderer(bare, options, one_layer=True)
    timing = time_together(
        {"plain": lambda: plain.show(camera), "one layer": lambda: least.show(camera)},
        n=25 if context.quick else 61, warm=3, settle=4,
    )  # fmt: skip
    a, b = timing["plain"], timing["one layer"]
    yield Row(
        id="frame.plain_vs_one_layer",
        what="frame without mesostructure over one that keeps one layer and has no silhouette code",
        value=round(a.wall / b.wall, 3), unit="x", better="lower", goal=1.1, n=a.n,
        peer=f"one layer {b.wall:.2f} ms, ours {a.wall:.2f} ms",
    )  # fmt: skip


def compiled(context: Context) -> Iterator[Row]:
    """OpenCL beside the same frame through torch's compiler, which takes minutes to compile it."""
    row = Row(
        id="compiled.opencl_vs_torch", unit="x", better="higher", value=None,
        what="curved silhouette, shadows, all outputs, 12k knot: opencl over torch with its hot arithmetic through "
        "torch.compile",
    )  # fmt: skip
    if context.quick:
        yield replace(row, why="left out by --quick: compiling takes minutes")
        return
    timed = frames.knot()
    scene = frames.build(timed, context.report)
    camera = frames.camera_at(scene, timed, 0.28)
    try:
        ms, compiling = peers.compiled_torch(n=5)
    except PeerMissing as error:
        yield replace(row, why=str(error))
        return
    fast = renderer(scene, "curved", shadows=True)
    ours = time_together({"opencl": lambda: fast.render(camera)}, n=9, warm=3)["opencl"]
    yield replace(
        row, value=round(median(ms) / ours.wall, 2), n=len(ms),
        peer=f"torch.compile {median(ms):.0f} ms after {compiling:.0f} s of compiling, ours {ours.wall:.1f} ms",
    )  # fmt: skip


def updates(context: Context) -> Iterator[Row]:
    """A frame in which something changed alone, beside one of a new renderer."""
    timed = frames.knot()
    scene = frames.build(timed, context.report)
    camera = frames.camera_at(scene, timed, 0.28)
    body, options = scene.objects[0], FrameOptions(shadow_map_size=MAP)
    btf, sun, steps = body.material.btf, scene.lights[0], itertools.count(1)
    assert isinstance(btf, EigenBtf)
    others = itertools.cycle([replace(body.material, btf=replace(btf)) for _ in range(2)])
    assert isinstance(sun, DirectionalLight)
    changes: dict[str, Callable[[], Scene]] = {
        "mesh": lambda: replace(scene, objects=(replace(body, mesh=replace(body.mesh)),)),
        "material": lambda: replace(scene, objects=(replace(body, material=next(others)),)),
        "light": lambda: replace(scene, lights=(replace(sun, irradiance=next(steps) * sun.irradiance),)),
        "nothing": lambda: scene,
    }
    renderers = {name: Renderer(scene, options) for name in changes}

    def draw(name: str) -> None:
        renderers[name].update(changes[name]())
        renderers[name].show(camera)

    calls: dict[str, Callable[[], object]] = {name: partial(draw, name) for name in changes}
    calls["all"] = lambda: Renderer(scene, options).show(camera)
    timing = time_together(calls, n=9 if context.quick else 25, warm=3, settle=1)
    for name in changes:
        yield Row(
            id=f"frame.update.{name}",
            what=f"12k knot: a new renderer's frame, over a frame in which {name} changed",
            value=round(timing["all"].wall / timing[name].wall, 2), unit="x", better="higher", n=timing["all"].n,
            peer=f"new {timing['all'].wall:.1f} ms, {name} changed {timing[name].wall:.1f} ms",
            curve={"series": "update", "x": name, "ms": round(timing[name].wall, 2)},
        )  # fmt: skip


def first_frame(context: Context) -> Iterator[Row]:
    """The first frame of a process: from a loaded scene to a picture, with the kernels in the disk cache."""
    frames.build(frames.knot(), context.report)  # fills the cache of materials
    code = (
        "import time; start = time.perf_counter()\n"
        "from torchmeso.bench import frames, speed\n"
        "timed = frames.knot(); scene = frames.build(timed)\n"
        "camera = timed.config.camera.build(); loaded = time.perf_counter()\n"
        "speed.renderer(scene, 'curved', shadows=True).show(camera)\n"
        "print(loaded - start, time.perf_counter() - loaded)\n"
    )
    found = []
    for _ in range(2 if context.quick else 4):
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        found.append([float(x) for x in run.stdout.split()])
    loads, firsts = zip(*found[1:], strict=True)
    yield Row(
        id="frame.first", what="first frame of a process: upload, kernels from the disk cache, shadow map, picture",
        value=round(median(firsts), 3), unit="s", better="lower", goal=1.0, n=len(firsts),
        peer=f"before it: imports and scene {median(loads):.2f} s",
    )  # fmt: skip


def memory(context: Context) -> Iterator[Row]:
    """Peak memory, and what a thousand frames add to it."""
    timed = frames.knot()
    scene = frames.build(timed, context.report)
    draw = renderer(scene, "curved", shadows=True)
    cameras = [frames.camera_at(scene, timed, c) for c in (0.2, 0.28, 0.4)]
    count = 200 if context.quick else 1000
    for i in range(50):
        draw.show(cameras[i % 3])
    before = _resident()
    for i in range(count):
        draw.show(cameras[i % 3])
    yield Row(
        id="frame.memory.growth", what=f"memory that {count} frames of three views add", unit="MB", better="lower",
        value=round(max(_resident() - before, 0.0), 2), goal=2.0, n=count,
        peer=f"resident {_resident():.0f} MB",
    )  # fmt: skip
    yield Row(
        id="frame.memory.peak", what="peak memory of this process so far, everything it measured included", unit="MB",
        value=round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024), better="lower",
    )  # fmt: skip


def _resident() -> float:
    """Return the memory this process holds now, in MB."""
    with open("/proc/self/statm") as statm:
        return int(statm.read().split()[1]) * resource.getpagesize() / 2**20


def growth(context: Context) -> Iterator[Row]:
    """Time of a frame over triangles, pixels, layers, lights and texels."""
    timed = frames.knot()
    scene = frames.build(timed, context.report)
    material, lights = scene.objects[0].material, scene.lights
    camera = frames.camera_at(scene, timed, 0.28)
    n = 5 if context.quick else 15

    def row(series: str, x: float, subject: Scene, view: Camera, **options) -> Row:
        draw = Renderer(subject, FrameOptions(shadow_map_size=MAP, skips=Skips(resting=False), **options))
        t = time_together({"frame": lambda: draw.show(view)}, n=n, warm=3)["frame"]
        return Row(
            id=f"growth.{series}.{x:g}", what=f"frame of the knot, curved, shadows; {series}: {x:g}",
            value=round(t.wall, 2), unit="ms", better="lower", spread=(round(t.low, 2), round(t.high, 2)), n=n,
            curve={"series": series, "x": x, "ms": round(t.wall, 2)},
        )  # fmt: skip

    for triangles in (1_000, 12_000, 100_000, 1_000_000):
        mesh = shapes.torus_knot(tiles=(40, 4), triangles=triangles)
        subject = Scene(objects=(Object(mesh=mesh, material=material),), lights=lights)
        yield row("triangles", triangles, subject, camera)
    for scale in (0.5, 1, 2):
        view = replace(camera, width=int(800 * scale), height=int(600 * scale))
        yield row("pixels", view.width * view.height, scene, view)
    for count in (1, 2, 4, 8):
        turned = tuple(
            DirectionalLight(direction=_turned(lights[0].direction, i / count), irradiance=lights[0].irradiance / count)
            for i in range(count)
            if isinstance(lights[0], DirectionalLight)
        )
        yield row("lights", count, replace(scene, lights=turned), camera)
    for layers in (1, 2, 4, 8):
        body = shapes.sphere(triangles=2000)
        nested = tuple(Object(mesh=_scaled(body, 1 - 0.08 * i), material=material) for i in range(layers))
        yield row("nested_bodies", layers, Scene(objects=nested, lights=lights), frames.knot().config.camera.build())
    for factor in (1, 2, 4):
        yield row("texels", 64 * factor, replace(scene, objects=(_finer(scene.objects[0], factor),)), camera)


def _finer(subject: Object, factor: int) -> Object:
    """Return an object with `factor` times the texels along a side: each one repeated."""
    btf, mdf = subject.material.btf, subject.material.mdf
    assert isinstance(btf, EigenBtf)
    assert isinstance(mdf, Mdf)
    maps = btf.maps.repeat_interleave(factor, 1).repeat_interleave(factor, 2)
    delta = mdf.delta.repeat_interleave(factor, 1).repeat_interleave(factor, 2)
    material = Material(btf=replace(btf, maps=maps), mdf=replace(mdf, delta=delta))
    return Object(mesh=subject.mesh, material=material)


def _turned(direction: torch.Tensor, share: float) -> torch.Tensor:
    angle = torch.tensor(2 * torch.pi * share)
    x, y, z = direction
    return torch.stack([x * angle.cos() + z * angle.sin(), y, z * angle.cos() - x * angle.sin()])


def _scaled(body, size: float):
    from torchmeso.geometry import mesh

    matrix = torch.eye(4) * size
    matrix[3, 3] = 1
    return mesh.transform(body, matrix)
