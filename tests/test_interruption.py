"""What a long command leaves when it is stopped, killed, or meets a full disk, and that the next run goes on."""

import os
import resource
import signal as signals
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from tests.pipeline.small import CONTENT
from torchmeso.cli import main
from torchmeso.data import btf, mdf, sh_btf, store
from torchmeso.geometry import hemisphere

GRID = "grid(4, 2, 80)"


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with a configuration, and a cache of its own."""
    monkeypatch.setenv("TORCHMESO_CACHE", str(tmp_path / "cache"))
    content = {**CONTENT, "materials": {k: v for k, v in CONTENT["materials"].items() if k != "unused"}}
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(content))
    slow = {"meso": {"type": "brick"}, "btf": {"texels": 64}, "mdf": {"texels": 64}}
    (tmp_path / "slow.yaml").write_text(
        yaml.safe_dump({**content, "materials": {**content["materials"], "brick": slow}})
    )
    return tmp_path


def start(place, *arguments, limit=None, after="pass") -> subprocess.Popen:
    """Run the command line in `place` `after` a statement; no file may grow beyond `limit` bytes: a full disk."""

    def confine():
        signals.signal(signals.SIGINT, signals.SIG_DFL)  # what runs in the background of a shell is born deaf to it
        if limit:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    code = f"{after}; import runpy; runpy.run_module('torchmeso', run_name='__main__', alter_sys=True)"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    return subprocess.Popen(
        command, cwd=place, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=confine,
    )  # fmt: skip


def finish(place, *arguments, **options) -> tuple[int, str]:
    process = start(place, *arguments, **options)
    _, said = process.communicate(timeout=900)
    return process.returncode, said


def wait_for(condition) -> None:
    for _ in range(6000):
        if condition():
            return
        time.sleep(0.02)
    pytest.fail("it never came to that")


def left(place, *known) -> list[str]:
    """Return what lies in `place` beside the configurations, the cache and `known`, and is no `.part`."""
    names = {"small.yaml", "slow.yaml", "cache", *known}
    return sorted(p.name for p in place.iterdir() if p.name not in names and ".part" not in p.name)


def half_written(place) -> list[Path]:
    """Return what is neither whole nor a `.part`: hidden files, and empty ones outside of a part."""
    outside = [p for p in place.rglob("*") if p.is_file() and ".part" not in str(p.relative_to(place))]
    return [p for p in outside if p.name.startswith(".") or p.stat().st_size == 0]


BAKE = ("bake", "--meso", "brick", "--out", "a.mdf.zarr", "--texels", 24)


@pytest.mark.parametrize("signal", [2, pytest.param(9, marks=pytest.mark.slow)])
def test_a_bake_that_was_stopped_or_killed_goes_on(signal, place):
    process = start(place, *BAKE)
    done = place / "a.mdf.zarr.part" / "done"
    wait_for(lambda: done.is_dir() and len(list(done.iterdir())) >= 2)
    process.send_signal(signal)
    _, said = process.communicate(timeout=60)
    assert process.returncode == (130 if signal == 2 else -9)
    if signal == 2:
        assert said.strip().splitlines()[-1].endswith("bake: stopped; run it again to go on")
        assert "Traceback" not in said
    assert left(place) == []
    assert finish(place, *BAKE)[0] == 0
    assert mdf.load(place / "a.mdf.zarr").texels == (24, 24)
    assert not list(place.glob("*.part"))


def test_a_bake_on_a_full_disk_is_one_sentence_and_goes_on(place):
    status, said = finish(place, *BAKE, limit=600)
    assert status == 2
    assert "a.mdf.zarr: could not be written (File too large); make room or choose another place" in said
    assert "Traceback" not in said
    assert left(place) == []
    assert finish(place, *BAKE)[0] == 0


@pytest.mark.slow
@pytest.mark.parametrize("out", ["a.png", "a.exr", "a.gif", "a.mp4"])
def test_a_picture_on_a_full_disk(out, place):
    frames = ("--frames", 2) if out.endswith(("gif", "mp4")) else ()
    assert finish(place, "render", "small.yaml", "--backend", "torch", "--out", "warm.png")[0] == 0
    status, said = finish(place, "render", "small.yaml", "--backend", "torch", "--out", out, *frames, limit=400)
    assert status == 2, said
    assert f"{f'{out}.part/a_0001.png' if frames else out}: could not be written" in said
    assert "Traceback" not in said
    assert left(place, "warm.png") == []
    # Pictures of a film are kept one by one until it is whole, and wait for another try.
    assert [p.name for p in place.iterdir() if ".part" in p.name] == ([f"{out}.part"] if frames else [])


@pytest.mark.slow
@pytest.mark.parametrize("signal", [2, 9])
@pytest.mark.parametrize(
    "command",
    [("render", "slow.yaml", "--out", "a.png"), ("render", "slow.yaml", "--truth", "--out", "a.exr"),
     ("render", "slow.yaml", "--frames", 400, "--out", "a.png"),
     ("render", "slow.yaml", "--frames", 400, "--out", "a.gif"),
     ("render", "slow.yaml", "--frames", 400, "--out", "a.mp4"), ("demo", "--out", "made"),
     ("bake", "slow.yaml", "--out", "tables"), ("bench", "skip", "--quick", "--json", "a.json")],
    ids=lambda c: "_".join(map(str, c)).replace("/", ""),
)  # fmt: skip
def test_every_long_command_leaves_nothing_half_written(command, signal, place):
    """Stopped at several moments: while Python starts, while it bakes, and while it draws."""
    for seconds in (3.0, 6.0, 12.0, 24.0):
        process = start(place, *command)
        try:
            process.wait(timeout=seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal)
        _, said = process.communicate(timeout=120)
        if process.returncode == 0:
            break
        unheard = signal == 2 and process.returncode == -2 and not said  # on a busy machine Python had not begun yet
        assert unheard or process.returncode == (130 if signal == 2 else -9), said
        assert "Traceback" not in said
        assert half_written(place) == []
        if (place / command[-1]).is_file():  # stopped between the end of its work and its own
            break
    whole = ("render", "slow.yaml", "--out", "b.png")
    assert finish(place, *whole)[0] == 0


def test_a_sequence_that_was_killed_goes_on(place):
    assert finish(place, "render", "small.yaml", "--out", "warm.png")[0] == 0
    command = ("render", "small.yaml", "--frames", 2000, "--out", "a.png")
    process = start(place, *command)
    part = place / "a.png.part"
    wait_for(lambda: len(list(part.glob("a_????.png"))) >= 3)
    process.kill()
    process.communicate(timeout=60)
    assert left(place, "warm.png") == []
    made = {p.name: p.stat().st_mtime_ns for p in part.glob("a_????.png")}
    assert len(made) >= 3
    process = start(place, *command)
    wait_for(lambda: len(list(part.glob("a_????.png"))) >= len(made) + 3)
    process.send_signal(2)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130, said
    assert {n: (part / n).stat().st_mtime_ns for n in made} == made


ROW_BY_ROW = "from torchmeso.data import bands; bands.ROOM = 1"


@pytest.fixture
def table(place):
    """A raw table of 40 rows of texels that is fitted a row at a time, and how."""
    lights, views = hemisphere.grid(6, 3, 80), hemisphere.grid(5, 3, 80)
    shape = (18, 15, 40, 8, 3)
    writer = store.open_blocks(
        place / "cache" / "a.btf.zarr", btf.specs(shape, "uint8", chunk=(18, 1, 1, 8, 3)),
        btf.table_attributes(lights, views, 0.0, "srgb"),
    )  # fmt: skip
    writer["images"][:] = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    writer.finish()
    options = ("--method", "double-sh", "--light-terms", 4, "--view-terms", 4)
    return ("compress", place / "cache" / "a.btf.zarr", *options, "--out")


@pytest.mark.parametrize("signal", [2, pytest.param(9, marks=pytest.mark.slow)])
def test_a_fit_that_was_stopped_or_killed_goes_on(signal, table, place):
    """The bands it kept are not fitted again, and the model is the one of a fit in one go."""
    slow = f"{ROW_BY_ROW}; import time; from torchmeso.data.journal import Journal as J; w = J.write; "
    slow += "J.write = lambda *a: (w(*a), time.sleep(0.2))[0]"
    process = start(place, *table, "a.meso", after=slow)
    kept = place / "a.meso.part"
    wait_for(lambda: len(list(kept.glob("c.*[0-9]"))) >= 4)
    process.send_signal(signal)
    _, said = process.communicate(timeout=60)
    assert process.returncode == (130 if signal == 2 else -9)
    assert "Traceback" not in said
    assert left(place) == []
    made = [p.name for p in kept.glob("c.*[0-9]")]
    assert 4 <= len(made) < 40
    strict = f"{ROW_BY_ROW}; from torchmeso.data.journal import Journal as J; w = J.write; "
    strict += f"J.write = lambda j, n, v: w(j, n, v) if n not in {made} else 1 / 0"
    assert finish(place, *table, "a.meso", after=strict)[0] == 0
    assert not list(place.glob("*.part"))
    main([*map(str, table), str(place / "b.meso")], standalone_mode=False)  # in one band
    a, b = sh_btf.load(place / "a.meso"), sh_btf.load(place / "b.meso")
    assert torch.equal(a.maps, b.maps)
    assert torch.equal(a.scale, b.scale)


@pytest.mark.slow
@pytest.mark.parametrize("limit", [300, 1000, 12000])
def test_a_fit_on_a_full_disk_is_one_sentence_and_goes_on(limit, table, place):
    """The disk is full in the journal, and in the model; kernels would not even build there."""
    on_torch = f"{ROW_BY_ROW}; from torchmeso.backends import opencl; opencl.resolve = lambda backend: 'torch'"
    status, said = finish(place, *table, "a.meso", limit=limit, after=on_torch)
    assert status == 2, said
    assert "a.meso: could not be written (File too large); make room or choose another place" in said
    assert "Traceback" not in said
    assert left(place) == []
    assert finish(place, *table, "a.meso", after=on_torch)[0] == 0
    assert left(place, "a.meso") == []
