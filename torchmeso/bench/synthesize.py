"""The suite `synthesize`: quilting, its time beside brute force, its seams beside the exemplar's own gradients.

BTFs are baked from geometry. Their tiles repeat, so patches may run over the exemplar's border, and copies of a
neighbour's continuation are left out. Pictures are the quilting exemplars of the folder of real inputs.

Test: tests/bench/test_synthesize.py
"""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.bench import frames, graphcut, speed, surfaces, wang
from torchmeso.bench.suite import Context, Measurement, Row
from torchmeso.bench.timing import time_together
from torchmeso.config import data_dir
from torchmeso.config_sections import MaterialConfig
from torchmeso.data import address, image
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.geometry.directions import from_angles
from torchmeso.pipeline import bake
from torchmeso.render.scene import Scene, quilted
from torchmeso.render.silhouette import Silhouette
from torchmeso.synthesize import patch_error, quilting, seam_dp, tiling
from torchmeso.synthesize.patch_error import Exemplar, Search
from torchmeso.synthesize.quilting import QuiltingOptions

MATERIALS = ("brick", "bark", "weave")
"""Mesostructures of the project, 64 x 64 texels and 60 x 60 directions."""

LARGE = (256, 256)
"""What kawasaki2005quilting quilts from 64 x 64 (section 5)."""

PAIRS = 20
"""Pairs of light and view that seams are looked at under."""

NUMBA_MS = 0.070
"""64 seams of 64 x 16 texels in numba, one thread: measured before, what compiled seams are to reach within twice."""


def model(kind: str, context: Context) -> EigenBtf:
    """Return the eigen BTF of a material, baked or from the cache."""
    wanted = MaterialConfig.model_validate({"meso": {"type": kind}, **frames.SMALL})
    found = bake.prepare_material(kind, wanted, context.report, depth=False).material.btf
    assert isinstance(found, EigenBtf)
    return found


def _quilt(look: patch_error.Look, *, toroidal: bool, seed: int = 0) -> QuiltingMap:
    options = QuiltingOptions(toroidal=toroidal, tileable=True)
    rng = torch.Generator().manual_seed(seed)
    return quilting.grow(patch_error.exemplar(look), LARGE, options, rng=rng, backend="auto").map


def times(context: Context) -> Iterator[Row]:
    """The paper's experiment, from a BTF to a map."""
    look = model(MATERIALS[0], context)
    took = time_together({"quilt": lambda: _quilt(look, toroidal=True)}, n=3 if context.quick else 9, warm=1)["quilt"]
    yield Row(
        id="synthesize.quilting.64_to_256", what="brick BTF of 64 x 64 texels to a quilting map of 256 x 256, whole",
        value=round(1e-3 * min(took.wall, took.cpu), 3), unit="s", better="lower", goal=0.5,
        spread=(round(1e-3 * took.low, 3), round(1e-3 * took.high, 3)), n=took.n,
        peer=f"wall {1e-3 * took.wall:.3f} s, CPU/cores {1e-3 * took.cpu:.3f} s",
    )  # fmt: skip


def search(context: Context) -> Iterator[Row]:
    """The errors of all placements of a patch: spectra beside plain NumPy."""
    source = patch_error.exemplar(model(MATERIALS[0], context))
    side, overlap = 21, 5
    mask = torch.zeros(side, side, dtype=torch.bool)
    mask[:overlap] = mask[:, :overlap] = True
    target, by_spectra = source.codes[7 : 7 + side, 9 : 9 + side], Search(source)
    exact, found = by_hand(source, target, mask), by_spectra.errors(target, mask).numpy()
    yield Row(
        id="synthesize.search.error", what="largest error of a volume by FFT, over the largest value of brute force's",
        value=float(np.abs(found - exact).max() / exact.max()), unit="relative", better="lower", goal=1e-5,
    )  # fmt: skip
    calls = {"fft": lambda: by_spectra.errors(target, mask), "numpy": lambda: by_hand(source, target, mask)}
    with patch_error.one_thread():  # as quilting does
        timing = time_together(calls, n=5 if context.quick else 15)
    yield Row(
        id="synthesize.search.vs_numpy",
        what=f"all placements of a patch of {side} texels, {source.codes.shape[2]} channels, brick BTF of 64 x 64 "
        "texels: times as fast as plain NumPy, CPU time",
        value=round(timing["numpy"].cpu / timing["fft"].cpu, 1), unit="x", better="higher", n=timing["fft"].n,
        peer=f"NumPy {2 * timing['numpy'].cpu:.2f} ms, FFT {2 * timing['fft'].cpu:.2f} ms; codes keep "
        f"{100 * source.kept:.2f} % of the variance",
    )  # fmt: skip


