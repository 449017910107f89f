"""Rows of the suite `compress` from disk to disk: Table II of leung2007tileable, each fit a process of its own.

The BTF is a baked brick, 256 x 256 texels of it under 800 x 800, repeated with a gain of its own and noise for every
texel, as sRGB codes in a raw table (which is what pictures become), or as JPEG files. Before a fit the pages of its
files are given back to the system (fsync and POSIX_FADV_DONTNEED), and the disk's own time to read them is measured in
the same run.
"End to end" begins with the start of Python and ends with the model on disk.

Test: tests/bench/test_table2.py
"""

import json
import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int16, UInt8
from torch import Tensor

from torchmeso.bench.suite import Context, Row
from torchmeso.data import btf, image, picture_set, store
from torchmeso.geometry import gaps, hemisphere
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions

PAPER_SECONDS = {(128, 25): 613, (128, 36): 761, (256, 25): 1067, (256, 36): 1251, (800, 25): 10289}
"""leung2007tileable, Table II: side of the texture, view coefficients; 25 of the light; a Pentium IV of 3.2 GHz."""

MOST_BAKED = 256
"""Texels of the baked brick that is repeated; half of those of the table where that is less."""

ROOM = 1.7
"""Disk that a fit takes, over the raw bytes: the table, its journal, the model."""

CORES = os.cpu_count() or 1

CHILD = """
import atexit, json, re, runpy, sys
def tell():
    status, io = open("/proc/self/status").read(), open("/proc/self/io").read()
    found = {"peak": int(re.search(r"VmHWM:\\s*(\\d+)", status)[1]) << 10}
    found |= {name: int(re.search(rf"^{name}: (\\d+)", io, re.M)[1]) for name in ("rchar", "read_bytes")}
    json.dump(found, open(target, "w"))
target = sys.argv.pop(1)
atexit.register(tell)
runpy.run_module("torchmeso", run_name="__main__", alter_sys=True)
"""


class Run(NamedTuple):
    """What a process took: seconds, CPU seconds, bytes of memory at most, bytes asked for, of those from the disk."""

    wall: float
    cpu: float
    peak: int
    asked: int
    from_disk: int

    @property
    def best(self) -> float:
        """The better of wall time and CPU time over the cores, by which fits on shared machines are judged."""
        return min(self.wall, self.cpu / CORES)


def streamed(context: Context) -> Iterator[Row]:
    """Yield the six rows of Table II from a raw table on disk to a model on disk."""
    for size in (128, 256, 800):
        raw = 81 * 81 * size * size * 3
        why = "full run only" if context.quick and size == 800 else _no_room(ROOM * raw)
        if why is not None:
            for terms in (25, 36):
                yield _row(size, terms, None, why=why)
            continue
        with _scratch() as place:
            base = brick(size)
            table = Path(place) / "raw.btf.zarr"
            write_table(base, size, table, context)
            for terms in (25, 36):
                context.report(f"bench table2 {size} {terms}", 0)
                alone = drop_and_read(table)
                drop(table)
                out = Path(place) / f"{terms}.meso"
                run = compress(table, out, "--view-terms", terms)
                share = out.stat().st_size / raw
                out.unlink()
                paper = PAPER_SECONDS.get((size, terms))
                beside = "the paper's is not at hand" if paper is None else f"paper {paper} s, {paper / run.wall:.0f}x"
                yield _row(
                    size, terms, run.best, goal=120 if size == 800 else None,
                    peer=f"wall {run.wall:.1f} s, CPU/cores {run.cpu / CORES:.1f} s; {beside}; "
                    f"model {100 * share:.1f} % of {raw / 1e9:.2f} GB (paper {100 * 25 * terms / 6561:.1f} %); "
                    f"read {run.asked / 1e9:.2f} GB, {run.from_disk / 1e9:.2f} GB of it from the disk, "
                    f"which alone takes {alone:.1f} s",
                )  # fmt: skip
                yield Row(
                    id=f"compress.stream.{size}.{terms}.memory", what=f"largest resident memory of that fit, {size}^2",
                    value=round(run.peak / 1e9, 2), unit="GB", better="lower", goal=2.0,
                )  # fmt: skip


