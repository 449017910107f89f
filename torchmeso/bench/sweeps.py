"""Directions swept over every container: over the pole, through both horizons, around rings and around the pole.

A function that is C0 (and steep nowhere without bound) changes half as much in half a step: the largest jump of a
sweep halves when its steps do. A step in it, however small beside its slopes, would not.

Test: tests/bench/test_sweeps.py
"""

import math
from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.bench.suite import Context, Measurement, Row
from torchmeso.compress import double_sh, eigen, sh_pca
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.data.btf import Btf
from torchmeso.data.hsh import Hsh
from torchmeso.data.mdf import Mdf
from torchmeso.data.ptm import Ptm
from torchmeso.geometry import hemisphere
from torchmeso.geometry.directions import from_angles

Curve = Callable[[Float[Tensor, "step 3"]], Float[Tensor, "step value"]]
"""Returns what a container has to say along directions."""

AROUND_DEG = (1e-4, 5, 44.4, 80, 89.9, 95)
"""Polar angles of the circles: beside the pole, between rings, on rings, at the horizon and below it."""

UV = (0.31, 0.77)


def directions(steps: int) -> dict[str, Float[Tensor, "step 3"]]:
    """Return the sweeps, float64: half circles through the pole, a little below both horizons, and circles around it.

    All have steps of the same angle of theta or phi: pi / steps or 2 pi / steps.
    """
    theta = (torch.arange(steps + 1, dtype=torch.float64) / steps - 0.5) * (1.2 * math.pi)
    phi = torch.arange(steps + 1, dtype=torch.float64) / steps * (2 * math.pi)
    over = {f"over_{deg}": from_angles(theta, torch.full_like(theta, math.radians(deg))) for deg in (0, 37)}
    around = {f"around_{deg:g}": from_angles(torch.full_like(phi, math.radians(deg)), phi) for deg in AROUND_DEG}
    return over | around


def largest_jump(curve: Curve, w: Float[Tensor, "step 3"]) -> float:
    """Return the largest change from one step to the next."""
    return float(curve(w).diff(dim=0).abs().max())


def halving(curve: Curve, steps: int) -> float:
    """Return the largest jump at twice the steps over that at `steps`: 0.5 where all is C0, 1 at a step.

    Sweeps that stand still to the last bits count as 0.5.
    """
    worst = 0.5
    for coarse, fine in zip(directions(steps).values(), directions(2 * steps).values(), strict=True):
        whole = largest_jump(curve, coarse)
        if whole > 1e-9:
            worst = max(worst, largest_jump(curve, fine) / whole)
    return worst


def curves() -> dict[str, Curve]:
    """Return every container, of random values: light and view swept with the other one fixed."""
    rng = torch.Generator().manual_seed(1)
    found: dict[str, Curve] = {}
    fixed = torch.tensor([0.3, -0.2, 0.9], dtype=torch.float64)
    fixed = fixed / fixed.norm()
    for name in ("ubo81", "grid(7, 3, 80)"):
        of = hemisphere.parse(name)
        table = Btf(images=torch.rand(len(of), len(of), 2, 2, 3, generator=rng), lights=of, views=of)
        terms = 25 if name == "ubo81" else 9
        models = {
            "btf": table,
            "eigen": eigen.fit(table, EigenOptions(rank=8)),
            "double-sh": double_sh.fit(table, DoubleShOptions(light_terms=terms, view_terms=terms)),
            "sh-pca": sh_pca.fit(table, ShPcaOptions(rank=8, light_terms=terms)),
        }
        for kind, model in models.items():
            key = f"{kind}.{name.partition('(')[0]}"
            found[f"{key}.light"] = lambda w, m=model: m.evaluate(_here(w), w, fixed.expand_as(w))
            found[f"{key}.view"] = lambda w, m=model: m.evaluate(_here(w), fixed.expand_as(w), w)
            found[f"{key}.ambient"] = lambda w, m=model: m.ambient(_here(w), w)
        depth = Mdf(delta=torch.rand(len(of), 2, 2, generator=rng), no_hit=None, directions=of, h=0.1)
        found[f"mdf.{name.partition('(')[0]}.view"] = lambda w, m=depth: m.drop(_here(w), w)[0][:, None]
    codes = torch.randint(0, 256, (2, 2, 3, 9), generator=rng, dtype=torch.uint8)
    maps = {
        "ptm": Ptm(codes=codes[..., :6].contiguous(), scale=torch.ones(6), bias=torch.full((6,), 90.0), colour=None),
        "hsh": Hsh(codes=codes, scale=torch.full((9,), 1.0), bias=torch.full((9,), -0.4)),
    }
    for kind, model in maps.items():
        found[f"{kind}.light"] = lambda w, m=model: m.evaluate(_here(w), w)
    return found


def _here(w: Tensor) -> Tensor:
    return torch.tensor(UV, dtype=w.dtype).expand(len(w), 2)


def sweeps(context: Context) -> Iterator[Row]:
    """How the largest jump of each container shrinks with the step."""
    steps = 4000 if context.quick else 16000
    for name, curve in curves().items():
        yield Row(
            id=f"compress.sweep.{name}",
            what=f"largest jump of {name.replace('.', ', ')}, over pole, horizons and rings, at half the step over the "
            f"whole ({180 * 1.2 / steps:.3g} degrees); 1 were a step",
            value=round(halving(curve, steps), 4), unit="x", better="lower", goal=BOUND,
        )  # fmt: skip


BOUND = 0.55
"""Of a jump at half the step: a half, and what the places of the samples make of it."""

MEASUREMENTS = (Measurement("compress.sweep", sweeps),)