def by_hand(source: Exemplar, target: Int[Tensor, "h w C"], mask: Tensor) -> Int[np.ndarray, "rows columns"]:
    """Return the errors of all placements, texel after texel of the overlap."""
    codes, wanted = source.codes.numpy(), target.numpy()
    height, width = mask.shape
    rows, columns = codes.shape[0] - height + 1, codes.shape[1] - width + 1
    total = np.zeros((rows, columns), np.int64)
    for y, x in mask.nonzero().tolist():
        difference = codes[y : y + rows, x : x + columns] - wanted[y, x]
        total += (difference * difference).sum(-1)
    return total


def seams_by_dp(context: Context) -> Iterator[Row]:
    """Compiled seams."""
    e = torch.randint(0, 1 << 20, (64, 64, 16), generator=torch.Generator().manual_seed(0))
    calls: dict[str, Callable[[], object]] = {
        "opencl": partial(seam_dp.cut, e, left=16, backend="opencl"),
        "torch": partial(seam_dp.cut, e, left=16, backend="torch"),
    }
    timing = time_together(calls, n=9 if context.quick else 25)
    yield Row(
        id="synthesize.seam_dp.64", what="64 seams of 64 x 16 texels on OpenCL, call and copies included",
        value=round(min(timing["opencl"].wall, 2 * timing["opencl"].cpu), 3), unit="ms", better="lower",
        goal=2 * NUMBA_MS, n=timing["opencl"].n,
        peer=f"torch {timing['torch'].wall:.2f} ms in this run; numba {NUMBA_MS:.3f} ms in an earlier one",
    )  # fmt: skip


