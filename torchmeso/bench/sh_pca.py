"""Rows of the suite `compress` on SH + PCA (kawasaki2005quilting, section 2): its choices against ours, its frames.

All on a brick baked from geometry. "Between the lights" is a second bake at lights that lie in the middle of the
cells of the first one's, so that overshoot is seen where no sample holds it.

Test: tests/bench/test_sh_pca.py
"""

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.bench import frames, speed
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import time_together
from torchmeso.compress import double_sh, eigen, sh_pca
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.data import btf
from torchmeso.data.sh_btf import held_basis
from torchmeso.data.sh_pca_btf import ShPcaBtf
from torchmeso.geometry.hemisphere import DirectionSet
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions
from torchmeso.pipeline import bake
from torchmeso.render.scene import Scene

BETWEEN = "rings(7.5: 3 @ 20, 22.5: 8 @ 15, 37.5: 14 @ 7, 52.5: 18 @ 9, 67.5: 20 @ 4)"
"""Lights between those of ubo81."""

TRAINED = (100, 1000)
"""Vectors of the paper's "small number"."""


def rows(context: Context) -> Iterator[Row]:
    """Ways over the light, training, the paper's sizes, frames."""
    options = BtfOptions(texels=32, lights="ubo81", views="ubo81", samples=1, bounces=0)
    table = bake_btf.in_memory(generators.brick(), options)
    T = table.pictures().float()
    between = bake_btf.in_memory(generators.brick(), replace(options, lights=BETWEEN))
    yield from _light(table, T, between)
    yield from _training(table, T, repetitions=3 if context.quick else 10)
    yield from _paper()
    yield from _frames(context)


def shown(model: ShPcaBtf, lights: DirectionSet) -> Float[Tensor, "light view H W 3"]:
    """Return what a model shows of every texel and view, lit from `lights` above its last ring."""
    light = torch.einsum("lm,kmc->lkc", held_basis(model.lights, lights.directions(), model.terms), model.basis)
    return torch.einsum("lkc,vhwk->lvhwc", light, model.decoded())


