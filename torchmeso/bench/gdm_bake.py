"""Rows of the suite `gdm` on bakes: every mesostructure of the project into the default table, 64 x 64 x 32 x 16 x 32.

Test: tests/bench/test_gdm_bake.py
"""

import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch

from torchmeso.bench.suite import Context, Row
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions

MOST_SECONDS = 120.0

DEFAULT = GdmOptions()


def bake(context: Context, options: GdmOptions = DEFAULT) -> Iterator[Row]:
    """Each mesostructure to a table on disk, its geometry included."""
    names = ("weave", "grass") if context.quick else generators.GENERATORS
    size = f"{options.texels} x {options.texels} x {options.layers}"
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "a.gdm.zarr"
            start, cpu = time.perf_counter(), time.process_time()
            meso = generators.GENERATORS[name]()
            bake_gdm.bake(meso, options, path, about={}, progress=partial(context.report, f"bench bake: {name}"))
            wall, used = time.perf_counter() - start, time.process_time() - cpu
            disk = sum(f.stat().st_size for f in path.rglob("*") if f.is_file())
        yield Row(
            id=f"bake.{name}",
            what=f"{name} to {size} voxels, {options.n_theta} x {options.n_phi} directions, on disk",
            value=round(min(wall, used / torch.get_num_threads()), 1), unit="s", better="lower", goal=MOST_SECONDS, n=1,
            peer=f"wall {wall:.1f} s, CPU {used:.1f} s; {disk / 1e6:.1f} MB",
        )  # fmt: skip
