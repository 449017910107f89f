"""Wang tiles of the suite `synthesize`: time beside leung2007tileable's, what seams show, and how much planes repeat.

Times are those of Table III's rows, on coefficients made up of smooth noise, for time does not depend on what they
hold; exemplars have the table's sizes. Borders and repetition are those of the pictures of the folder of real inputs.

Test: tests/bench/test_wang.py
"""

import os
import time
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.bench.suite import Context, Row
from torchmeso.config import data_dir
from torchmeso.data import image
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.data.sh_btf import ShBtf
from torchmeso.data.tile_set import TileSet
from torchmeso.geometry import hemisphere
from torchmeso.synthesize import patch_error, tiling, wang
from torchmeso.synthesize.patch_error import Look
from torchmeso.synthesize.wang import Kind, WangOptions

PLANE = 16
"""Tiles along a side of the planes that are looked at."""

SIDE = 64
"""Texels along a side of these tiles."""

FIELDS = 12
"""Pictures of noise that made-up coefficients are mixed from."""

TABLE = (
    ("wrinkles", 64, 128, 5, 10, "15 min, 76.92 %"),
    ("holes", 100, 128, 5, 25, "25 min, 34.86 %"),
    ("impalla", 256, 256, 5, 120, "51 min, 49.92 %"),
)
"""Rows of Table III: name, side of a tile, of the exemplar, degree of both harmonics, goal in seconds, the paper's."""


def made_up(size: int, degree: int) -> ShBtf:
    """Return a double-SH BTF of smooth noise, degree^2 x degree^2 x 3 coefficients of 8 bits per texel."""
    rng = torch.Generator().manual_seed(0)
    fields = torch.randn(FIELDS, 1, size, size, generator=rng)
    for _ in range(2):
        fields = torch.nn.functional.avg_pool2d(torch.nn.functional.pad(fields, (2, 2, 2, 2), mode="circular"), 5, 1)
    fields = fields[:, 0] / fields.std()
    terms = degree**2
    fall = 1 / (1 + torch.arange(terms).sqrt().floor())
    mix = torch.randn(terms, terms, 3, FIELDS, generator=rng) / FIELDS**0.5
    maps = torch.stack(
        [(torch.einsum("jck,khw->jhwc", part, fields) * 32 + 128).round().clamp(0, 255).to(torch.uint8) for part in mix]
    )
    scale = (fall[:, None] * fall).unsqueeze(-1).expand(-1, -1, 3).contiguous()
    directions = hemisphere.ubo81()
    return ShBtf(maps=maps, scale=scale, offset=-0.5 * scale, lights=directions, views=directions)


def times(context: Context) -> Iterator[Row]:
    """Sets of 96 tiles, from coefficients to tiles."""
    for name, side, size, degree, goal, paper in TABLE:
        row = {"id": f"tiles.time.{name}", "unit": "s", "better": "lower", "goal": goal}
        what = (
            f"96 tiles of {side} x {side} texels from {size} x {size}, {degree**2} x {degree**2} x 3 coefficients of "
            "noise, channels and all: the better of wall and CPU time over cores"
        )
        if context.quick and side > 64:
            yield Row(**row, what=what, value=None, why="full run only")
            continue
        look = made_up(size, degree)
        context.report(f"tiles of {side}", 0)
        start, before = time.perf_counter(), time.process_time()
        source = patch_error.exemplar(look)
        first = time.perf_counter() - start
        found = wang.grow(
            source, WangOptions(size=side, kind="any"), rng=torch.Generator().manual_seed(0), backend="auto",
            progress=lambda share, side=side: context.report(f"tiles of {side}", share),
        )  # fmt: skip
        wall, cpu = time.perf_counter() - start, (time.process_time() - before) / (os.cpu_count() or 1)
        yield Row(
            **row, what=what, value=round(min(wall, cpu), 2),
            peer=f"wall {wall:.1f} s (channels {first:.1f} s), CPU/cores {cpu:.1f} s; {source.codes.shape[2]} channels "
            f"keep {100 * source.kept:.1f} %, {found.set.share:.1%} of the texels referenced; paper {paper}",
        )  # fmt: skip
    yield Row(
        id="tiles.time.floortile", what="96 tiles of 128 x 128 texels from 800 x 800, 16 x 16 x 3 coefficients",
        value=None, unit="s", better="lower", goal=45,
        why="not measured: each search transforms the whole exemplar, about 0.3 s at this size",
    )  # fmt: skip


