"""The suite `compress`: fits of BTFs beside the papers' times, and the algebra they stand on beside its peers.

Test: tests/bench/test_compress.py
"""

import math
import time
from collections.abc import Iterator

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from torchmeso.algebra import gram, secular
from torchmeso.algebra.spherical_harmonics import basis
from torchmeso.bench import harmonics, held_out, sh_pca, sweeps, table2
from torchmeso.bench import rate as rates
from torchmeso.bench.suite import Context, Measurement, Row
from torchmeso.bench.timing import time_together
from torchmeso.compress import double_sh
from torchmeso.compress import eigen as eigen_fit
from torchmeso.compress import sh_pca as sh_pca_fit
from torchmeso.compress.double_sh import DoubleShOptions, Side
from torchmeso.geometry import hemisphere
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions

UNIT = 1 / 255


def projected(context: Context) -> Iterator[Row]:
    """Raw bytes in memory to eight-bit coefficients: the rows of Table II that fit into memory as bytes."""
    for size in (128,) if context.quick else (128, 256):
        raw = like_a_btf(size)
        for view_terms in (25, 36):
            options = DoubleShOptions(light_terms=25, view_terms=view_terms)
            light, view = _sides(options)
            start, cpu = time.perf_counter(), time.process_time()
            codes = _compressed(raw, light, view)
            seconds, used = time.perf_counter() - start, (time.process_time() - cpu) / 2
            paper = table2.PAPER_SECONDS[size, view_terms]
            yield Row(
                id=f"compress.table2.{size}.{view_terms}",
                what=f"double SH by CLS, {size} x {size} x 81 x 81 bytes in memory to {view_terms} x 25 coefficients "
                "of 8 bits",
                value=round(min(seconds, used), 2), unit="s", better="lower",
                goal=2.0 if (size, view_terms) == (128, 25) else None,
                peer=f"wall {seconds:.2f} s, CPU/cores {used:.2f} s; paper {paper} s, {paper / seconds:.0f}x; "
                f"{100 * codes / raw.numel():.2f} % of the bytes",
            )  # fmt: skip


def constrained(context: Context) -> Iterator[Row]:
    """The bound: its price in time beside none, and beside bisection; and whether every vector keeps it."""
    raw = like_a_btf(128)
    bounded, free = (_sides(DoubleShOptions(energy=e)) for e in (1.0, None))
    n = 3 if context.quick else 7
    timing = time_together(
        {
            "ours": lambda: double_sh.project(raw, *bounded, unit=UNIT, backend="opencl"),
            "free": lambda: double_sh.project(raw, *free, unit=UNIT, backend="opencl"),
            "products": lambda: _products(raw, *free),
        },
        n=n, warm=1,
    )  # fmt: skip
    free_ms = min(timing["free"].wall, timing["products"].wall)
    yield _ratio(
        "compress.cls.vs_projection", "double CLS, 128^2 x 81 x 81 to 25 x 25, over the faster plain projection",
        timing["ours"].wall / free_ms, "lower", 4.0, n,
        f"ours {timing['ours'].wall:.0f} ms (CPU/cores {timing['ours'].cpu:.0f}), without a bound "
        f"{timing['free'].wall:.0f} ms, products with the inverses in torch {timing['products'].wall:.0f} ms",
    )  # fmt: skip
    few = raw[:, :, :2048].contiguous()
    timing = time_together(
        {
            "ours": lambda: double_sh.project(few, *bounded, unit=UNIT, backend="opencl"),
            "bisection": lambda: _bisected(few, *bounded),
        },
        n=n, warm=1,
    )  # fmt: skip
    yield _ratio(
        "compress.cls.vs_bisection", "30 steps of bisection, batched in float32, over ours (2,048 columns)",
        timing["bisection"].wall / timing["ours"].wall, "higher", 3.0, n,
        f"bisection {timing['bisection'].wall:.0f} ms, ours {timing['ours'].wall:.1f} ms",
    )  # fmt: skip
    for terms in (25, 36):
        yield from _sound(few, terms)