def seam_energy(context: Context) -> Iterator[Row]:
    """What seams show: the 99th percentile of squared differences across them over that inside of the exemplar."""
    for kind in MATERIALS:
        look = model(kind, context)
        quilted_map = _quilt(look, toroidal=True)
        ratios = sorted(seam_ratio(picture, quilted_map, wraps=True) for picture in _relit(look))
        yield Row(
            id=f"synthesize.seams.{kind}",
            what=f"{kind} BTF, 64 x 64 to 256 x 256 texels under {PAIRS} pairs of light and view: 99th percentile of "
            "squared differences across seams over the exemplar's own, in the middle",
            value=round(ratios[len(ratios) // 2], 3), unit="x", better="lower", goal=1.0,
            spread=(round(ratios[0], 3), round(ratios[-1], 3)), n=PAIRS,
        )  # fmt: skip
    paths = sorted((data_dir() / "texture").glob("t*.png"))
    ratios = []
    for path in paths:
        look = image.to_srgb(image.read(path))
        ratios.append((seam_ratio(look, _quilt(look, toroidal=False), wraps=False), path.stem))
    ratios.sort()
    yield Row(
        id="synthesize.seams.pictures",
        what="the same of the quilting exemplars, sRGB, to 256 x 256 texels, in the middle of the pictures",
        value=round(ratios[len(ratios) // 2][0], 3) if ratios else None, unit="x", better="lower", goal=1.0,
        spread=(round(ratios[0][0], 3), round(ratios[-1][0], 3)) if ratios else None, n=max(len(ratios), 1),
        peer="; ".join(f"{name} {ratio:.2f}" for ratio, name in ratios) or None,
        why=None if ratios else "the folder of real inputs is absent: set TORCHMESO_DATA",
    )  # fmt: skip


def tile_seams(context: Context) -> Iterator[Row]:
    """What sets of tiles show at their borders and where patches meet inside of them."""
    for kind in MATERIALS:
        look = model(kind, context)
        tiles = wang.grown(look, "edges", toroidal=True)
        laid = tiles.lay(tiling.plane(tiles, wang.PLANE, wang.PLANE), tileable=True)
        shown = list(_relit(look))
        inside = [seam_ratio(picture, laid, wraps=True) for picture in shown]
        borders = [wang.border_ratio(picture, laid, tiles.side, wraps=True) for picture in shown]
        for name, where, found in (("borders", "borders of tiles", borders), ("seams", "all seams", inside)):
            ratios = sorted(found)
            yield Row(
                id=f"tiles.relit.{name}.{kind}",
                what=f"{kind} BTF, 16 tiles of {tiles.side} x {tiles.side} texels under {PAIRS} pairs of light and "
                f"view: 99th percentile of squared differences across {where} over the exemplar's own, in the middle",
                value=round(ratios[len(ratios) // 2], 3), unit="x", better="lower", goal=1.0,
                spread=(round(ratios[0], 3), round(ratios[-1], 3)), n=PAIRS,
            )  # fmt: skip


def seam_ratio(picture: Float[Tensor, "H W C"], quilting: QuiltingMap, *, wraps: bool) -> float:
    """Return the 99th percentile of squared differences across seams over that of the exemplar's neighbours.

    `wraps`: whether the exemplar tiles.
    """

    def percentile(x: Tensor) -> float:
        return float(np.percentile(x.double().numpy(), 99)) if len(x) else 0.0

    shown = quilting.apply(picture)
    across = [
        (shown.roll(-1, axis) - shown).square().sum(-1)[which]
        for axis, which in zip((1, 0), quilting.seams(), strict=True)
    ]
    last = 0 if wraps else -1
    inside = [
        (picture.roll(-1, axis) - picture).square().sum(-1).narrow(axis, 0, picture.shape[axis] + last).flatten()
        for axis in (1, 0)
    ]
    return percentile(torch.cat(across)) / max(percentile(torch.cat(inside)), 1e-30)


def _relit(look: EigenBtf) -> Iterator[Float[Tensor, "H W 3"]]:
    """Yield what a BTF shows under random pairs of light and view, to 70 degrees."""
    rng = torch.Generator().manual_seed(0)
    uv = address.texel_centres(*look.texels)
    for angles in torch.rand(PAIRS, 4, generator=rng):
        wi, wo = (from_angles(1.22 * angles[k], 6.2832 * angles[k + 1]).expand(*uv.shape[:2], 3) for k in (0, 2))
        yield look.evaluate(uv, wi, wo)


def frame_cost(context: Context) -> Iterator[Row]:
    """The 12k knot at half coverage, plain and quilted."""
    timed = frames.knot()
    scene = frames.build(timed, context.report)
    look = scene.objects[0].material.btf
    assert isinstance(look, EigenBtf)
    laid = _laid(scene, _quilt(look, toroidal=True))
    camera = frames.camera_at(scene, timed, 0.5)
    kinds: tuple[tuple[str, Silhouette, bool], ...] = (
        ("btf", "none", False),
        ("filtered", "none", True),
        ("silhouette", "curved", True),
    )
    for name, silhouette, filtering in kinds:
        shown = {
            kind: speed.renderer(s, silhouette, shadows=False, filtering=filtering)
            for kind, s in (("plain", scene), ("quilted", laid))
        }
        calls: dict[str, Callable[[], object]] = {kind: partial(r.show, camera) for kind, r in shown.items()}
        timing = time_together(calls, n=9 if context.quick else 25, warm=3, settle=2)
        plain, own = timing["plain"], timing["quilted"]
        yield Row(
            id=f"synthesize.frame.{name}",
            what=f"frame of the 12k knot, 800 x 600, 50 % coverage, quilted over plain: silhouettes {silhouette}"
            + ", filtered" * filtering,
            value=round(own.cpu / plain.cpu, 3), unit="x", better="lower", goal=1.1, n=own.n,
            peer=f"plain {plain.wall:.2f} ms (CPU/cores {plain.cpu:.2f}), quilted {own.wall:.2f} ms ({own.cpu:.2f})",
        )  # fmt: skip
        if name == "btf":
            yield Row(
                id="synthesize.frame.rate", what="rate of that quilted frame", unit="frames/s", better="higher",
                value=round(1e3 / min(own.wall, own.cpu), 1), goal=30, n=own.n, peer="the paper's more than 30",
            )  # fmt: skip


def _laid(scene: Scene, quilting: QuiltingMap) -> Scene:
    """Return the scene with all its materials laid out by a map."""
    return replace(scene, objects=tuple(replace(o, material=quilted(o.material, quilting)) for o in scene.objects))


MEASUREMENTS = [
    Measurement("synthesize.quilting", times),
    Measurement("synthesize.search", search),
    Measurement("synthesize.seam_dp", seams_by_dp),
    Measurement("cut", graphcut.cuts),
    Measurement("tiles.time", wang.times),
    Measurement("tiles.looks", wang.looks),
    Measurement("tiles.relit", tile_seams),
    Measurement("synthesize.seams", seam_energy),
    Measurement("synthesize.frame", frame_cost),
    Measurement("surface.seams", surfaces.seams),
    Measurement("surface.redress", surfaces.re_dressing),
    Measurement("surface.frame", surfaces.frame_cost),
]