def grown(look: Look, kind: Kind, *, toroidal: bool = False) -> TileSet:
    """Return tiles of 64 x 64 texels."""
    options = WangOptions(size=SIDE, kind=kind, toroidal=toroidal)
    rng = torch.Generator().manual_seed(0)
    return wang.grow(patch_error.exemplar(look), options, rng=rng, backend="auto").set


def border_ratio(picture: Float[Tensor, "H W C"], laid: QuiltingMap, side: int, *, wraps: bool) -> float:
    """Return the 99th percentile of squared differences across borders of tiles over the exemplar's own."""
    shown = laid.apply(picture)
    across = [
        (shown.roll(-1, axis) - shown).square().sum(-1).movedim(axis, 0)[side - 1 :: side].flatten() for axis in (0, 1)
    ]
    last = 0 if wraps else -1
    inside = [
        (picture.roll(-1, axis) - picture).square().sum(-1).narrow(axis, 0, picture.shape[axis] + last).flatten()
        for axis in (1, 0)
    ]
    own, theirs = (float(np.percentile(torch.cat(x).double().numpy(), 99)) for x in (across, inside))
    return own / max(theirs, 1e-30)


def repetition(picture: Float[Tensor, "H W C"], side: int) -> float:
    """Return the largest autocorrelation of a plane at a whole number of tiles; plain repetition's is 1."""
    x = (picture - picture.mean((0, 1))).double()
    power = torch.fft.rfft2(x.movedim(-1, 0)).abs().square().sum(0)
    c = torch.fft.irfft2(power, s=picture.shape[:2])[::side, ::side]
    c = c / c[0, 0].clamp(min=1e-30)
    c[0, 0] = -1
    return float(c.max())


def pictures() -> Iterator[tuple[str, Float[Tensor, "H W 3"]]]:
    """Yield the exemplars of the folder of real inputs, sRGB."""
    for path in sorted((data_dir() / "texture").glob("t*.png")):
        yield path.stem, image.to_srgb(image.read(path))


def looks(context: Context) -> Iterator[Row]:
    """What borders of tiles show, and how much planes of them repeat, of pictures."""
    borders, repeats, more = [], [], []
    for name, look in pictures():
        tiles = grown(look, "edges")
        laid = tiles.lay(tiling.plane(tiles, PLANE, PLANE), tileable=True)
        borders.append((border_ratio(look, laid, SIDE, wraps=False), name))
        repeats.append((repetition(laid.apply(look), SIDE), name))
        if not context.quick:
            tiles = grown(look, "any")
            laid = tiles.lay(tiling.scanlines(tiles, PLANE, PLANE, rng=torch.Generator().manual_seed(0)))
            more.append((repetition(laid.apply(look), SIDE), name))
    for found, row in (
        (borders, {
            "id": "tiles.looks.borders", "goal": 1.0,
            "what": "16 tiles of the quilting exemplars, sRGB: 99th percentile of squared differences across borders "
            f"of a plane of {PLANE} x {PLANE} over the exemplar's own, in the middle of the pictures",
        }),
        (repeats, {
            "id": "tiles.looks.repetition.two_colours", "goal": 0.2,
            "what": "largest autocorrelation of these planes at a whole number of tiles, over plain repetition's, in "
            "the middle of the pictures",
        }),
        (more, {"id": "tiles.looks.repetition.any", "goal": 0.2, "what": "the same of sets of 96 tiles, in scanlines"}),
    ):  # fmt: skip
        found.sort()
        why = "full run only" if context.quick else "the folder of real inputs is absent: set TORCHMESO_DATA"
        yield Row(
            **row, value=round(found[len(found) // 2][0], 3) if found else None, unit="x", better="lower",
            spread=(round(found[0][0], 3), round(found[-1][0], 3)) if found else None, n=max(len(found), 1),
            peer="; ".join(f"{name} {ratio:.2f}" for ratio, name in found) or None, why=None if found else why,
        )  # fmt: skip