def _sound(raw: UInt8[Tensor, "light view column"], terms: int) -> Iterator[Row]:
    """Both stages' vectors against their bounds, and against float64."""
    light, view = _sides(DoubleShOptions(light_terms=terms, view_terms=25))
    samples = raw[:, :, :512].float() * UNIT
    exact = double_sh.project(samples.double(), light, view)
    # Only the first stage: its vectors, one by one, against the bound of their samples.
    alone = Side(factors=secular.factorise(torch.ones(1, 1), "one"), share=None)
    c = double_sh.project(samples.flatten(1)[:, None].contiguous(), light, alone, backend="opencl")[:, 0].double()
    values = samples.flatten(1).double()
    assert light.share is not None
    bound = light.share @ values.square()
    plain = secular.solve(light.factors, values.T).c.square().sum(-1) > bound
    used = c.square().sum(0)
    worst = torch.where(plain, (used / bound - 1).abs(), (used / bound - 1).clamp(min=0)).max()
    count = f"{c.shape[1]} vectors, bounded {100 * float(plain.double().mean()):.0f} %"
    yield Row(
        id=f"compress.cls.bound.{terms}",
        what=f"largest relative distance of c.c from its bound where that holds, {terms} coefficients",
        value=float(f"{worst:.2g}"), unit="", better="lower", goal=1e-5, peer=count,
    )  # fmt: skip
    found = double_sh.project(samples, light, view, backend="opencl")
    error = ((found - exact).norm(dim=(0, 1)) / exact.norm(dim=(0, 1))).max()
    yield Row(
        id=f"compress.cls.float32.{terms}",
        what=f"largest relative error of {terms} x 25 coefficients of a column against float64",
        value=float(f"{error:.2g}"), unit="", better="lower", goal=1e-4,
    )  # fmt: skip


def quantised(context: Context) -> Iterator[Row]:
    """The paper's claim: a bounded fit lives through eight bits."""
    raw = like_a_btf(32)
    samples = raw.float() * UNIT
    for terms in (25, 36):
        noise = {}
        for name, energy in (("bounded", 1.0), ("free", None)):
            sides = _sides(DoubleShOptions(light_terms=terms, view_terms=terms, energy=energy))
            c = double_sh.project(samples, *sides, backend="opencl")
            low, high = c.amin(2, keepdim=True), c.amax(2, keepdim=True)
            step = ((high - low) / 255).clamp(min=1e-30)
            error = ((c - low) / step).round() * step + low - c
            light, view = (side.factors.matrix.float() for side in sides)
            shown = torch.einsum("li,vj,ijx->lvx", light, view, error)
            noise[name] = float(shown.square().mean())
        yield Row(
            id=f"compress.quantised.{terms}",
            what=f"noise of eight bits in what {terms} x {terms} coefficients show, least squares over CLS",
            value=round(10 * math.log10(noise["free"] / noise["bounded"]), 1), unit="dB", better="higher",
            goal=10.0 if terms == 36 else None,
            peer=f"RMS {noise['free'] ** 0.5:.2g} and {noise['bounded'] ** 0.5:.2g} of T",
        )  # fmt: skip