BUDGETS = {
    "transform": ("--method", "transform", "--psnr", 32),
    "eigen-adaptive": ("--method", "eigen", "--storage", "adaptive", "--psnr", 25),
    "double-sh": ("--method", "double-sh", "--size", "20MB"),
}
"""What is asked of each method: what a repeated brick with noise in every texel can be kept to."""


def budgets(context: Context) -> Iterator[Row]:
    """Yield time and memory of fits to an error, from a raw table on disk to a model on disk."""
    size = 128 if context.quick else 256
    raw = 81 * 81 * size * size * 3
    with _scratch() as place:
        table = Path(place) / "raw.btf.zarr"
        write_table(brick(size), size, table, context)
        for name, options in BUDGETS.items():
            context.report(f"bench budgets {size} {name}", 0)
            drop(table)
            out = Path(place) / "a.meso"
            run = compress(table, out, *options)
            share = raw / out.stat().st_size
            out.unlink()
            yield Row(
                id=f"compress.to_budget.{size}.{name}",
                what=f"{name} to {options[-2]} {options[-1]}, raw table of {size}^2 x 81 x 81 on disk to a model",
                value=round(run.best, 2), unit="s", better="lower",
                peer=f"wall {run.wall:.1f} s, CPU/cores {run.cpu / CORES:.1f} s; {share:.0f}:1 of {raw / 1e9:.2f} GB; "
                f"read {run.asked / 1e9:.2f} GB, {run.from_disk / 1e9:.2f} GB of it from the disk",
            )  # fmt: skip
            yield Row(
                id=f"compress.to_budget.{size}.{name}.memory",
                what=f"largest resident memory of that fit; the values take {4 * raw / 1e9:.2f} GB",
                value=round(run.peak / 1e9, 2), unit="GB", better="lower", goal=2.0,
            )  # fmt: skip


def pictures(context: Context) -> Iterator[Row]:
    """Yield the row of a folder of JPEG files: decoded once into a raw table, and fitted from there."""
    size = 128 if context.quick else 256
    with _scratch() as place:
        folder = Path(place) / "set"
        n_bytes = write_pictures(brick(size), size, folder)
        alone = drop_and_read(folder)
        drop(folder)
        run = compress(folder, Path(place) / "a.meso", cache=Path(place) / "cache")
    yield Row(
        id=f"compress.jpeg.{size}.25",
        what=f"double SH by CLS, a folder of 6,561 JPEG files of {size} x {size} to a model of 25 x 25, end to end",
        value=round(run.best, 2), unit="s", better="lower",
        peer=f"wall {run.wall:.1f} s, CPU/cores {run.cpu / CORES:.1f} s; {n_bytes / 1e6:.0f} MB of files, "
        f"which the disk alone reads in {alone:.1f} s; {run.peak / 1e9:.2f} GB resident",
    )  # fmt: skip


def _row(
    size: int,
    terms: int,
    seconds: float | None,
    *,
    goal: float | None = None,
    peer: str | None = None,
    why: str | None = None,
) -> Row:
    return Row(
        id=f"compress.stream.{size}.{terms}",
        what=f"double SH by CLS, raw table of {size} x {size} x 81 x 81 on disk to a model of {terms} x 25, end to end",
        value=None if seconds is None else round(seconds, 2), unit="s", better="lower", goal=goal, peer=peer, why=why,
    )  # fmt: skip


