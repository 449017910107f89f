"""Tables at the edge of what can be compressed, and beyond it: fits that must come out sound, or be refused.

Test: tests/bench/test_fit_extremes.py
"""

import math
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.bench.extremes import Refusal
from torchmeso.bench.suite import Context, Measurement, Row
from torchmeso.compress import dfmf, double_sh, double_sh_budget, eigen, eigen_budget, factored, sh_pca, transform
from torchmeso.compress import rti as rti_fit
from torchmeso.compress.budget import Budget
from torchmeso.compress.dfmf import DfmfOptions
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.factored import FactoredOptions
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.data import btf, btfdbb_write
from torchmeso.data.address import texel_centres
from torchmeso.data.btf import Btf, Evaluable
from torchmeso.data.rti import LightSet
from torchmeso.errors import MesoError
from torchmeso.geometry import hemisphere
from torchmeso.geometry.directions import from_angles
from torchmeso.geometry.hemisphere import DirectionSet

SET = hemisphere.grid(6, 3, 75)
RANK = 6
NEVER = math.inf
HARMONICS = DoubleShOptions(light_terms=9, view_terms=4)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Fit:
    """A table whose model must be sound.

    Attributes:
        name: of the row.
        what: half a sentence.
        table: the table.
        fit: makes the model of it.
        bound: largest root mean square error at the samples, over that of the table's own values.
    """

    name: str
    what: str
    table: Btf
    fit: Callable[[Btf], Evaluable]
    bound: float


def fits() -> Iterator[Fit]:
    """Yield every table by every method."""
    methods: dict[str, Callable[[Btf], Evaluable]] = {
        "eigen": lambda t: eigen.fit(t, EigenOptions(rank=RANK)),
        "double_sh": lambda t: double_sh.fit(t, HARMONICS),
        "sh_pca": lambda t: sh_pca.fit(t, ShPcaOptions(rank=RANK, light_terms=9)),
        "transform": lambda t: transform.fit(t, Budget(size=60_000))[0].expanded(),
        "factored": lambda t: factored.opened(factored.fit(t, FactoredOptions(rank=RANK))),
        "to_size": lambda t: eigen_budget.fit(t, Budget(size=60_000), storage="adaptive")[0],
        "double_sh_to_size": lambda t: double_sh_budget.fit(t, Budget(size=60_000), HARMONICS)[0],
    }
    for method, fit in methods.items():
        for name, (what, images, bound) in _values().items():
            table = Btf(images=images, lights=SET, views=SET)
            yield Fit(name=f"{method}.{name}", what=f"{method}, {what}", table=table, fit=fit, bound=bound)
    for name, (what, lights, options) in _directions().items():
        table = _table(lights)
        yield Fit(
            name=f"double_sh.{name}", what=f"double_sh, {what}", table=table,
            fit=lambda t, o=options: double_sh.fit(t, o), bound=0.7,
        )  # fmt: skip
        yield Fit(
            name=f"eigen.{name}", what=f"eigen, {what}", table=table,
            fit=lambda t: eigen.fit(t, EigenOptions(rank=4)), bound=0.15,
        )  # fmt: skip
    yield Fit(
        name="double_sh.no_energy", what="double_sh with a bound E of 0: nothing is left", table=_table(SET),
        fit=lambda t: double_sh.fit(t, DoubleShOptions(light_terms=4, view_terms=4, energy=0)), bound=1.0,
    )  # fmt: skip
    yield Fit(
        name="eigen.rank_above", what="eigen, more components than the table has", table=_of_rank(2),
        fit=lambda t: eigen.fit(t, EigenOptions(rank=len(t.views))), bound=0.02,
    )  # fmt: skip


def _values() -> dict[str, tuple[str, Float[Tensor, "light view H W 3"], float]]:
    """Return half a sentence, pictures, and the bound of the relative error."""
    smooth = _table(SET).pictures()
    spread = torch.logspace(-3, 3, smooth.shape[3])[:, None]
    one = torch.zeros_like(smooth)
    one[7, 5, 2, 3] = 1e4
    unlit = smooth.clone()
    unlit[7], unlit[:, 5] = 0, 0
    return {
        "zero": ("all zero", torch.zeros_like(smooth), NEVER),
        "constant": ("one value everywhere", torch.full_like(smooth, 0.25), 0.5),
        "negative": ("negative values", -smooth, 0.5),
        "dynamic_range": ("texels of 1e6 : 1", smooth * spread, 0.5),
        "one_texel": ("one value of 1e4 among zeros", one, 1.01),
        "zero_weights": ("a light and a view that show nothing, whose weights are zero", unlit, 0.5),
        "tiny": ("values of 1e-30", smooth * 1e-30, NEVER),
        "large": ("values of 1e4", smooth * 1e4, 0.5),
    }


