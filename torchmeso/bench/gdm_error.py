"""Rows of the suite `gdm` on error: tables beside cast rays, and shells beside the same material laid over the mesh.

Test: tests/bench/test_gdm_error.py
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso import quality
from torchmeso.bench.gdm_speed import SIZE, camera_entries, table, view
from torchmeso.bench.suite import Context, Row
from torchmeso.data import gdm_query
from torchmeso.data.gdm import Gdm
from torchmeso.geometry import shapes
from torchmeso.geometry.directions import normalize
from torchmeso.geometry.rays import RayScene
from torchmeso.meso import generators
from torchmeso.meso.bake_gdm import GdmOptions, RayCastGdm
from torchmeso.meso.displace import displace
from torchmeso.render import device_gdm
from torchmeso.render.device_trace import DeviceTrace

NEAR = 8
"""Pixels around the true outline in which hits and misses are counted."""


class Error(NamedTuple):
    """Distances beside the truth.

    Attributes:
        agree: (n,) whether a table says hit or miss as a ray does.
        off: (m,) how far hits are from where they should be, in voxels.
    """

    agree: Bool[Tensor, "n"]
    off: Float[Tensor, "m"]


def distance(context: Context) -> Iterator[Row]:
    """Weave: tables beside rays cast from random points outside of material in random directions, without a shell."""
    meso = generators.weave(backing=True)
    sizes = ((64, 16), (32, 16)) if context.quick else ((64, 16), (32, 16), (16, 16), (64, 8), (32, 32))
    for texels, n_theta in sizes:
        options = GdmOptions(texels=texels, layers=texels // 2, n_theta=n_theta, n_phi=2 * n_theta)
        gdm = table("weave", options, context, backing=True)
        found = against_rays(gdm, RayCastGdm(meso, gdm.cap), 60_000)
        name, size = f"distance.{texels}.{n_theta}", f"{texels}x{texels}x{texels // 2}x{n_theta}x{2 * n_theta}"
        curve = {"series": f"{n_theta} x {2 * n_theta} directions", "x": texels}
        yield Row(
            id=f"{name}.agree", what=f"weave {size}, one look-up: hit or miss as by a ray, any way", unit="%",
            value=round(100 * float(found.agree.double().mean()), 2), better="higher", n=len(found.agree),
        )  # fmt: skip
        for share, word in ((0.5, "median"), (0.95, "p95")):
            yield Row(
                id=f"{name}.{word}", what=f"weave {size}, one look-up of any way: {word} error of hits", unit="voxels",
                value=round(float(found.off.quantile(share)), 3), better="lower", n=len(found.off),
                curve={**curve, "y": word},
            )  # fmt: skip


def refined(context: Context) -> Iterator[Row]:
    """Weave: rays asked again on the safe way, without a shell."""
    gdm = table("weave", GdmOptions(texels=64, layers=32), context, backing=True)
    rays = RayCastGdm(generators.weave(backing=True), gdm.cap)
    for queries in (1, 32) if context.quick else (1, 2, 4, 8, 16, 32):
        found = against_rays(gdm, rays, 30_000, queries=queries)
        for share, word, goal in ((0.5, "median", 0.5), (0.95, "p95", {1: 2.0, 32: 0.5}.get(queries))):
            yield Row(
                id=f"refined.{word}.{queries}", unit="voxels", better="lower", n=len(found.off), goal=goal,
                what=f"weave 64x64x32x16x32, at most {queries} look-ups of any way: {word} error of hits",
                value=round(float(found.off.quantile(share)), 3),
                curve={"series": "look-ups", "x": queries, "y": word},
            )  # fmt: skip


def against_rays(gdm: Gdm, rays: RayCastGdm, n: int, *, queries: int = 1) -> Error:
    """Return the errors of a table at `n` points, a third of them at the top of the slab."""
    rng = torch.Generator().manual_seed(5)
    place = torch.rand(n, 3, generator=rng)
    place[:, 2] *= -gdm.h
    place[: n // 3, 2] = 0
    place = place[~rays.inside(place)]
    w = normalize(torch.randn(len(place), 3, generator=rng))
    w[:, 2] = torch.where(place[:, 2] == 0, -w[:, 2].abs(), w[:, 2])
    t, _ = rays.cast(place, w, torch.zeros(len(place), dtype=torch.bool))
    left = t > gdm.boundary(place, w) + 1e-4
    found = gdm_query.approach(gdm, place.double(), w.double(), queries=queries)
    both = ~left & ~found.left
    return Error(found.left == left, (found.distance - t.double()).abs()[both] / gdm.voxel)


def silhouette(context: Context) -> Iterator[Row]:
    """A weave in a shell beside the same weave as triangles: outline and depth, over voxels and look-ups per prism.

    Rays walk as those of frames do.
    """
    mesh, camera = shapes.torus(triangles=12000, tiles=(5, 2)), view()
    twin = displace(mesh, generators.weave(backing=True), max_edge=0.05)
    scene = RayScene(twin.vertices, twin.faces)
    scale = float(mesh.scale.mean())
    for texels in (64,) if context.quick else (64, 32, 16):
        gdm = table("weave", GdmOptions(texels=texels, layers=texels // 2), context, backing=True)
        built, entries, pixel = camera_entries(mesh, gdm.h, camera)
        hits = scene.first_hit(entries.origin.float(), entries.direction.float())
        right = torch.zeros(SIZE * SIZE, dtype=torch.bool)
        right[pixel[hits.face >= 0]] = True
        right = right.reshape(SIZE, SIZE)
        for queries in (1,) if context.quick else (1, 2, 4, 8):
            device = DeviceTrace(built, mesh, gdm, queries=queries, bend=device_gdm.BEND * gdm.voxel)
            found = device.trace(entries)
            mask = torch.zeros(SIZE * SIZE, dtype=torch.bool)
            mask[pixel[found.hit]] = True
            mask = mask.reshape(SIZE, SIZE)
            name = f"silhouette.{texels}.{queries}"
            of = f"weave {texels}x{texels}x{texels // 2}, 12,000 prisms, {queries} look-ups per prism"
            row = near_row(name, of, mask, right)
            goal = 97 if (texels, queries) == (64, 1) else None
            yield replace(row, goal=goal, peer=f"{row.peer}, {device.milliseconds:.1f} ms")
            pixels = quality.boundary_distance(mask, right)
            size = (
                float((entries.origin - camera.eye).norm(dim=1).median()) * camera.pixel_size
            )  # of a pixel where material is met
            yield Row(
                id=f"{name}.outline", what=f"{of}: mean distance of the outline from the true one", unit="voxels",
                value=round(pixels * size / (scale * gdm.voxel), 3), better="lower",
                goal=0.5 if (texels, queries) == (64, 1) else None, peer=f"{pixels:.2f} px",
            )  # fmt: skip
            both = found.hit & (hits.face >= 0)
            off = ((found.t - hits.t.double()).abs() / (scale * gdm.voxel))[both]
            for part, word, goal in ((0.5, "median", 0.5), (0.95, "p95", 2.0)):
                yield Row(
                    id=f"{name}.{word}", what=f"{of}: {word} error of where rays end", unit="voxels", better="lower",
                    value=round(float(off.quantile(part)), 3), n=len(off),
                    goal=goal if (texels, queries) == (64, 1) else None,
                    curve={"series": f"{texels} voxels", "x": queries, "y": word},
                )  # fmt: skip


def near_row(name: str, of: str, mask: Bool[Tensor, "H W"], right: Bool[Tensor, "H W"]) -> Row:
    """Return the row of how many pixels are right within `NEAR` of the true outline."""
    close = near_outline(right)
    return Row(
        id=f"{name}.near", what=f"{of}: hit or miss as in the truth within {NEAR} px of the true outline",
        value=round(100 * float((mask == right)[close].double().mean()), 2), unit="%", better="higher",
        n=int(close.sum()), peer=f"IoU {quality.iou(mask, right):.4f}",
    )  # fmt: skip


def near_outline(mask: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    """Return the pixels within `NEAR` of where a mask changes."""
    side = 2 * NEAR + 1
    whole = mask[None, None].float()
    most = torch.nn.functional.max_pool2d(whole, side, 1, NEAR)
    least = -torch.nn.functional.max_pool2d(-whole, side, 1, NEAR)
    return (most != least)[0, 0]
