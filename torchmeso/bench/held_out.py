"""Directions that a fit never saw: errors of our interpolation there, beside what other programs do.

Baked tables are fitted on one set of directions and held against a second bake at random ones; of the real set of
pictures under 49 lights a tenth is left out at a time. Peers are the nearest direction, inverse-distance weighting of
the four nearest with every usual exponent (elerac's plug-in), and barycentric interpolation on the Delaunay
triangulation of parabolic coordinates (btflib). Errors are root mean squares of T.

Test: tests/bench/test_held_out.py
"""

import math
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.algebra import secular
from torchmeso.algebra.spherical_harmonics import basis, degree_of
from torchmeso.bench.suite import Context, Measurement, Row
from torchmeso.compress import double_sh, eigen, sh_pca
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.data import image, ubo2003
from torchmeso.data.address import texel_centres
from torchmeso.data.btf import Evaluable
from torchmeso.geometry import gaps, hemisphere
from torchmeso.geometry.hemisphere import DirectionSet
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions

Weights = Float[Tensor, "asked known"]

EXPONENTS = (1, 2, 4, 8, 16, 32)
"""Of inverse-distance weighting; 32 is the largest that the plug-in's notes name."""

FEW = "rings(10: 1 @ 40, 40: 1 @ 200, 62: 1 @ 300)"
"""Directions of the other side: random ones of one side are asked for at each of these."""

SEED = 3

SH_PCA = ShPcaOptions(rank=75, storage="float32", regularise=True)
"""All components of 25 coefficients: the few lights that random views are asked for under tell no more than theirs."""


def peers(known: Float[Tensor, "known 3"], asked: Float[Tensor, "asked 3"]) -> dict[str, Weights]:
    """Return the weights of every peer, float64, rows that sum to 1."""
    found = {"nearest": _nearest(known, asked)}
    found |= {f"inverse-distance-{p}": _inverse_distance(known, asked, p) for p in EXPONENTS}
    return {**found, "barycentric": _barycentric(known, asked)}


def _nearest(known: Tensor, asked: Tensor) -> Weights:
    weights = torch.zeros(len(asked), len(known), dtype=torch.float64)
    weights[torch.arange(len(asked)), (asked @ known.T).argmax(1)] = 1
    return weights


def _inverse_distance(known: Tensor, asked: Tensor, exponent: int) -> Weights:
    away, near = torch.cdist(asked, known).clamp(min=1e-9).topk(min(4, len(known)), largest=False)
    share = (away / away[:, :1]) ** -exponent
    weights = torch.zeros(len(asked), len(known), dtype=torch.float64)
    return weights.scatter_(1, near, share / share.sum(1, keepdim=True))


def _barycentric(known: Tensor, asked: Tensor) -> Weights:
    """Outside of the triangulation: the nearest."""
    from scipy.spatial import Delaunay

    places, wanted = ((w[:, :2] / (1 + w[:, 2:])).numpy() for w in (known, asked))
    mesh = Delaunay(places)
    weights = _nearest(known, asked)
    for row, (place, k) in enumerate(zip(wanted, mesh.find_simplex(wanted), strict=True)):
        if k >= 0:
            affine = mesh.transform[k]
            inner = affine[:2] @ (place - affine[2])
            weights[row] = 0
            weights[row, mesh.simplices[k]] = torch.from_numpy(np.array([*inner, 1 - inner.sum()]))
    return weights


def held_out(context: Context) -> Iterator[Row]:
    """The real set, and baked materials."""
    yield from measured(context)
    yield from baked(context)


def baked(context: Context, *, texels: int = 16, count: int = 240) -> Iterator[Row]:
    """Materials baked twice: where they are fitted, and where they are asked for."""
    materials = ("brick",) if context.quick else ("brick", "weave", "pipes", "spheres", "bark")
    for material in materials:
        for name in ("ubo81", "grid(12, 5, 80)"):
            directions = hemisphere.parse(name)
            for side in ("lights", "views"):
                yield from _side(material, directions, side, texels, count)