def _directions() -> dict[str, tuple[str, DirectionSet, DoubleShOptions]]:
    few = DoubleShOptions(light_terms=4, view_terms=4)
    return {
        "twins": ("a direction three times", hemisphere.from_rings((0, 40, 70), (3, 6, 8), (0, 0, 0)), few),
        "cluster": (
            "18 directions within 0.1 degrees, and 14 others",
            hemisphere.from_rings((0.05, 0.1, 35, 65), (6, 12, 6, 8), (0, 0, 0, 0)),
            few,
        ),
        "single": (
            "a single light",
            hemisphere.from_rings((30,), (1,), (10,)),
            DoubleShOptions(light_terms=1, view_terms=4),
        ),
        "regularised": (
            "49 coefficients on six rings, regularised",
            hemisphere.ubo81(),
            DoubleShOptions(light_terms=49, view_terms=4, regularise=True),
        ),
    }


def _table(lights: DirectionSet, views: DirectionSet = SET, texels: int = 6) -> Btf:
    """Return a table of leaning facets under a broad lobe."""
    rng = torch.Generator().manual_seed(4)
    n = torch.nn.functional.normalize(torch.randn(texels * texels, 3, generator=rng) * 0.3 + torch.eye(3)[2], dim=-1)
    wi, wo = lights.directions(), views.directions()
    shading = (n @ wi.T).clamp(min=0)  # (texel, light)
    half = torch.nn.functional.normalize(wi[:, None] + wo, dim=-1)
    lobe = torch.einsum("lvx,tx->lvt", half, n).clamp(min=0) ** 8
    T = 0.5 * shading.T[:, None] + 0.4 * lobe
    colour = torch.rand(texels * texels, 3, generator=rng)
    return Btf(images=(T[..., None] * colour).unflatten(2, (texels, texels)), lights=lights, views=views)


def _of_rank(rank: int) -> Btf:
    rng = torch.Generator().manual_seed(5)
    scores, W = torch.rand(len(SET), 16, 3, rank, generator=rng), torch.rand(len(SET), rank, generator=rng)
    images = torch.einsum("ltck,vk->lvtc", scores, W).unflatten(2, (4, 4))
    return Btf(images=images, lights=SET, views=SET)


def refusals() -> Iterator[Refusal]:
    """Yield every input that no model can be made of."""
    for terms in (49, 64, 81):
        options = DoubleShOptions(light_terms=terms, view_terms=4)
        yield Refusal(
            name=f"terms_{terms}", what=f"{terms} coefficients on the six rings of ubo81",
            make=partial(_double_sh, _table(hemisphere.ubo81()), options),
        )  # fmt: skip
    one = _table(hemisphere.from_rings((30,), (1,), (10,)))
    yield Refusal(
        name="single_light", what="nine coefficients of one light",
        make=partial(_double_sh, one, DoubleShOptions(light_terms=9, view_terms=4)),
    )  # fmt: skip
    for terms in (0, 5, -4, 26, 484):
        yield Refusal(
            name=f"terms_{terms}", what=f"{terms} coefficients", make=partial(DoubleShOptions, light_terms=terms)
        )
    for energy in (-1.0, math.nan, math.inf):
        yield Refusal(
            name=f"energy_{energy}", what=f"a bound of {energy}", make=partial(DoubleShOptions, energy=energy)
        )
    for name, value in {"nan": math.nan, "inf": math.inf, "1e30": 1e30}.items():
        images = _table(SET).pictures().clone()
        images[3, 4, 2, 1] = value
        spoilt = Btf(images=images, lights=SET, views=SET)
        yield Refusal(
            name=f"double_sh_{name}", what=f"double_sh of a texel of {value}",
            make=partial(_double_sh, spoilt, DoubleShOptions(light_terms=4, view_terms=4)),
        )  # fmt: skip
        yield Refusal(
            name=f"dfmf_{name}",
            what=f"factors of a texel of {value}",
            make=partial(dfmf.fit, spoilt, DfmfOptions(rank=2)),
        )
    large = Btf(images=_table(SET).pictures() * 1e6, lights=SET, views=SET)
    yield Refusal(
        name="double_sh_half", what="coefficients beyond half precision",
        make=partial(_double_sh, large, DoubleShOptions(light_terms=4, view_terms=4)),
    )  # fmt: skip
    yield Refusal(
        name="table_half", what="a table beyond half precision", make=partial(_written, btf.save, large, "a.btf.zarr")
    )
    yield Refusal(name="bdi_half", what="a BDI beyond half precision", make=partial(_written, _bdi, large, "a.btf"))
    yield Refusal(
        name="eigen_rank", what="more components than views",
        make=partial(eigen.fit, _table(SET), EigenOptions(rank=len(SET) + 1)),
    )  # fmt: skip
    yield Refusal(
        name="dfmf_rank", what="more factors than directions and texels",
        make=partial(dfmf.fit, _table(SET), DfmfOptions(rank=10**6)),
    )  # fmt: skip
    ring = LightSet(files=(Path("a.png"),) * 12, directions=hemisphere.from_rings((40,), (12,), (0,)).directions())
    yield Refusal(name="ptm_ring", what="a PTM of one ring of lights", make=partial(rti_fit.fit_ptm, ring))
    same = LightSet(files=(Path("a.png"),) * 12, directions=torch.tensor([[0.0, 0.6, 0.8]]).expand(12, 3))
    yield Refusal(
        name="hsh_twins", what="harmonics of twelve lights in one place", make=partial(rti_fit.fit_hsh, same, 4)
    )


