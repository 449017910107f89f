"""Rows of the suite `gdm` on what GDM and MDF say of the same material: their tables, and silhouettes made of each.

A GDM at the top of the slab is an MDF: D(u, v, wo) = d(u, v, 0, -wo) where there is a hit, and `left` where there is
none. A mesh in an inward shell is the mesh that an MDF carves, and their outlines are two estimates of one.

Test: tests/bench/test_gdm_identity.py
"""

from collections.abc import Iterator
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso import quality
from torchmeso.bench.frames import SMALL
from torchmeso.bench.gdm_error import near_row
from torchmeso.bench.gdm_speed import drawn, scene_of, table, view
from torchmeso.bench.speed import MAP
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import time_together
from torchmeso.config_sections import MaterialConfig
from torchmeso.data.gdm import Gdm
from torchmeso.data.mdf import Mdf
from torchmeso.geometry import shapes
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.directions import normalize
from torchmeso.geometry.mesh import Mesh
from torchmeso.geometry.rays import RayScene
from torchmeso.meso import bake_mdf, generators
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.meso.bake_mdf import MdfOptions
from torchmeso.meso.displace import displace
from torchmeso.pipeline import bake
from torchmeso.render.frame import FrameOptions, Skips
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Material, ShellOptions
from torchmeso.render.silhouette import Silhouette

SILHOUETTES: tuple[Silhouette, ...] = ("paper", "curved")

MESOS = ("weave", "chain", "squama", "pipes")


class Agreement(NamedTuple):
    """Two tables of one material.

    Attributes:
        agree: (n,) whether both say hit or both say none.
        off: (m,) difference of distances where both say hit, tile units.
    """

    agree: Bool[Tensor, "n"]
    off: Float[Tensor, "m"]


def views_of(gdm: Gdm) -> str:
    """Return the direction set of the GDM's downward rays, seen from their ends."""
    rings = gdm.directions.n_theta // 2
    last = 180 * (rings - 0.5) / gdm.directions.n_theta
    return f"grid({gdm.directions.n_phi}, {rings}, {last:g})"