def _side(material: str, directions: DirectionSet, side: str, texels: int, count: int) -> Iterator[Row]:
    """Hold out directions of one side; the other side is asked for where it was fitted."""
    asked, few = anywhere(count, directions.last), hemisphere.parse(FEW)

    def bake(of: DirectionSet) -> bake_btf.Btf:
        lights, views = (of.name, few.name) if side == "lights" else (few.name, of.name)
        options = BtfOptions(texels=texels, samples=4, bounces=0, lights=lights, views=views)
        return bake_btf.in_memory(generators.GENERATORS[material](), options)

    table, truth = bake(directions), bake(asked)
    model = eigen.fit(table, EigenOptions(rank=len(table.views), storage="float32"))
    expected = truth.pictures()
    axis = 0 if side == "lights" else 1
    known, wanted = (d.directions(torch.float64) for d in (directions, asked))
    T = table.pictures().movedim(axis, 0)
    found = {
        "eigen": _error(_shown(model, truth), expected),
        "harmonics": _error(_harmonics(directions, T, wanted).movedim(0, axis), expected),
        "sh-pca": _error(_shown(sh_pca.fit(table, SH_PCA), truth), expected),
    }
    theirs = {name: _error(_mixed(w, T).movedim(0, axis), expected) for name, w in peers(known, wanted).items()}
    place = f"compress.held_out.baked.{material}.{directions.name.partition('(')[0]}.{side}"
    what = f"{count} random {side} of a baked {material} that was fitted at {directions.name}"
    yield from _rows(place, what, found, theirs)


def _rows(place: str, what: str, ours: dict[str, float], theirs: dict[str, float]) -> Iterator[Row]:
    best = min(theirs, key=lambda name: theirs[name])
    for name, error in {**ours, **theirs}.items():
        goal = float(f"{theirs[best]:.5g}") if name == next(iter(ours)) else None
        yield Row(
            id=f"{place}.{name}", what=f"RMS error of T at {what}, {name}", value=float(f"{error:.5g}"), unit="T",
            better="lower", goal=goal, peer=f"best peer: {best}" if goal is not None else None,
        )  # fmt: skip


def anywhere(count: int, last: float) -> DirectionSet:
    """Return random directions, even over the solid angle down to the polar angle `last` (radians)."""
    rng = torch.Generator().manual_seed(SEED)
    z = 1 - (1 - math.cos(last)) * (torch.arange(count) + 0.5).double() / count
    phi = (360 * torch.rand(count, generator=rng)).tolist()
    theta = z.acos().rad2deg().tolist()
    return hemisphere.from_rings([round(t, 4) for t in theta], [1] * count, [round(p, 4) for p in phi])


def _shown(model: Evaluable, truth: bake_btf.Btf) -> Float[Tensor, "light view H W 3"]:
    """Return the model's pictures at the directions of `truth`."""
    height, width = truth.texels
    wi, wo = truth.lights.directions(), truth.views.directions()
    uv = texel_centres(height, width).reshape(-1, 2)
    shown = torch.empty(len(wi), len(wo), height * width, 3)
    for l in range(len(wi)):
        for v in range(len(wo)):
            shown[l, v] = model.evaluate(uv, wi[l].expand(len(uv), 3), wo[v].expand(len(uv), 3))
    return shown.unflatten(2, (height, width))


def _mixed(weights: Weights, values: Float[Tensor, "known *texel"]) -> Float[Tensor, "asked *texel"]:
    return (weights.float() @ values.flatten(1)).unflatten(1, values.shape[1:])


def _harmonics(directions: DirectionSet, T: Tensor, asked: Tensor, terms: int = 25) -> Float[Tensor, "asked *texel"]:
    """Return the harmonics of one side of a double-SH BTF, bounded as there, at other directions."""
    by = double_sh.side("held out", directions, terms, DoubleShOptions())
    alone = double_sh.Side(factors=secular.factorise(torch.ones(1, 1), "one"), share=None)
    c = double_sh.project(T.flatten(1)[:, None].contiguous(), by, alone)[:, 0]
    return _mixed(basis(asked, degree_of(terms)), c).unflatten(1, T.shape[1:])