def eigen(context: Context) -> Iterator[Row]:
    """The leading components of a tall matrix, beside torch.linalg.svd."""
    generator = torch.Generator().manual_seed(1)
    rows, columns, rank = 64 * 64 * 12 * 8 * 3, 96, 16
    scale = torch.arange(1, rank + 1).float() ** -1.2
    A = torch.randn(rows, rank, generator=generator) * scale @ torch.randn(rank, columns, generator=generator)
    A += 1e-3 * torch.randn(rows, columns, generator=generator)

    def ours() -> tuple[Tensor, Tensor]:
        W = gram.right_basis(gram.gram([A], columns), rank).vectors.float()
        return A @ W, W

    start = time.perf_counter()
    torch.linalg.svd(A, full_matrices=False)
    svd_ms = 1e3 * (time.perf_counter() - start)
    values = gram.right_basis(gram.gram([A], columns, accurate=True), rank).values
    optimum = float(values[rank:].square().sum().sqrt())
    timing = time_together({"ours": ours}, n=3 if context.quick else 7, warm=1)["ours"]
    yield _ratio(
        "compress.eigen.vs_svd", f"torch.linalg.svd over ours, {rows} x {columns}, rank {rank}, with the scores",
        svd_ms / timing.wall, "higher", 8.0, timing.n, f"svd {svd_ms:.0f} ms, ours {timing.wall:.0f} ms",
    )  # fmt: skip
    scores, W = ours()
    error = float((scores @ W.T - A).double().norm()) / optimum - 1
    yield Row(
        id="compress.eigen.error", what="its error above the least possible one, relative",
        value=float(f"{error:.2g}"), unit="", better="lower", goal=1e-5,
    )  # fmt: skip
    whole = gram.gram([A], columns)
    parts = gram.gram(A.split(65536), columns)
    yield Row(
        id="compress.eigen.streamed", what="largest difference of the Gram matrix, in memory and in blocks",
        value=float((whole - parts).abs().max()), unit="", better="lower", goal=0.0,
    )  # fmt: skip


def rate(context: Context) -> Iterator[Row]:
    """Error over size on a baked material: double SH over the dial of its energy, eigen and SH + PCA BTFs over rank."""
    options = BtfOptions(texels=32, lights="ubo81", views="ubo81", samples=1, bounces=0)
    table = bake_btf.in_memory(generators.brick(), options)
    T = table.pictures().float()
    peak = float(torch.quantile(T.flatten()[::97], 0.995))
    y = basis(hemisphere.ubo81().directions(), 4)

    def row(name: str, place: str, shown: Tensor, bytes_per_texel: int) -> Row:
        error = float((shown - T).square().mean())
        return Row(
            id=f"compress.rate.brick.{name}.{place}",
            what=f"PSNR of all values of a baked brick BTF, 81 x 81 directions, {name} {place}",
            value=round(10 * math.log10(peak**2 / error), 2), unit="dB", better="higher",
            peer=f"{6561 / bytes_per_texel:.1f}:1 of 8-bit values",
            curve={"series": name, "x": bytes_per_texel / 6561},
        )  # fmt: skip

    for energy in (0.3, 1.0, 3.0, 10.0, None):
        model = double_sh.fit(table, DoubleShOptions(energy=energy), backend="auto")
        shown = torch.einsum("li,vj,ijhwc->lvhwc", y, y, model.decoded())
        yield row("double-sh", "unbounded" if energy is None else f"{energy:g}", shown, 625)
    for rank in (1, 2, 4, 8, 16):
        model = eigen_fit.fit(table, eigen_fit.EigenOptions(rank=rank))
        shown = torch.einsum("lhwkc,vk->lvhwc", model.decoded(), model.weights)
        yield row("eigen", str(rank), shown, 81 * rank)
    for rank in (2, 4, 8, 16, 32):
        model = sh_pca_fit.fit(table, sh_pca_fit.ShPcaOptions(rank=rank))
        yield row("sh-pca", str(rank), sh_pca.shown(model, table.lights), 27 * rank)


def _ratio(id: str, what: str, value: float, better: str, goal: float, n: int, peer: str) -> Row:
    assert better in ("higher", "lower")
    return Row(
        id=id, what=what, value=round(value, 2), unit="x", better="higher" if better == "higher" else "lower",
        goal=goal, n=n, peer=peer,
    )  # fmt: skip