def psnr(found: Tensor, T: Tensor) -> float:
    """Return the PSNR of all values, the 99.5th percentile of T as peak."""
    peak = float(torch.quantile(T.flatten()[:: max(T.numel() // 1_000_000, 1)], 0.995))
    return 10 * math.log10(peak**2 / float((found - T).square().mean()))


def _light(table: btf.Btf, T: Tensor, between: btf.Btf) -> Iterator[Row]:
    """Least squares, with and without the ridge, and the cube map: at the lights and between them."""
    kinds = {
        "cube_map": ShPcaOptions(domain="sphere_projection"),
        "least_squares": ShPcaOptions(ridge=0),
        "ridge": ShPcaOptions(),
    }
    names = {"cube_map": "the paper's cube map", "least_squares": "plain least squares", "ridge": "with our ridge"}
    for terms in (16, 25, 36):
        for kind, options in kinds.items():
            model = sh_pca.fit(table, replace(options, light_terms=terms))
            yield Row(
                id=f"compress.sh_pca.light.{terms}.{kind}",
                what=f"PSNR between the lights, SH + PCA of 16 components and {terms} coefficients, {names[kind]}",
                value=round(psnr(shown(model, between.lights), between.pictures().float()), 2), unit="dB",
                better="higher", peer=f"at the lights {psnr(shown(model, table.lights), T):.2f} dB",
            )  # fmt: skip


def _training(table: btf.Btf, T: Tensor, *, repetitions: int) -> Iterator[Row]:
    """What components from a sample of the vectors lose beside those from all of them."""
    exact = psnr(shown(sh_pca.fit(table), table.lights), T)
    for n in TRAINED:
        lost = []
        for seed in range(repetitions):
            model = sh_pca.fit(table, ShPcaOptions(training=n), rng=torch.Generator().manual_seed(seed))
            lost.append(exact - psnr(shown(model, table.lights), T))
        lost.sort()
        yield Row(
            id=f"compress.sh_pca.training.{n}",
            what=f"what 16 components found from {n} vectors lose beside those from all "
            f"{T.shape[1] * T.shape[2] * T.shape[3]}, in the middle of {repetitions} draws",
            value=round(lost[repetitions // 2], 3), unit="dB", better="lower",
            spread=(round(lost[0], 3), round(lost[-1], 3)), n=repetitions, peer=f"all of them {exact:.2f} dB",
        )  # fmt: skip


def _paper() -> Iterator[Row]:
    """A texture of the paper's 64 x 64: its way beside ours, and how long ours takes."""
    options = BtfOptions(texels=64, lights="ubo81", views="ubo81", samples=1, bounces=0)
    table = bake_btf.in_memory(generators.brick(), options)
    T = table.pictures().float()
    ways = {
        "paper": ShPcaOptions(domain="sphere_projection", training=1000, light_terms=25),
        "ours": ShPcaOptions(light_terms=25),
    }
    names = {"paper": "cube map, components from 1000 vectors", "ours": "least squares, components from all vectors"}
    for way, chosen in ways.items():
        start, cpu = time.perf_counter(), time.process_time()
        model = sh_pca.fit(table, chosen)
        seconds, used = time.perf_counter() - start, (time.process_time() - cpu) / 2
        size = model.maps.numel() + 4 * (model.basis.numel() + 2 * model.rank)
        yield Row(
            id=f"compress.sh_pca.64.{way}",
            what="PSNR of a brick of 64 x 64 texels, 81 x 81 directions, 16 components of 25 coefficients: "
            f"{names[way]}",
            value=round(psnr(shown(model, table.lights), T), 2), unit="dB", better="higher",
            peer=f"fit {seconds:.2f} s (CPU/cores {used:.2f}), {size / 2**20:.1f} MB, {T.numel() / size:.1f}:1 of "
            "8-bit values",
        )  # fmt: skip


def _frames(context: Context) -> Iterator[Row]:
    """The knot of bricks at half coverage, 800 x 600, dressed with each kind of model of the same table."""
    timed = frames.knot()
    scene = frames.build(timed, context.report)
    table = btf.load(bake.table_paths(timed.config.materials["brick"])[0])
    camera = frames.camera_at(scene, timed, 0.5)
    models = {
        "eigen, rank 4": eigen.fit(table, EigenOptions(rank=4)),
        "double SH, 16 x 16": double_sh.fit(table, DoubleShOptions(light_terms=16, view_terms=16)),
        "4": sh_pca.fit(table, ShPcaOptions(rank=4)),
        "8": sh_pca.fit(table, ShPcaOptions(rank=8)),
        "16": sh_pca.fit(table, ShPcaOptions(rank=16)),
    }
    calls: dict[str, Callable[[], object]] = {
        name: partial(speed.renderer(_dressed(scene, model), "paper", shadows=False).show, camera)
        for name, model in models.items()
    }
    timing = time_together(calls, n=9 if context.quick else 25, warm=3, settle=2)
    others = "; ".join(f"{name} {timing[name].wall:.1f} ms" for name in list(models)[:2])
    for rank in ("4", "8", "16"):
        took = timing[rank]
        yield Row(
            id=f"compress.sh_pca.frame.{rank}",
            what=f"frame of the 12k knot, 800 x 600, 50 % coverage, SH + PCA of {rank} components, 25 coefficients",
            value=round(min(took.wall, took.cpu), 2), unit="ms", better="lower", goal=33.3,
            spread=(round(took.low, 2), round(took.high, 2)), n=took.n,
            peer=f"wall {took.wall:.1f} ms; {others}; the paper's graphics card more than 30 frames/s",
        )  # fmt: skip


def _dressed(scene: Scene, model: object) -> Scene:
    """Return the scene with another BTF on all that has one."""
    objects = tuple(replace(o, material=replace(o.material, btf=model)) for o in scene.objects)
    return replace(scene, objects=objects)
