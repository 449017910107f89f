"""Rows of the suite `gdm` on stored forms: error against size, direct, factored and coded, beside one another.

Test: tests/bench/test_gdm_tables.py
"""

import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import torch

from torchmeso import quality
from torchmeso.bench.gdm_error import against_rays
from torchmeso.bench.gdm_speed import SIZE, camera_entries, table, view
from torchmeso.bench.suite import Context, Row
from torchmeso.compress import gdm_svd as fits
from torchmeso.data import gdm_coded, gdm_svd
from torchmeso.data.gdm import Gdm
from torchmeso.geometry import shapes
from torchmeso.geometry.rays import RayScene
from torchmeso.meso import generators
from torchmeso.meso.bake_gdm import GdmOptions, RayCastGdm
from torchmeso.meso.displace import displace
from torchmeso.render import device_gdm
from torchmeso.render.device_trace import DeviceTrace

RANKS = (2, 4, 8, 16, 32)
"""4, 16 and 32 take what the paper's tables take, 0.5, 2 and 4 MB, at 64 x 64 texels and 32 azimuths."""

ALLOWED = (0.25, 0.5)
"""Voxels that rounded codes may be off by."""


class Form(NamedTuple):
    """A table as it is kept.

    Attributes:
        name: part of a row's id.
        what: in words.
        series: of the plot.
        gdm: what pictures are made from.
        held: bytes of the distances and bits in memory, where they are asked as they are.
        stored: bytes of its file, material included; None where it has none.
    """

    name: str
    what: str
    series: str
    gdm: Gdm
    held: int
    stored: int | None


def tables(context: Context) -> Iterator[Row]:
    """Weave of 64 x 64 x 32 voxels and 16 x 32 directions: what each form costs, and how far it is from cast rays."""
    meso = generators.weave(backing=True)
    direct = table("weave", GdmOptions(texels=64, layers=32), context, backing=True)
    half = table("weave", GdmOptions(texels=64, layers=32, storage="float16"), context, backing=True)
    mesh, camera = shapes.torus(triangles=12000, tiles=(5, 2)), view()
    twin = displace(mesh, meso, max_edge=0.05)
    beside = len(twin.faces) * (36 + 12 + 64)  # vertices and faces as they are; Embree's tree takes no less than 64
    built, entries, pixel = camera_entries(mesh, direct.h, camera)
    truth = RayScene(twin.vertices, twin.faces).first_hit(entries.origin.float(), entries.direction.float()).face >= 0
    right = torch.zeros(SIZE * SIZE, dtype=torch.bool)
    right[pixel[truth]] = True
    rays = RayCastGdm(meso, direct.cap)
    ranks, allowed = (RANKS[1:4], ALLOWED[:1]) if context.quick else (RANKS, ALLOWED)
    for form in forms(direct, half, ranks, allowed, context.report):
        found = against_rays(form.gdm, rays, 60_000)
        mask = torch.zeros(SIZE * SIZE, dtype=torch.bool)
        traced = DeviceTrace(built, mesh, form.gdm, bend=device_gdm.BEND * form.gdm.voxel).trace(entries)
        mask[pixel[traced.hit]] = True
        off = quality.boundary_distance(mask.reshape(SIZE, SIZE), right.reshape(SIZE, SIZE))
        curve = {"series": form.series, "x": (form.stored or form.held) / 1e6}
        yield Row(
            id=f"tables.wrong.{form.name}", what=f"{form.what}: rays that wrongly hit or leave", unit="%",
            value=round(100 * float((~found.agree).double().mean()), 3), better="lower", n=len(found.agree),
            curve={**curve, "y": "wrong"},
        )  # fmt: skip
        for share, word in ((0.5, "median"), (0.95, "p95")):
            yield Row(
                id=f"tables.{word}.{form.name}", unit="voxels",
                what=f"{form.what}, one look-up of any way: {word} error of hits",
                value=round(float(found.off.quantile(share)), 3), better="lower", n=len(found.off),
                curve={**curve, "y": word},
            )  # fmt: skip
        yield Row(
            id=f"tables.outline.{form.name}",
            what=f"{form.what}, 12,000 prisms: mean distance of the outline from the true one",
            value=round(float(off), 3), unit="px", better="lower", curve={**curve, "y": "outline"},
        )  # fmt: skip
        yield Row(
            id=f"tables.memory.{form.name}", unit="x", better="higher",
            what=f"{form.what}: mesh and tree of the twin over distances and bits in memory",
            value=round(beside / form.held, 2), goal=50 if form.series.count("SVD") else None,
            peer=f"{form.held / 1e6:.2f} MB, twin at least {beside / 1e6:.0f} MB",
        )  # fmt: skip
        if form.stored is not None:
            yield Row(
                id=f"tables.file.{form.name}", what=f"{form.what}: its file, material and bits included", unit="MB",
                value=round(form.stored / 1e6, 3), better="lower",
                peer=f"mesh and tree of the twin take {beside / form.stored:.0f} times as much",
            )  # fmt: skip


def forms(
    direct: Gdm,
    half: Gdm,
    ranks: tuple[int, ...],
    allowed: tuple[float, ...],
    report: Callable[[str, float], None],
) -> Iterator[Form]:
    """Yield one table in all its forms."""
    bits = direct.left.numel() // 8
    yield Form("uint8", "direct bytes", "direct", direct, direct.distance.numel() + bits, None)
    yield Form("half", "direct halves", "direct", half, 2 * half.distance.numel() + bits, None)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.gdm.meso"
        for within in (0.0, *allowed):
            gdm_coded.save(direct, path, within=within)
            opened = gdm_coded.load(path)
            word = f"coded within {within:g} voxels" if within else "coded exactly"
            held = opened.distance.numel() + bits
            yield Form(f"coded.{within:g}", word, "coded", opened, held, path.stat().st_size)
        fills: tuple[tuple[fits.Fill, str], ...] = (("boundary", "the paper's SVD"), ("hits", "SVD of hits alone"))
        for k, (rank, (fill, word)) in enumerate((r, f) for r in ranks for f in fills):
            report(f"GDM: rank {rank}, {fill}", k / (2 * len(ranks)))
            factored = fits.fit(direct, fits.GdmSvdOptions(rank=rank, fill=fill))
            gdm_svd.save(factored, path)
            held = factored.held_bytes + factored.left.numel()
            yield Form(
                f"svd.{fill}.{rank}", f"{word}, rank {rank} ({factored.held_bytes / 1e6:.2f} MB of factors)", word,
                factored.expanded(), held, path.stat().st_size,
            )  # fmt: skip
