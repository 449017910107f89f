"""The suite `stability`: a defined picture or a clear refusal, whatever comes in, and how errors grow.

Each case is drawn by torch in float32 and in float64 and by OpenCL. A row is green when no value of any picture is
NaN or infinite (the depth of the background is), and when at most a stated share of pixels differs from float64.

Test: tests/bench/test_stability.py
"""

import math
import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from typing import TypeVar

import torch

from torchmeso.bench import extremes, fit_extremes, fuzz, fuzz_readers, gdm_extremes
from torchmeso.bench.extremes import Case
from torchmeso.bench.suite import Context, Measurement, Row, resident_peak
from torchmeso.compress import eigen
from torchmeso.compress.eigen import EigenOptions
from torchmeso.errors import MesoError
from torchmeso.geometry.camera import Camera
from torchmeso.render import frame
from torchmeso.render.film import Picture
from torchmeso.render.frame import FrameOptions, Skips
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Scene, in_double

T = TypeVar("T")

OPTIONS = FrameOptions(shadow_map_size=128, skips=Skips(carried=False))
"""Without the one skip that is not the formula: what is judged here is arithmetic."""

SEEN = 1 / 255
"""A pixel differs when a channel does by more than this."""


def pictures(context: Context) -> Iterator[Row]:
    """Every case on both backends, against float64."""
    for case in extremes.cases(64 if context.quick else 160):
        yield from judge(case)


def shells(context: Context) -> Iterator[Row]:
    """The same for shells that carry a GDM."""
    size = 64 if context.quick else 160
    for case in gdm_extremes.cases(size):
        yield from judge(case, "shell")
    if not context.quick:
        yield from judge(gdm_extremes.million(size), "shell")


def judge(case: Case, group: str = "picture") -> Iterator[Row]:
    """Two rows of a case: values that are not finite, and the share of pixels that differ."""
    made = _attempt(case.make)
    if isinstance(made, str):
        yield _row(f"{group}.{case.name}.finite", f"{case.what}: no scene", math.inf, "values", 0, made)
        return
    truth = _draw("float64", *(case.truth or case.make)())
    drawn = {name: _draw(name, *made) for name in ("torch", "opencl")}
    wrong = {
        name: picture if isinstance(picture, str) else f"{_not_finite(picture)}" for name, picture in drawn.items()
    }
    whole = [p for p in drawn.values() if isinstance(p, Picture)]
    lost = sum(map(_not_finite, whole)) + (2 - len(whole)) * 4 * made[1].width * made[1].height
    yield _row(
        f"{group}.{case.name}.finite", f"{case.what}: values that are not finite", lost, "values", 0,
        "; ".join(f"{name} {text}" for name, text in wrong.items()),
    )  # fmt: skip
    if isinstance(truth, str) or len(whole) < 2:
        return
    shares = {name: differing(p, truth, case.exposure) for name, p in zip(drawn, whole, strict=True)}
    yield _row(
        f"{group}.{case.name}.differ", f"{case.what}: pixels that differ from float64 by more than 1/255",
        round(max(shares.values()), 4), "% of pixels", case.bound,
        "; ".join(f"{name} {share:.3f}" for name, share in shares.items())
        + f"; between them {differing(whole[0], whole[1], case.exposure):.3f}",
    )  # fmt: skip


def refused(context: Context) -> Iterator[Row]:
    """Every input that must be refused with one of our errors."""
    for case in chain(extremes.refusals(), gdm_extremes.refusals()):
        said = _attempt(case.make)
        yield _row(
            f"refused.{case.name}", f"{case.what}: accepted, or a failure that is none of our errors",
            0 if isinstance(said, str) and said.startswith("refused: ") else 1, "inputs", 0,
            said if isinstance(said, str) else "accepted",
        )  # fmt: skip


def grazing(context: Context) -> Iterator[Row]:
    """Error of float32 over the angle of the view."""
    for deg in (60, 75, 85, 88, 89, 89.5, 89.9, 89.99):
        size = 64 if context.quick else 160
        yield from _errors("grazing", f"at {deg:g} degrees from the normal", deg, partial(extremes.grazing, deg, size))


def distance(context: Context) -> Iterator[Row]:
    """Error of float32 over the distance from the origin, against float64 at home."""
    size = 64 if context.quick else 160
    for power in range(8):
        make = partial(extremes.moved_to, float(10**power), size)
        yield from _errors(
            "distance", f"10^{power} units from the origin", power, make, partial(extremes.moved_to, 0.0, size)
        )


def condition(context: Context) -> Iterator[Row]:
    """Error of the eigen fit of rank 12, and of the best there is, over the condition of the matrix (24 views)."""
    n, rank = 24, 12
    for power in range(13):
        spectrum = torch.logspace(0, -power, n, dtype=torch.float64)
        table = extremes.table(spectrum)
        A = table.pictures().double().permute(0, 2, 3, 4, 1).reshape(-1, n)
        values, vectors = torch.linalg.svd(A, full_matrices=False)[1:]
        W = vectors[:rank].T
        model = eigen.fit(table, EigenOptions(rank=rank, storage="float32"))
        E = model.decoded().double().permute(0, 1, 2, 4, 3).reshape(-1, rank)
        found = {
            "float32": float((A - E @ model.weights.double().T).norm() / A.norm()),
            "float64": float((A - A @ W @ W.T).norm() / A.norm()),
        }
        best = float(values[rank:].norm() / A.norm())
        for name, error in found.items():
            yield Row(
                id=f"condition.fit.{name}.1e{power}",
                what=f"relative error of rank {rank} for a matrix of condition 1e{power}; the least is {best:.3g}",
                value=float(f"{error:.3g}"), unit="relative", better="lower",
                goal=float(f"{1.001 * best + CONDITION_BOUND:.3g}"), curve={"series": name, "x": power},
            )  # fmt: skip