def brick(size: int) -> Float[Tensor, "light view H W 3"]:
    """Return the baked brick that is repeated in a table of `size` texels, in half precision."""
    options = BtfOptions(texels=min(size // 2, MOST_BAKED), lights="ubo81", views="ubo81", samples=1, bounces=0)
    return bake_btf.in_memory(generators.brick(), options, torch.float16).pictures()


def codes_of(base: Tensor, size: int, view: int, noise: Tensor) -> UInt8[Tensor, "light H W 3"]:
    """Return the pictures of a view: the base repeated, times a gain of each texel, plus `noise` from any place on."""
    n_light, count = len(base), -(-size // base.shape[2])
    gain = (0.7 + 0.05 * noise[: size * size].float().abs().clamp(max=6)).reshape(size, size, 1) * 4095
    to_code = image.encode_codes(torch.arange(4096) / 4095).short()
    out = torch.empty(n_light, size, size, 3, dtype=torch.uint8)
    for light in range(n_light):
        linear = base[light, view].float().repeat(count, count, 1)[:size, :size] * gain
        code = to_code.index_select(0, linear.clamp_(0, 4095).int().flatten())
        first = (7919 * light + 104729 * view) % (len(noise) - len(code) + 1)
        out[light] = code.add_(noise[first : first + len(code)]).clamp_(0, 255).reshape(size, size, 3)
    return out


def noise_for(size: int) -> Int16[Tensor, "n"]:
    """Return enough normal numbers for the pictures to draw on, in steps of a code, the same every time."""
    return (2 * torch.randn(6 * size * size, generator=torch.Generator().manual_seed(3))).round().short()


def write_table(base: Tensor, size: int, path: Path, context: Context) -> None:
    """Write the raw table, laid out as tables of pictures are."""
    lights = hemisphere.ubo81()
    shape = (81, 81, size, size, 3)
    about = btf.table_attributes(lights, lights, 0.0, "srgb")
    writer = store.open_blocks(path, picture_set.specs(shape, "srgb"), about)
    noise = noise_for(size)
    for view in range(81):
        writer["images"][:, view] = codes_of(base, size, view, noise).numpy()
        context.report(f"bench table2: raw table of {size} x {size}", (view + 1) / 81)
    writer.finish()


def write_pictures(base: Tensor, size: int, folder: Path) -> int:
    """Write the pictures as JPEG files named as UBO2003 does; return their bytes."""
    from PIL import Image

    folder.mkdir()
    angles, noise, total = gaps.angles_deg(hemisphere.ubo81()), noise_for(size), 0
    for view, (theta_v, phi_v) in enumerate(angles):
        for light, picture in enumerate(codes_of(base, size, view, noise)):
            theta, phi = angles[light]
            place = folder / f"tl{theta:03.0f} pl{phi:03.0f} tv{theta_v:03.0f} pv{phi_v:03.0f}.jpg"
            Image.fromarray(picture.numpy()).save(place, quality=90)
            total += place.stat().st_size
    return total


def compress(source: Path, out: Path, *options: object, cache: Path | None = None) -> Run:
    """Run `torchmeso compress` in a process of its own."""
    told = out.with_suffix(".json")
    method = () if "--method" in options else ("--method", "double-sh")
    command = [sys.executable, "-c", CHILD, str(told), "compress", str(source), *method]
    environment = {**os.environ, **({} if cache is None else {"TORCHMESO_CACHE": str(cache)})}
    before, start = os.times(), time.perf_counter()
    subprocess.run([*command, "--out", str(out), *map(str, options)], check=True, capture_output=True, env=environment)
    wall, after = time.perf_counter() - start, os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    found = json.loads(told.read_text())
    return Run(wall, cpu, found["peak"], found["rchar"], found["read_bytes"])


def drop(path: Path) -> None:
    """Give the pages of the files in `path` back to the system."""
    for file in _files(path):
        handle = os.open(file, os.O_RDONLY)
        os.fsync(handle)
        os.posix_fadvise(handle, 0, 0, os.POSIX_FADV_DONTNEED)
        os.close(handle)


def drop_and_read(path: Path) -> float:
    """Return the seconds that reading all files takes, one after the other, from the disk."""
    drop(path)
    room = bytearray(8 << 20)
    start = time.perf_counter()
    for file in _files(path):
        with file.open("rb", buffering=0) as stream:
            while stream.readinto(room):
                pass
    return time.perf_counter() - start


def _files(path: Path) -> list[Path]:
    return sorted(p for p in path.rglob("*") if p.is_file())


def _scratch() -> tempfile.TemporaryDirectory:
    """Return a folder in the cache that is removed again."""
    store.cache_dir().mkdir(parents=True, exist_ok=True)
    return tempfile.TemporaryDirectory(prefix="table2-", dir=store.cache_dir())


def _no_room(needed: float) -> str | None:
    place = store.cache_dir()
    place.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(place).free
    return None if free > needed else f"needs {math.ceil(needed / 1e9)} GB of disk, {free / 1e9:.0f} GB are free"
