"""Error over size at 10:1, 50:1 and 200:1 of eight-bit pictures, on baked materials, for every representation.

Sizes are those of the files: eight bits of double SH and eigen maps, halves of the factors of one decomposition per
channel (what Bonn's `.btf` files hold), streams and bases of the transform code and of adaptive steps. PSNR is that of
all values, linear, the 99.5th percentile as peak; FLIP the mean of pictures spread over lights and views.

Test: tests/bench/test_rate.py
"""

import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso import quality
from torchmeso.algebra.spherical_harmonics import basis, degree_of
from torchmeso.bench import frames
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import time_together
from torchmeso.compress import budget, dfmf, double_sh, double_sh_budget, eigen, eigen_budget, factored, transform
from torchmeso.compress.budget import Budget
from torchmeso.compress.dfmf import DfmfOptions
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.factored import FactoredOptions
from torchmeso.compress.transform import TransformOptions
from torchmeso.data import btfdbb_colour, eigen_btf, sh_btf
from torchmeso.data.btf import Btf
from torchmeso.data.btfdbb_colour import Colour
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.sh_btf import ShBtf
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions
from torchmeso.render.renderer import Renderer

RATIOS = (10, 50, 200)
TERMS = {10: (25, 25), 50: (16, 9), 200: (9, 4)}
"""Double SH of light and view nearest to each ratio: 6561 / 625 = 10.5, 6561 / 144 = 45.6, 6561 / 36 = 182."""

MATERIALS = ("brick", "weave", "squama")


def budgets(context: Context) -> Iterator[Row]:
    """Each representation at each size, on one material (quick) or all."""
    for name in MATERIALS[:1] if context.quick else MATERIALS:
        yield from _at_all_sizes(name, *_baked(name))


def _at_all_sizes(name: str, table: Btf, T: Tensor) -> Iterator[Row]:
    for ratio in RATIOS:
        room = T.numel() // ratio
        found: dict[str, float] = {}
        for method, shown, size in _models(table, T, room, ratio):
            found[method] = budget.psnr_of(T, shown)
            goal, why = None, ""
            if method == "transform" and ratio == 10:
                goal, why = found["double-sh"] + 3, "; goal: double SH + 3 dB"
            if method == "transform" and ratio == 200:
                goal, why = max(found["svd"], found["dfmf"]) + 1, "; goal: one decomposition per channel + 1 dB"
            yield Row(
                id=f"compress.budget.{name}.{ratio}.{method}",
                what=f"PSNR of all values of a baked {name}, 32 x 32 texels, 81 x 81 directions, "
                f"{method} near {ratio}:1",
                value=round(found[method], 2), unit="dB", better="higher",
                goal=None if goal is None else round(goal, 2),
                peer=f"{T.numel() / size:.1f}:1; {_flip(T, shown)}{why}",
                curve={"series": f"{name} {method}", "x": size / T.numel()},
            )  # fmt: skip