CONDITION_BOUND = 2e-4
"""Of the error of a fit above the least: below sqrt(eps) = 3e-4 of the largest all drowns in a float32 Gram matrix."""


def large(context: Context) -> Iterator[Row]:
    """Pictures of 8192 x 8192 pixels: drawn in bounded time and memory, or refused."""
    what = "a picture of 8192 x 8192 pixels"
    if context.quick:
        yield Row(
            id="large.opencl.seconds", what=what, value=None, unit="s", better="lower", why="full run only", goal=30.0
        )
        return
    scene, camera = extremes.grazing(60, 8192)
    said = _attempt(lambda: frame.render(scene, camera, OPTIONS))
    yield _row(
        "large.torch.refused", f"{what} on torch: neither drawn nor refused", 0 if _is_ours(said) else 1, "pictures", 0,
        said if isinstance(said, str) else "drawn",
    )  # fmt: skip
    resident_peak()
    start, busy = time.perf_counter(), time.process_time()
    picture = _draw("opencl", scene, camera)
    wall, busy = time.perf_counter() - start, (time.process_time() - busy) / (os.cpu_count() or 1)
    seconds, megabytes = min(wall, busy), resident_peak()
    if isinstance(picture, str):
        yield _row("large.opencl.finite", f"{what}: values that are not finite", math.inf, "values", 0, picture)
        return
    yield _row("large.opencl.finite", f"{what}: values that are not finite", _not_finite(picture), "values", 0, "")
    yield _row(
        "large.opencl.seconds",
        f"{what}, first frame with upload",
        round(seconds, 2),
        "s",
        30,
        f"{wall:.1f} s of wall time, {busy:.1f} s of CPU time over cores",
    )
    yield _row("large.opencl.memory", f"{what}: memory of the process", megabytes, "MB", 8192, "")


def _errors(
    group: str,
    where: str,
    x: float,
    make: "Callable[[], tuple[Scene, Camera]]",
    truth: "Callable[[], tuple[Scene, Camera]] | None" = None,
) -> Iterator[Row]:
    """Rows of a curve: the mean error of both backends against float64."""
    exact = _draw("float64", *(truth or make)())
    for name in ("torch", "opencl"):
        picture = _draw(name, *make())
        drawn = isinstance(picture, Picture) and isinstance(exact, Picture)
        error = float((picture.rgb - exact.rgb).abs()[exact.owner != -1].mean()) if drawn else math.inf  # pyright: ignore[reportAttributeAccessIssue]
        yield Row(
            id=f"{group}.error.{name}.{x:g}", what=f"mean error of {name} in float32 {where}, against float64",
            value=float(f"{error:.3g}"), unit="radiance", better="lower", goal=ERROR_BOUND,
            curve={"series": name, "x": x},
        )  # fmt: skip


ERROR_BOUND = 1e-4
"""Of the mean error of a picture: a fortieth of what 8 bits show."""


def _row(name: str, what: str, value: float, unit: str, goal: float, peer: str) -> Row:
    value = value if math.isfinite(value) else 1e300  # JSON has no infinity
    return Row(id=name, what=what, value=value, unit=unit, better="lower", goal=goal, peer=peer or None)


def _attempt(make: Callable[[], T]) -> T | str:
    """Return what `make` makes, or what it said instead."""
    try:
        return make()
    except MesoError as error:
        return f"refused: {error}"
    except Exception as error:  # a row is red where anything else leaves
        return f"{type(error).__name__}: {error}"


def _is_ours(said: object) -> bool:
    return not isinstance(said, str) or said.startswith("refused: ")


def _draw(how: str, scene: Scene, camera: Camera) -> Picture | str:
    return _attempt(
        {
            "torch": lambda: frame.render(scene, camera, OPTIONS),
            "float64": lambda: frame.render(in_double(scene), camera, OPTIONS),
            "opencl": lambda: Renderer(scene, OPTIONS).render(camera),
        }[how]
    )


def _not_finite(picture: Picture) -> int:
    """Return how many values of a picture are NaN or infinite; where nothing is seen, depth is infinite."""
    depth = picture.depth.isfinite() | (picture.owner == -1)
    return int((~picture.rgb.isfinite()).sum()) + int((~depth).sum())


def differing(a: Picture, b: Picture, exposure: float = 1.0) -> float:
    """Return the share of pixels, in percent, that differ by more than 1/255 in a channel."""
    return 100 * float((exposure * (a.rgb - b.rgb).abs().amax(-1) > SEEN).double().mean())


MEASUREMENTS = [
    Measurement("picture", pictures),
    Measurement("shell", shells),
    Measurement("refused", refused),
    Measurement("grazing", grazing),
    Measurement("distance", distance),
    Measurement("condition", condition),
    Measurement("large", large),
    *fit_extremes.MEASUREMENTS,
    *fuzz.MEASUREMENTS,
    *fuzz_readers.MEASUREMENTS,
]