def _double_sh(table: Btf, options: DoubleShOptions) -> Evaluable:
    return double_sh.fit(table, options)


def _written(write: Callable[[Btf, Path], object], table: Btf, name: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        write(table, Path(folder) / name)


def _bdi(table: Btf, path: Path) -> None:
    btfdbb_write.write_bdi(path, table)


def judge(case: Fit) -> tuple[int, float]:
    """Return how many values of the model are not finite, over the whole sphere too, and its relative error."""
    model = case.fit(case.table)
    T = case.table.pictures().double()
    height, width = case.table.texels
    uv = texel_centres(height, width).reshape(-1, 2)
    n_light, n_texel = len(case.table.lights), len(uv)
    wi = case.table.lights.directions().repeat_interleave(n_texel, 0)
    shown = torch.empty_like(T)
    for v, wo in enumerate(case.table.views.directions()):
        found = model.evaluate(uv.repeat(n_light, 1), wi, wo.expand(len(wi), 3))
        shown[:, v] = found.reshape(n_light, height, width, 3)
    around = from_angles(torch.linspace(0, math.pi, 50), torch.linspace(0, 20, 50))
    here = uv[:1].expand(50, 2)
    beyond = torch.cat([model.evaluate(here, around, around.flip(0)), model.ambient(here, around)])
    lost = int((~shown.isfinite()).sum() + (~beyond.isfinite()).sum())
    size = float(T.square().mean().sqrt())
    return lost, float((shown - T).square().mean().sqrt()) / (size or 1.0)


def stress(context: Context) -> Iterator[Row]:
    """Fits that must be sound."""
    for case in fits():
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                lost, error = judge(case)
            said = None
        except Exception as failure:  # a row is red where anything leaves
            lost, error, said = 1, 1e300, f"{type(failure).__name__}: {failure}"
        yield Row(
            id=f"fit.{case.name}.finite", what=f"values that are not finite: {case.what}", value=lost, unit="values",
            better="lower", goal=0, peer=said,
        )  # fmt: skip
        if case.bound < NEVER:
            yield Row(
                id=f"fit.{case.name}.error", what=f"root mean square error over that of the values: {case.what}",
                value=float(f"{error:.3g}"), unit="relative", better="lower", goal=case.bound, peer=said,
            )  # fmt: skip


def refused(context: Context) -> Iterator[Row]:
    """Inputs that must be refused, each with one of our errors."""
    for case in refusals():
        try:
            case.make()
            said = "accepted"
        except MesoError as error:
            said = f"refused: {error}"
        except Exception as error:
            said = f"{type(error).__name__}: {error}"
        yield Row(
            id=f"unfit.{case.name}", what=f"accepted, or a failure that is none of our errors: {case.what}",
            value=int(not said.startswith("refused")), unit="inputs", better="lower", goal=0, peer=said,
        )  # fmt: skip


MEASUREMENTS = (Measurement("fit", stress), Measurement("unfit", refused))
