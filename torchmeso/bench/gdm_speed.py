"""Rows of the suite `gdm` on time: frames of shells beside Embree, the paper's rates, both backends; lost rays.

Frames are 512 x 512, with one light; those "with shadows" draw their shadow map (768^2) every time. The twin is the
same weave, laid over the same mesh as triangles. The paper's meshes are not at hand: shapes with its triangle counts
stand in, and the coverage is that of the picture.

Test: tests/bench/test_gdm_speed.py
"""

from collections.abc import Iterator
from dataclasses import asdict, replace
from functools import partial
from typing import Literal, NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from torchmeso.bench import peers
from torchmeso.bench.peers import PeerMissing
from torchmeso.bench.slices import Slices
from torchmeso.bench.speed import MAP, ratio
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import time_together
from torchmeso.data import gdm as gdm_data
from torchmeso.data import store
from torchmeso.data.gdm import Gdm
from torchmeso.geometry import shapes, shell
from torchmeso.geometry.camera import Camera, look_at
from torchmeso.geometry.directions import normalize
from torchmeso.geometry.light import DirectionalLight
from torchmeso.geometry.mesh import Mesh
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.meso.displace import displace
from torchmeso.pipeline.bake import code_hash
from torchmeso.render import device_gdm, gdm_trace
from torchmeso.render import frame as torch_frame
from torchmeso.render.device_trace import DeviceTrace
from torchmeso.render.frame import FrameOptions, Skips
from torchmeso.render.gdm_trace import Entries
from torchmeso.render.rasterize import rasterize
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Material, Object, Scene, ShellOptions

SIZE = 512
LIGHT = DirectionalLight(direction=normalize(torch.tensor([0.5, 0.8, 0.4])), irradiance=torch.full((3,), torch.pi))
EYE = (0.0, 2.04, 2.21)
"""From where a torus fills three quarters of the picture."""

RAYS = 10_000_000


class Row7(NamedTuple):
    """A row of Fig. 7 of wang2004gdm under local illumination: what stands in for it, and the paper's rate."""

    mesh: Mesh
    meso: str
    arguments: dict
    texels: int
    layers: int
    base: Literal["solid", "open"]
    fps: float


def rows_7() -> dict[str, Row7]:
    """Return the rows of Fig. 7."""
    return {
        "teapot": Row7(shapes.sphere(triangles=4276, tiles=(8, 4)), "weave", {"backing": True}, 64, 32, "solid", 56.0),
        "vase": Row7(shapes.sphere(triangles=8640, tiles=(8, 4)), "grid", {}, 32, 16, "open", 71.3),
        "torus": Row7(shapes.torus(triangles=4880, tiles=(7, 3)), "chain", {}, 64, 32, "solid", 40.8),
        "bird": Row7(
            shapes.torus_knot(triangles=11603, tiles=(20, 2)), "weave", {"backing": True}, 64, 32, "solid", 46.4
        ),
        "dinosaur": Row7(shapes.torus(triangles=2142, tiles=(8, 3)), "squama", {}, 64, 32, "solid", 80.9),
    }


def table(name: str, options: GdmOptions, context: Context, **arguments: object) -> Gdm:
    """Return a baked GDM, from the cache where it is there."""
    key = store.content_hash([name, arguments, code_hash()], asdict(options))
    path = store.cache_dir() / f"{key}.gdm.zarr"
    if not (path.exists() and store.attributes(store.open_table(path, "gdm")).get("key") == key):
        store.cache_dir().mkdir(parents=True, exist_ok=True)
        meso = generators.GENERATORS[name](**arguments)
        told = partial(context.report, f"{name}: GDM")
        bake_gdm.bake(meso, options, path, about={"key": key}, progress=told)
    return gdm_data.load(path)


def view(eye: tuple[float, float, float] = EYE) -> Camera:
    """Return a view of the middle from `eye`."""
    place, axes = look_at(*(torch.tensor(x, dtype=torch.float64) for x in (eye, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))))
    return Camera(eye=place, axes=axes, fov_deg=40.0, width=SIZE, height=SIZE)


def scene_of(mesh: Mesh, material: Material) -> Scene:
    """Return a mesh alone in the light."""
    return Scene(objects=(Object(mesh=mesh, material=material),), lights=(LIGHT,), ambient=0.1)


def drawn(scene: Scene, *, shadows: bool) -> Renderer:
    """Return a renderer that draws its shadow map every time."""
    return Renderer(scene, FrameOptions(shadows=shadows, shadow_map_size=MAP, skips=Skips(resting=False)))