def at_nodes(gdm: Gdm, mdf: Mdf) -> Agreement:
    """Return how the tables agree at the samples that both have; the MDF's views are `views_of` the GDM."""
    count, (height, width) = len(mdf.directions), gdm.voxels[1:]
    if mdf.texels != (height, width) or count != gdm.directions.n_phi * (gdm.directions.n_theta // 2):
        raise ValueError("expected an MDF at the texels and downward directions of the GDM")
    wo = mdf.directions.directions(torch.float64)
    u = ((torch.arange(width, dtype=torch.float64) + 0.5) / width).expand(height, width)
    v = 1 - ((torch.arange(height, dtype=torch.float64) + 0.5) / height)[:, None].expand(height, width)
    uv = torch.stack([u, v], -1).reshape(-1, 2)
    pairs = uv.repeat(count, 1), wo.repeat_interleave(len(uv), 0)
    return compare(gdm, mdf, *pairs)


def compare(gdm: Gdm, mdf: Mdf, uv: Float[Tensor, "n 2"], wo: Float[Tensor, "n 3"]) -> Agreement:
    """Return how the tables agree; ways beyond the longest of the GDM are none of its questions."""
    D = mdf.evaluate(uv, wo)
    asked = ~(D.isfinite() & (gdm.cap < D))
    uv, wo, D = uv[asked], wo[asked], D[asked]
    found = gdm.evaluate(torch.cat([uv, torch.zeros_like(uv[:, :1])], 1), -wo)
    both = D.isfinite() & ~found.left
    return Agreement(D.isfinite() != found.left, (D - found.distance)[both].abs())


def identity(context: Context) -> Iterator[Row]:
    """Tables of the same material: at the samples that both have, and between them."""
    rng = torch.Generator().manual_seed(3)
    for name in MESOS[:1] if context.quick else MESOS:
        gdm = table(name, GdmOptions(texels=64, layers=32), context)
        options = MdfOptions(texels=64, views=views_of(gdm))
        context.report(f"{name}: MDF", 0)
        mdf = bake_mdf.in_memory(generators.GENERATORS[name](), options)
        uv = torch.rand(100_000, 2, generator=rng, dtype=torch.float64)
        wo = normalize(torch.randn(100_000, 3, generator=rng, dtype=torch.float64))
        wo[:, 2] = wo[:, 2].abs().clamp(min=0.1)
        cases = {"nodes": at_nodes(gdm, mdf), "between": compare(gdm, mdf, uv, normalize(wo))}
        for where, found in cases.items():
            of = f"{name} 64x64, MDF and top of the GDM, {'common samples' if where == 'nodes' else 'any question'}"
            step = gdm.cap / 255
            yield Row(
                id=f"identity.{name}.{where}.agree", what=f"{of}: hit or none, both alike", unit="%", better="higher",
                value=round(100 * float(found.agree.double().mean()), 3), n=len(found.agree),
                goal=99.9 if where == "nodes" else None,
            )  # fmt: skip
            yield Row(
                id=f"identity.{name}.{where}.p95", what=f"{of}: difference of distances at 95 %", unit="voxels",
                value=round(float(found.off.quantile(0.95)) / gdm.voxel, 3), better="lower", n=len(found.off),
                goal=round(1.5 * step / gdm.voxel, 3) if where == "nodes" else None,
                peer=f"median {float(found.off.median()) / gdm.voxel:.3f}; a code of the GDM is {step / gdm.voxel:.3f}",
            )  # fmt: skip


def outlines(context: Context) -> Iterator[Row]:
    """The outline of a mesh in a weave, by a shell and by an MDF, beside the same weave laid over it as triangles."""
    mesh, camera = shapes.torus(triangles=12000, tiles=(5, 2)), view()
    gdm = table("weave", GdmOptions(texels=64, layers=32), context, backing=True)
    context.report("weave: MDF", 0)
    depth = bake_mdf.in_memory(generators.weave(backing=True), MdfOptions(texels=64))
    right = true_mask(mesh, camera)
    for name, mask in masks(mesh, camera, gdm, depth).items():
        of = f"weave on a torus of 12,000 triangles, {name.replace('_', ' ')}"
        yield near_row(f"outline.{name}", of, mask, right)
        yield Row(
            id=f"outline.{name}.distance", what=f"{of}: mean distance of the outline from the true one", unit="px",
            value=round(quality.boundary_distance(mask, right), 3), better="lower",
        )  # fmt: skip


def pace(context: Context) -> Iterator[Row]:
    """Frames of the same weave in a shell, and as BTF and MDF: without and with shadows, the same mesh and view."""
    mesh, camera = shapes.torus(triangles=12000, tiles=(5, 2)), view()
    gdm = table("weave", GdmOptions(texels=64, layers=32), context, backing=True)
    wanted = MaterialConfig.model_validate({"meso": {"type": "weave", "backing": True}, **SMALL})
    flat = bake.prepare_material("weave", wanted, context.report).material
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        calls = {}
        for shadows in (False, True):
            calls[f"gdm.{shadows}"] = drawn(scene_of(mesh, Material(gdm=gdm)), shadows=shadows)
            for name in SILHOUETTES:
                options = FrameOptions(
                    silhouette=name, shadows=shadows, shadow_map_size=MAP, skips=Skips(resting=False)
                )  # fmt: skip
                calls[f"{name}.{shadows}"] = Renderer(scene_of(mesh, flat), options)
        timing = time_together(
            {name: partial(r.show, camera) for name, r in calls.items()}, n=9 if context.quick else 25, warm=3,
            settle=2,
        )  # fmt: skip
    finally:
        torch.set_num_threads(threads)
    for name in SILHOUETTES:
        for shadows, word in ((False, "without shadows"), (True, "with shadows")):
            ours, theirs = timing[f"gdm.{shadows}"], timing[f"{name}.{shadows}"]
            yield Row(
                id=f"pace.{name}{'.shadow' * shadows}", unit="x", better="lower", n=ours.n,
                what=f"weave on 12,000 triangles, {word}: BTF and MDF with the {name} test, times as fast as the GDM",
                value=round(ours.wall / theirs.wall, 2),
                peer=f"BTF and MDF {theirs.wall:.1f} ms, GDM {ours.wall:.1f} ms",
            )  # fmt: skip


def masks(mesh: Mesh, camera: Camera, gdm: Gdm, depth: Mdf) -> dict[str, Bool[Tensor, "H W"]]:
    """Return where a mesh in one material is seen: in a shell, and carved by the MDF's two tests."""
    found = {}
    for queries in (1, 4):
        scene = scene_of(mesh, Material(gdm=gdm, shell=ShellOptions(queries=queries)))
        found[f"gdm_{queries}"] = Renderer(scene, FrameOptions(shadows=False)).render(camera).owner.clone() >= 0
    carved = scene_of(mesh, Material(mdf=depth))
    for name in ("curved", "paper"):
        options = FrameOptions(shadows=False, silhouette=name)
        found[f"mdf_{name}"] = Renderer(carved, options).render(camera).owner.clone() >= 0
    return found


def true_mask(mesh: Mesh, camera: Camera) -> Bool[Tensor, "H W"]:
    """Return where the weave is seen that lies over the mesh as triangles."""
    twin = displace(mesh, generators.weave(backing=True), max_edge=0.05)
    origin, direction, _ = camera.rays(camera.pixel_centres().reshape(-1, 2))
    hits = RayScene(twin.vertices, twin.faces).first_hit(origin.float(), direction.float())
    return (hits.face >= 0).reshape(camera.height, camera.width)