def _models(
    table: Btf, T: Tensor, room: int, ratio: int
) -> Iterator[tuple[str, Float[Tensor, "light view H W 3"], int]]:
    """Yield (method, what it shows, bytes of its file); the one whose goal needs the others comes last."""
    height, width = table.texels
    n_light, n_view = len(table.lights), len(table.views)
    light_terms, view_terms = TERMS[ratio]
    tries = []
    for energy in (1.0, 10.0):
        model = double_sh.fit(
            table, DoubleShOptions(light_terms=light_terms, view_terms=view_terms, energy=energy), backend="auto"
        )
        tries.append(_shown_harmonics(model))
    yield (
        "double-sh",
        max(tries, key=lambda shown: budget.psnr_of(T, shown)),
        light_terms * view_terms * height * width * 3,
    )
    rank = max(1, min(n_view, room // (n_light * height * width * 3)))
    model = eigen.fit(table, EigenOptions(rank=rank))
    yield "eigen", _shown_eigen(model), model.maps.numel() + 4 * model.weights.numel()
    per_component = 2 * 3 * (n_light * n_view + height * width)
    rank = max(1, min(height * width, room // per_component))
    for method, colour in (("svd", Colour(0)), ("dfmf", Colour(11))):
        positive = Btf(images=T.clamp(min=0), lights=table.lights, views=table.views)
        factors = dfmf.fit(positive, DfmfOptions(rank=rank, colour=colour))
        x = torch.stack([U @ V.mT for U, V in factors], -1).unflatten(1, (height, width)).flip(1)
        shown = btfdbb_colour.to_rgb(colour, x).unflatten(0, (n_view, n_light)).transpose(0, 1)
        yield method, shown.float(), rank * per_component
    coded, _ = eigen_budget.fit(table, Budget(size=room), storage="adaptive")
    yield "eigen-adaptive", _shown_eigen(coded), eigen_budget.file_size(coded)
    most = DoubleShOptions(light_terms=36, view_terms=36, energy=10.0, storage="adaptive")
    harmonic, _ = double_sh_budget.fit(table, Budget(size=room), most, backend="auto")
    yield "double-sh-adaptive", _shown_harmonics(harmonic), double_sh_budget.file_size(harmonic, coded=True)
    packed, _ = transform.fit(table, Budget(size=room))
    yield "transform", _shown_eigen(packed.expanded()), transform.size(packed)


def adaptive(context: Context) -> Iterator[Row]:
    """Files of adaptive steps beside those of eight bits for all, at the same error: written, opened and held."""
    jobs: dict[str, EigenOptions | DoubleShOptions] = {
        "eigen.4": EigenOptions(rank=4),
        "eigen.16": EigenOptions(rank=16),
        "double-sh.81": DoubleShOptions(light_terms=9, view_terms=9),
        "double-sh.625": DoubleShOptions(),
    }
    for name in MATERIALS[:1] if context.quick else MATERIALS:
        table, T = _baked(name)
        for method, options in jobs.items():
            eight, eight_db = _written(table, T, options, coded=False)
            coded, _ = _written(table, T, options, coded=True)
            ours, ours_db = _written(table, T, replace(options, storage="adaptive"), coded=True)
            yield Row(
                id=f"compress.adaptive.{name}.{method}",
                what=f"bytes of a file of eight bits over those of adaptive steps, baked {name}, {method}",
                value=round(eight / ours, 2), unit="x", better="higher", goal=2.0,
                peer=f"{eight_db:.2f} dB and {ours_db:.2f} dB; {coded / ours:.2f} x where both are entropy-coded",
            )  # fmt: skip


def factorised(context: Context) -> Iterator[Row]:
    """One factorisation per channel as a run-time model: the eigen BTF it opens as, beside one of as many bytes."""
    for name in MATERIALS[:1] if context.quick else MATERIALS:
        table, T = _baked(name)
        table, T = Btf(images=T.clamp(min=0), lights=table.lights, views=table.views), T.clamp(min=0)
        for rank in (4, 16):
            for colour in ("rgb", "log-y"):
                model = factored.fit(table, FactoredOptions(rank=rank, colour=colour))
                start = time.perf_counter()
                opened = factored.opened(model)
                seconds = time.perf_counter() - start
                size = 2 * (model.by_pair.numel() + model.by_texel.numel())
                plain = eigen.fit(table, EigenOptions(rank=max(1, size // T[:, 0].numel())))
                decoded = budget.psnr_of(T, model.rows(0, table.texels[0]))
                yield Row(
                    id=f"compress.factored.{name}.{rank}.{colour}",
                    what=f"PSNR of the eigen BTF that {rank} components of each channel ({colour}) open as, "
                    f"baked {name}, 32 x 32 texels, 81 x 81 directions",
                    value=round(budget.psnr_of(T, _shown_eigen(opened)), 2), unit="dB", better="higher",
                    peer=f"{T.numel() / size:.0f}:1; {decoded:.2f} dB before it is opened; opens in {seconds:.1f} s to "
                    f"{opened.rank} components, {opened.maps.nbytes / 1e6:.1f} MB; eigen BTF of {plain.rank}, "
                    f"{T.numel() / plain.maps.numel():.0f}:1: {budget.psnr_of(T, _shown_eigen(plain)):.2f} dB",
                )  # fmt: skip


def _baked(name: str) -> tuple[Btf, Tensor]:
    options = BtfOptions(texels=32, lights="ubo81", views="ubo81", samples=1, bounces=0)
    table = bake_btf.in_memory(getattr(generators, name)(), options)
    T = table.pictures().float()
    return Btf(images=T, lights=table.lights, views=table.views), T


def _written(table: Btf, T: Tensor, options: EigenOptions | DoubleShOptions, *, coded: bool) -> tuple[int, float]:
    """Return the bytes of the file of a fit, and the PSNR of what is read from it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.meso"
        if isinstance(options, EigenOptions):
            eigen_btf.save(eigen.fit(table, options), path, coded=coded)
            shown = _shown_eigen(eigen_btf.load(path))
        else:
            sh_btf.save(double_sh.fit(table, options, backend="auto"), path, coded=coded)
            shown = _shown_harmonics(sh_btf.load(path))
        return path.stat().st_size, budget.psnr_of(T, shown)


def _shown_eigen(model: EigenBtf) -> Float[Tensor, "light view H W 3"]:
    return torch.einsum("lhwkc,vk->lvhwc", model.decoded(), model.weights)


def _shown_harmonics(model: ShBtf) -> Float[Tensor, "light view H W 3"]:
    y = [
        basis(side.directions(), degree_of(n)).float()
        for side, n in zip((model.lights, model.views), model.terms, strict=True)
    ]
    return torch.einsum("li,vj,ijhwc->lvhwc", *y, model.decoded())


def decoding(context: Context) -> Iterator[Row]:
    """What each representation costs in a frame: the 12k knot of bricks at 800 x 600."""
    texels = 16 if context.quick else 64
    options = BtfOptions(texels=texels, lights="grid(12, 5, 80)", views="grid(12, 5, 80)", samples=1, bounces=0)
    table = bake_btf.in_memory(generators.brick(), options)
    timed = frames.knot()
    scene = frames.build(timed)
    camera = frames.camera_at(scene, timed, 0.5)
    size = 3600 * 3 * texels * texels // 50
    models = {
        "double-sh": double_sh.fit(table, DoubleShOptions(), backend="auto"),
        "eigen4": eigen.fit(table, EigenOptions(rank=4)),
        **{
            f"transform{rank}": transform.fit(table, Budget(size=size), TransformOptions(rank=rank))[0].expanded()
            for rank in (4, 16, 60)
        },
    }
    calls = {}
    for name, model in models.items():
        objects = tuple(replace(o, material=replace(o.material, btf=model)) for o in scene.objects)
        renderer = Renderer(replace(scene, objects=objects))
        calls[name] = lambda renderer=renderer: renderer.render(camera)
    timing = time_together(calls, n=3 if context.quick else 9, warm=2)
    for name, of in timing.items():
        yield Row(
            id=f"compress.decode.{name}",
            what=f"a frame of the knot of bricks, 800 x 600, half covered, {name}",
            value=round(min(of.wall, of.cpu), 1), unit="ms", better="lower", n=of.n,
            peer="transform code near 50:1 on disk, by the components that it keeps" if "transform" in name else None,
        )  # fmt: skip


def _flip(T: Tensor, shown: Tensor) -> str:
    """Return the mean FLIP of eight pictures, all at the exposure of the whole table."""
    exposure = quality.find_exposure(T)
    places = [(l, (7 * l + 3) % T.shape[1]) for l in range(0, T.shape[0], max(1, T.shape[0] // 8))]
    errors = [
        quality.flip(quality.to_screen(T[l, v], exposure), quality.to_screen(shown[l, v], exposure)) for l, v in places
    ]
    known = [e for e in errors if e is not None and math.isfinite(e)]
    return f"FLIP {sum(known) / len(known):.3f}" if known else "FLIP not installed"
