"""Rows of the suite `gdm` on view-dependent displacement maps (`bench.vdm`): their frames beside ours and the truth.

wang2004gdm, Fig. 8: an undulating open surface and a vase. The truth is the same weave, laid over the same mesh as
triangles, ray by ray. Frames are drawn without shadows, which VDMs answer from other tables; they stand alone.

Test: tests/bench/test_gdm_vdm.py
"""

import math
from collections.abc import Iterator
from functools import cache, partial

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.bench import vdm
from torchmeso.bench.gdm_error import near_row
from torchmeso.bench.gdm_speed import LIGHT, drawn, scene_of, table, view
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import time_together
from torchmeso.bench.vdm import Vdm, VdmOptions
from torchmeso.bench.vdm_frame import VdmFrames
from torchmeso.geometry import shapes
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.mesh import Mesh, dress
from torchmeso.geometry.rays import RayScene
from torchmeso.meso import generators
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.meso.displace import displace
from torchmeso.render.scene import Material

PAPER = {"undulating": (179.5, 123.2), "vase": (110.4, 69.6)}
"""Frames per second of VDM and GDM in wang2004gdm, section 5."""

EYES = {"undulating": (0.0, 1.5, 2.4), "vase": (0.0, 1.3, 3.3)}


def undulating(triangles: int = 2592) -> Mesh:
    """Return an open sheet in waves, three along x and two along z."""
    sheet = shapes.plane(triangles=triangles, tiles=(4, 4))
    vertices = sheet.vertices.clone()
    x, _, z = vertices.unbind(1)
    vertices[:, 1] = 0.12 * (1.5 * math.pi * x).sin() * (math.pi * z).cos()
    return dress(vertices, sheet.faces, sheet.uv)


def vase(triangles: int = 8640) -> Mesh:
    """Return a closed body of revolution with a neck, as many triangles as the paper's vase."""
    ball = shapes.sphere(triangles=triangles, tiles=(6, 4))
    x, y, z = ball.vertices.unbind(1)
    width = 0.75 - 0.42 * (-((y - 0.5) / 0.22).square()).exp()
    return dress(torch.stack([width * x, y, width * z], 1), ball.faces, ball.uv)


MESHES = {"undulating": undulating, "vase": vase}


@cache
def weave_vdm() -> Vdm:
    """Return the VDM of the weave."""
    return vdm.bake(generators.weave(backing=True), VdmOptions())


def beside(context: Context) -> Iterator[Row]:
    """The paper's two cases: frames of both beside rays, and beside each other in time."""
    gdm, bent = table("weave", GdmOptions(texels=64, layers=32), context, backing=True), weave_vdm()
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        for name, make in MESHES.items():
            mesh, camera = make(), view(EYES[name])
            ours = drawn(scene_of(mesh, Material(gdm=gdm)), shadows=False)
            theirs = VdmFrames(mesh, bent, gdm, camera, LIGHT)
            theirs.draw(camera)
            found = {"gdm": ours.render(camera).depth.double().clone(), "vdm": theirs.seen.t.double()}
            yield from judge(name, mesh, camera, found, gdm.voxel)
            timing = time_together(
                {"ours": partial(ours.show, camera), "theirs": partial(theirs.draw, camera)},
                n=9 if context.quick else 25, warm=3, settle=2,
            )  # fmt: skip
            a, b = timing["ours"], timing["theirs"]
            paper = PAPER[name]
            yield Row(
                id=f"vdm.{name}.faster", unit="x", better="lower", n=a.n,
                what=f"{name}, {len(mesh.faces)} triangles, no shadows: VDM frames, times as fast as ours",
                value=round(a.wall / b.wall, 2),
                peer=f"VDM {b.wall:.1f} ms, GDM {a.wall:.1f} ms; in the paper {paper[0] / paper[1]:.2f} times",
            )  # fmt: skip
    finally:
        torch.set_num_threads(threads)
    tables = {"vdm": bent.way.numel() * 2 + bent.left.numel() / 8, "gdm": gdm.distance.numel() + gdm.left.numel() / 8}
    yield Row(
        id="vdm.memory", what="the VDM's ways and bits over the GDM's", unit="x", better="higher",
        value=round(tables["vdm"] / tables["gdm"], 2),
        peer=f"VDM {tables['vdm'] / 1e6:.1f} MB, GDM {tables['gdm'] / 1e6:.1f} MB",
    )  # fmt: skip


def judge(name: str, mesh: Mesh, camera: Camera, found: dict[str, Float[Tensor, "H W"]], voxel: float) -> Iterator[Row]:
    """Yield how far pictures of depths are from rays at the same weave as triangles."""
    truth = true_depth(mesh, camera)
    right = truth.isfinite()
    scale = float(mesh.scale.mean())
    for kind, t in found.items():
        mask = t.isfinite()
        of = f"{name}, {kind.upper()} 64x64"
        yield near_row(f"vdm.{name}.{kind}", of, mask, right)
        off = (t - truth)[mask & right].abs() / (scale * voxel)
        for share, word in ((0.5, "median"), (0.95, "p95")):
            yield Row(
                id=f"vdm.{name}.{kind}.{word}", what=f"{of}: {word} error of where rays end", unit="voxels",
                value=round(float(off.quantile(share)), 3), better="lower", n=len(off),
            )  # fmt: skip


def true_depth(mesh: Mesh, camera: Camera) -> Float[Tensor, "H W"]:
    """Return how far the weave is that lies over the mesh as triangles; inf where it is not."""
    twin = displace(mesh, generators.weave(backing=True), max_edge=0.05)
    origin, direction, _ = camera.rays(camera.pixel_centres().reshape(-1, 2))
    hits = RayScene(twin.vertices, twin.faces).first_hit(origin.float(), direction.float())
    return hits.t.double().reshape(camera.height, camera.width)