def against_embree(context: Context) -> Iterator[Row]:
    """Frames of a 12k shell beside rays of Embree on the twin."""
    mesh = shapes.torus(triangles=12000, tiles=(5, 2))
    twin = displace(mesh, generators.weave(backing=True))
    camera, n = view(), len(twin.faces)
    missing, rays = None, None
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        try:
            rays = peers.Embree(twin.vertices, twin.faces, camera, LIGHT.direction)
        except PeerMissing as error:
            missing = str(error)
        for texels, goals in ((32, (2.2, 3.5)), (64, (1.8, 3.0))):
            gdm = table("weave", GdmOptions(texels=texels, layers=texels // 2), context, backing=True)
            scene = scene_of(mesh, Material(gdm=gdm))
            renderers = {"frame": drawn(scene, shadows=False), "frame + shadows": drawn(scene, shadows=True)}
            calls = {name: partial(r.show, camera) for name, r in renderers.items()}
            timing = time_together(
                calls | (rays.calls if rays is not None else {}), n=9 if context.quick else 25, warm=3, settle=2
            )
            if rays is not None:
                timing |= {f"Embree {x}": rays.faster(timing, x) for x in ("primary", "primary + shadow")}
            counts = renderers["frame"].counts
            covered = round(100 * counts["pixels with a fragment"] / counts["pixels"])
            for ours, peer, goal in zip(calls, ("Embree primary", "Embree primary + shadow"), goals, strict=True):
                yield ratio(
                    f"embree.{texels}.{'shadow' if 'shadow' in ours else 'primary'}",
                    f"GDM {texels}x{texels}x{texels // 2}, 12,000 prisms, {covered} % coverage, {ours}: times as fast "
                    f"as {peer.removeprefix('Embree ')} rays of Embree on {n} triangles",
                    timing, ours, peer, goal, missing,
                )  # fmt: skip
            held = device_gdm.held_bytes(gdm)
            beside = n * (36 + 12) + n * 64  # vertices and faces as they are; Embree's tree takes no less than this
            yield Row(
                id=f"embree.{texels}.memory",
                what=f"mesh and tree of {n} triangles over the distances and bits that kernels read",
                value=round(beside / held, 2), unit="x", better="higher", goal=50 if texels == 64 else None,
                peer=f"{held / 1e6:.2f} MB, every voxel apart {device_gdm.table_bytes(gdm) / 1e6:.0f} MB, material "
                f"{16 * gdm.occupancy.numel() / 1e6:.1f} MB, twin at least {beside / 1e6:.0f} MB",
            )  # fmt: skip
    finally:
        torch.set_num_threads(threads)


def figure_7(context: Context) -> Iterator[Row]:
    """Our frames per second, shadows drawn every time, beside the paper's."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for name, row in rows_7().items():
            gdm = table(row.meso, GdmOptions(texels=row.texels, layers=row.layers), context, **row.arguments)
            shelled = Material(gdm=gdm, shell=ShellOptions(base=row.base))
            renderer = drawn(scene_of(row.mesh, shelled), shadows=True)
            eye = (0.0, 2.6, 3.2) if name == "bird" else EYE
            t = time_together({"ours": partial(renderer.show, view(eye))}, n=9 if context.quick else 25, warm=3)["ours"]
            fps = 1000 / min(t.wall, t.cpu)
            counts = renderer.counts
            covered = round(100 * counts["pixels with a fragment"] / counts["pixels"])
            yield Row(
                id=f"fig7.{name}",
                what=f"{len(row.mesh.faces)} triangles, {row.meso} {row.texels}x{row.texels}x{row.layers}, shadows, "
                f"{covered} % coverage: our FPS over the paper's {row.fps}",
                value=round(fps / row.fps, 2), unit="x", better="higher", goal=None if name == "vase" else 1.0, n=t.n,
                peer=f"{fps:.0f} FPS ({1000 / t.low:.0f} at best), {counts['prisms passed']} prisms passed",
            )  # fmt: skip
    finally:
        torch.set_num_threads(threads)


def backends(context: Context) -> Iterator[Row]:
    """One frame on OpenCL beside torch, and the steps per second of the torch walk."""
    gdm = table("weave", GdmOptions(texels=32, layers=16), context, backing=True)
    mesh, camera = shapes.torus(triangles=4880, tiles=(7, 3)), view()
    scene, options = scene_of(mesh, Material(gdm=gdm)), FrameOptions(shadow_map_size=MAP)
    renderer = Renderer(scene, options)
    timing = time_together(
        {"torch": lambda: torch_frame.render(scene, camera, options), "ours": lambda: renderer.show(camera)},
        n=1 if context.quick else 3, warm=1,
    )  # fmt: skip
    yield ratio(
        "backends.opencl_vs_torch", "a frame with shadows, 512 x 512, 4,880 prisms: times as fast as torch", timing,
        "ours", "torch", 10, None,
    )  # fmt: skip
    built, entries, _ = camera_entries(mesh, gdm.h, camera)
    passed = int(gdm_trace.trace(built, gdm, entries).prisms.sum())
    t = time_together({"trace": lambda: gdm_trace.trace(built, gdm, entries)}, n=3, warm=0)["trace"]
    yield Row(
        id="backends.torch.steps", what="prisms that rays pass in the torch trace, float64, per second",
        value=round(passed / t.wall / 1e3, 3), unit="Msteps/s", better="higher", goal=2.0, n=3,
        peer=f"{passed} prisms in {t.wall:.0f} ms",
    )  # fmt: skip


def walk(context: Context) -> Iterator[Row]:
    """All pixels of the test scenes: the same prisms as in float64 from entry to exit, and the same material met."""
    for name, row in rows_7().items():
        gdm = table(row.meso, GdmOptions(texels=row.texels, layers=row.layers), context, **row.arguments)
        built, entries, _ = camera_entries(row.mesh, gdm.h, view())
        truth = gdm_trace.trace(built, None, entries, floor=False)
        found = DeviceTrace(built, row.mesh, None, floor=False).trace(entries)
        same = (found.prism == truth.prism) & (found.through == truth.through) & (found.prisms == truth.prisms)
        yield Row(
            id=f"walk.{name}.same",
            what=f"{len(same)} rays through the shell: the same prisms as float64, ways under 1e-5 left out",
            value=round(100 * float(same.double().mean()), 4), unit="%", better="higher", goal=99.99,
            peer=f"{int((~same).sum())} differ, {int((found.prisms < 0).sum())} lost",
        )  # fmt: skip
        floor = row.base == "solid"
        truth = gdm_trace.trace(built, gdm, entries, floor=floor)
        found = DeviceTrace(built, row.mesh, gdm, floor=floor).trace(entries)
        agree = (found.hit == truth.hit) & (found.prism == truth.prism)
        yield Row(
            id=f"walk.{name}.hits", what=f"of these, {row.meso}: a hit or none, and the prism, as in float64",
            value=round(100 * float(agree.double().mean()), 4), unit="%", better="higher", goal=99.99,
            peer=f"{int((~agree).sum())} differ",
        )  # fmt: skip


def leaks(context: Context) -> Iterator[Row]:
    """Rays through shared edges, vertices, slivers, along fins and at grazing angles: all of them come out."""
    rng = torch.Generator().manual_seed(11)
    bodies = {
        "torus": (shapes.torus(triangles=2000, tiles=(6, 2)), 0.2),
        "slivers": (_squeezed(shapes.torus(triangles=2000, tiles=(6, 2))), 0.2),
        "plane": (shapes.plane(triangles=512, tiles=(4, 4)), 0.3),
    }
    each = (RAYS // 10 if context.quick else RAYS) // (len(bodies) * 5)
    n, lost, stuck = 0, 0, 0
    for name, (mesh, h) in bodies.items():
        built = shell.build(mesh, h)
        device = DeviceTrace(built, mesh, None, floor=False)
        for k, kind in enumerate(("faces", "edges", "vertices", "fins", "grazing")):
            context.report(f"bench leaks: {name}, {kind}", k / 5)
            left = each
            while left > 0:
                count = min(left, 1 << 18)
                found = device.trace(random_entries(built, count, kind, rng))
                entered = (found.prisms != 0) | (found.through != 0)
                lost += int((entered & ~torch.isin(found.through, torch.tensor([-1, -2, -3]))).sum())
                stuck += int((found.prisms < 0).sum())
                n += count
                left -= count
    yield Row(
        id="leaks.lost", what=f"of {n} rays those that do not come out of the shell by its boundary", value=lost,
        unit="rays", better="lower", goal=0,
    )  # fmt: skip
    yield Row(id="leaks.endless", what=f"of {n} rays", value=stuck, unit="rays", better="lower", goal=0)


def random_entries(built: shell.Shell, n: int, kind: str, rng: torch.Generator) -> Entries:
    """Return rays into a shell: through faces, exactly through edges or vertices, along fins, or at 89.9 degrees."""
    bound = shell.boundary(built, base="open")
    k = torch.randint(len(bound.faces), (n,), generator=rng)
    share = torch.rand(n, 3, generator=rng, dtype=torch.float64)
    if kind == "edges":
        share[:, 0] = 0
    if kind == "vertices":
        share[:, :2] = 0
    share = share / share.sum(1, keepdim=True)
    corner = built.vertices[bound.faces[k]]
    point = (share[..., None] * corner).sum(1)
    normal = normalize(torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    w = normalize(torch.randn(n, 3, generator=rng, dtype=torch.float64))
    if kind == "fins":  # along an edge of the face, and down
        w = normalize(normalize(corner[:, 1] - corner[:, 0]) - torch.rand(n, 1, generator=rng) * normal)
    if kind == "grazing":
        flat = normalize(w - (w * normal).sum(-1, keepdim=True) * normal)
        w = normalize(flat - 1.7453e-3 * normal)
    w = torch.where((w * normal).sum(-1, keepdim=True) > 0, -w, w)
    return Entries(point - 0.2 * w, w, bound.tet[k], bound.corner[k])


def slices(context: Context) -> Iterator[Row]:
    """Frame time over the layers of the volume, ours and of the same volume drawn as textured slices."""
    mesh, camera = shapes.torus(triangles=12000, tiles=(5, 2)), view()
    gdms = {n: table("weave", GdmOptions(texels=64, layers=n), context, backing=True) for n in (16, 64)}
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        calls = {}
        for n, gdm in gdms.items():
            scene = scene_of(mesh, Material(gdm=gdm))
            calls[f"shadows {n}"] = partial(drawn(scene, shadows=True).show, camera)
            calls[f"plain {n}"] = partial(drawn(scene, shadows=False).show, camera)
            calls[f"slices {n}"] = partial(Slices(mesh, gdm, camera, LIGHT).draw, camera)
        timing = time_together(calls, n=5 if context.quick else 15, warm=3, settle=2)
    finally:
        torch.set_num_threads(threads)
    kinds = {
        "direct": ("shadows", "direct table, with shadows", 40),
        "plain": ("plain", "direct table, without shadows", None),
        "baseline": ("slices", "drawn as textured slices, without shadows", None),
    }
    for name, (key, what, goal) in kinds.items():
        few, many = timing[f"{key} 16"], timing[f"{key} 64"]
        yield Row(
            id=f"slices.{name}", what=f"64 layers beside 16, 64 x 64 voxels, {what}: more time",
            value=round(100 * (many.wall / few.wall - 1), 1), unit="%", better="lower", goal=goal, n=few.n,
            peer=f"{few.wall:.1f} ms and {many.wall:.1f} ms",
        )  # fmt: skip
    for n in gdms:
        ours, theirs = timing[f"plain {n}"], timing[f"slices {n}"]
        yield Row(
            id=f"slices.vs_baseline.{n}", what=f"{n} layers, without shadows: times as fast as textured slices",
            value=round(theirs.wall / ours.wall, 2), unit="x", better="higher", n=ours.n,
            peer=f"slices {theirs.wall:.1f} ms, ours {ours.wall:.1f} ms",
        )  # fmt: skip


def camera_entries(mesh: Mesh, h: float, camera: Camera) -> tuple[shell.Shell, Entries, Int[Tensor, "n"]]:
    """Return a shell and the rays of a picture, each where it first comes in, and their pixels."""
    built = shell.build(mesh, h)
    bound = shell.boundary(built)
    layers = rasterize(camera, built.vertices, bound.faces)
    front = layers.triangles.front[layers.triangle].nonzero()[:, 0]
    pixel = layers.pixel[front]
    first = torch.ones_like(pixel, dtype=torch.bool)
    first[1:] = pixel[1:] != pixel[:-1]
    entering = front[first]
    face = layers.triangles.face[layers.triangle[entering]]
    xy: Tensor = camera.pixel_centres(torch.float64).reshape(-1, 2)[layers.pixel[entering]]
    origin, direction, _ = camera.rays(xy)
    # From where the face is, so that float32 is enough on both sides.
    start = origin + layers.t[entering, None] * direction
    entries = Entries(start.float().double(), direction.float().double(), bound.tet[face], bound.corner[face])
    return built, entries, layers.pixel[entering]


def _squeezed(mesh: Mesh) -> Mesh:
    """Return a mesh as flat as paper, so that its triangles are needles."""
    return replace(mesh, vertices=mesh.vertices * torch.tensor([1.0, 0.02, 1.0]))