def _error(found: Tensor, expected: Tensor) -> float:
    return float((found - expected).square().mean().sqrt())


def measured(context: Context) -> Iterator[Row]:
    """Real pictures of one view under lights of ubo81: a tenth left out at a time, and a ring."""
    folder = Path(os.environ.get("TORCHMESO_DATA", "../shared/data")) / "ubo2003"
    if not folder.is_dir():
        yield Row(
            id="compress.held_out.ubo2003.scattered.kriging", what="RMS error of T at lights left out of a real set",
            value=None, unit="T", better="lower", why="real inputs are absent: set TORCHMESO_DATA",
        )  # fmt: skip
        return
    pictures = ubo2003.survey(folder)
    lights = sorted(l for l, _ in pictures.files)
    with pictures.opened() as read:
        T = torch.stack([image.decode_codes(read(pictures.files[l, 0]))[::2, ::2] for l in lights])
    yield from left_out(pictures.lights, torch.tensor(lights), T)


def left_out(directions: DirectionSet, lights: Int[Tensor, "known"], T: Float[Tensor, "known H W 3"]) -> Iterator[Row]:
    """Rows of pictures under some lights of a set: folds of a tenth, and the ring that is nearest to 45 degrees."""
    order = torch.randperm(len(lights), generator=torch.Generator().manual_seed(5))
    theta = directions.directions(torch.float64)[lights, 2].acos()
    middle = theta[(theta - math.pi / 4).abs().argmin()]
    ring = ((theta - middle).abs() < 1e-6).nonzero()[:, 0]
    for name, folds in {"scattered": order.split(-(-len(lights) // 10)), "ring": (ring,)}.items():
        square: dict[str, float] = {}
        for held in folds:
            for method, error in _fold(directions, lights, T, held).items():
                square[method] = square.get(method, 0.0) + error**2 * len(held)
        errors = {method: math.sqrt(x / sum(map(len, folds))) for method, x in square.items()}
        ours = {method: errors.pop(method) for method in ("kriging", "light-sh")}
        what = f"{sum(map(len, folds))} lights left out of {len(lights)} real ones, " + (
            "a tenth at a time" if name == "scattered" else "a whole ring"
        )
        yield from _rows(f"compress.held_out.ubo2003.{name}", what, ours, errors)


def _fold(directions: DirectionSet, lights: Tensor, T: Tensor, held: Tensor) -> dict[str, float]:
    kept = torch.ones(len(lights), dtype=torch.bool)
    kept[held] = False
    present = torch.zeros(len(directions), dtype=torch.bool)
    present[lights[kept]] = True
    w = directions.directions(torch.float64)
    known, asked = w[lights[kept]], w[lights[held]]
    each = peers(known, asked)
    # As `--allow-missing` fills: T / cos(theta_i). Peers get both, the better one counts.
    by_cosine = asked[:, 2:] / known[:, 2]
    ways = each | {f"{name}-cosine": x * by_cosine for name, x in each.items()}
    ways["kriging"] = gaps.filling(directions, present)[lights[held]][:, lights[kept]] * by_cosine
    ways["light-sh"] = _light_sh(known, asked)
    return {name: _error(_mixed(x, T[kept]), T[held]) for name, x in ways.items()}


def _light_sh(known: Tensor, asked: Tensor, degree: int = 3) -> Weights:
    """Least squares of sixteen harmonics of the light."""
    factors = secular.factorise(basis(known, degree), "lights", regularise=True)
    inverse = secular.solve(factors, torch.eye(len(known), dtype=torch.float64)).c
    return basis(asked, degree) @ inverse.T


MEASUREMENTS = (Measurement("compress.held_out", held_out),)