def like_a_btf(size: int) -> UInt8[Tensor, "light view column"]:
    """Return bytes like those of a measured BTF of 81 x 81 directions: lobes, shading, grain and sensor noise."""
    generator = torch.Generator().manual_seed(7)
    w = hemisphere.ubo81().directions()
    mirrored = w * torch.tensor([-1.0, -1, 1])
    tilt = torch.nn.functional.normalize(
        torch.tensor([0.0, 0, 1]) + 0.4 * torch.randn(5, 3, generator=generator), dim=-1
    )
    shading = (w @ tilt.T).clamp(min=0)  # (light, 5): facets that lean
    lobe = (mirrored @ w.T).clamp(min=0)
    terms = [shading[:, k : k + 1].expand(-1, 81) for k in range(5)] + [lobe**4, lobe**20]
    angular = torch.stack(terms, -1)  # (light, view, 7)
    spatial = torch.rand(7, 3 * size * size, generator=generator) ** 2 * 0.4
    out = torch.empty(81, 81, 3 * size * size, dtype=torch.uint8)
    for light in range(81):
        T = angular[light] @ spatial
        T += 0.01 * torch.randn(T.shape, generator=generator)
        out[light] = (255 * T).clamp(0, 255).round().to(torch.uint8)
    return out


def _sides(options: DoubleShOptions) -> tuple[Side, Side]:
    directions = hemisphere.ubo81()
    return (
        double_sh.side("light", directions, options.light_terms, options),
        double_sh.side("view", directions, options.view_terms, options),
    )


def _compressed(raw: Tensor, light: Side, view: Side) -> int:
    """Return the number of bytes that are left of a table."""
    c = double_sh.project(raw, light, view, unit=UNIT, backend="opencl")
    codes, *_ = double_sh.quantised(c.flatten(0, 1).unflatten(1, (-1, 3)), "uint8")
    return codes.numel()


def _products(raw: Tensor, light: Side, view: Side) -> Tensor:
    """Multiply with both inverses: what a projection without a bound costs in torch."""
    left, right = light.factors.matrix.pinverse().float() * UNIT, view.factors.matrix.pinverse().float()
    parts = []
    for part in raw.split(4096, 2):
        first = (left @ part.float().flatten(1)).unflatten(1, part.shape[1:])
        parts.append(torch.matmul(right, first))
    return torch.cat(parts, 2)


def _bisected(raw: Tensor, light: Side, view: Side) -> Tensor:
    """Solve both stages with 30 steps of bisection each, in batches of float32."""

    def stage(samples: Float[Tensor, "direction row column"], by: Side) -> Tensor:
        columns = samples.movedim(0, -1)
        assert by.share is not None
        energy = columns.square() @ by.share.float()
        f = by.factors
        s2 = f.values.float().square()
        w2 = ((columns @ f.left.float()) * f.values.float()).square()
        low = torch.zeros_like(energy)
        high = (w2.sum(-1) / energy.clamp(min=1e-30)).sqrt()
        for _ in range(30):
            middle = (low + high) / 2
            over = (w2 / (s2 + middle[..., None]).square()).sum(-1) > energy
            low, high = torch.where(over, middle, low), torch.where(over, high, middle)
        w = (columns @ f.left.float()) * f.values.float()
        return ((w / (s2 + high[..., None])) @ f.right.float().T).movedim(-1, 0)

    return stage(stage(raw.float() * UNIT, light).movedim(1, 0), view).movedim(1, 0)


MEASUREMENTS = (
    Measurement("compress.table2", projected),
    Measurement("compress.cls", constrained),
    Measurement("compress.stream", table2.streamed),
    Measurement("compress.jpeg", table2.pictures),
    Measurement("compress.to_budget", table2.budgets),
    Measurement("compress.quantised", quantised),
    Measurement("compress.eigen", eigen),
    Measurement("compress.rate", rate),
    Measurement("compress.sh_pca", sh_pca.rows),
    Measurement("compress.budget", rates.budgets),
    Measurement("compress.adaptive", rates.adaptive),
    Measurement("compress.factored", rates.factorised),
    Measurement("compress.decode", rates.decoding),
    Measurement("compress.sh", harmonics.basis),
    Measurement("compress.rotation", harmonics.rotation),
    *held_out.MEASUREMENTS,
    *sweeps.MEASUREMENTS,
)
