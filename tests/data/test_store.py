import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors import SafetensorError
from safetensors.torch import save_file

from torchmeso.data import store
from torchmeso.errors import FormatError, StorageError


def spec(dtype="float32"):
    return {"x": store.ArraySpec(shape=(4, 8), dtype=dtype, chunks=(1, 4), shards=(1, 8), axes=("view", "W"))}


def fill(path, blocks, about=None):
    writer = store.open_blocks(path, spec(), {"kind": "toy", **(about or {})})
    for block in blocks:
        writer["x"][block] = torch.full((8,), float(block)).numpy()
        writer.mark_done(block)
    return writer


def test_table_round_trip(tmp_path):
    fill(tmp_path / "a.zarr", range(4)).finish()
    group = store.open_table(tmp_path / "a.zarr", "toy")
    assert store.read_array(group, "x")[:, 0].tolist() == [0, 1, 2, 3]
    assert store.read_array(group, "x", (2, slice(0, 3))).tolist() == [2, 2, 2]
    assert [p.name for p in tmp_path.iterdir()] == ["a.zarr"]


def test_interrupted_table_goes_on_where_it_stopped(tmp_path):
    fill(tmp_path / "a.zarr", [0, 2])
    assert not (tmp_path / "a.zarr").exists()
    writer = store.open_blocks(tmp_path / "a.zarr", spec(), {"kind": "toy"})
    assert [writer.is_done(b) for b in range(4)] == [True, False, True, False]
    assert writer["x"][2, 0] == 2


def test_black_blocks_are_written_too(tmp_path):
    """Zarr leaves blocks of zeros out, and reads what is missing as zeros: the two could not be told apart."""
    writer = store.open_blocks(tmp_path / "a.zarr", spec(), {"kind": "toy"})
    for block in range(4):
        writer["x"][block] = torch.zeros(8).numpy()
    writer.finish()
    assert len([p for p in (tmp_path / "a.zarr/x/c").rglob("*") if p.is_file()]) == 4
    assert not store.read_array(store.open_table(tmp_path / "a.zarr", "toy"), "x").any()


@pytest.mark.errors
def test_a_missing_block_is_named(tmp_path):
    fill(tmp_path / "a.zarr", range(4)).finish()
    (tmp_path / "a.zarr/x/c/2/0").unlink()
    with pytest.raises(FormatError, match=r"a\.zarr: block 2/0 of 'x' is missing, 3 of 4 are there; the copy is"):
        store.open_table(tmp_path / "a.zarr", "toy")
    about = tmp_path / "a.zarr/x/zarr.json"  # as a damaged copy may say: nothing is made of that size
    about.write_text(about.read_text().replace('"shape": [\n    4,', '"shape": [\n    4000000000000000,'))
    with pytest.raises(FormatError, match="is missing, 3 of 4000000000000000 are there"):
        store.open_table(tmp_path / "a.zarr", "toy")


def test_tables_that_do_not_say_that_all_blocks_are_there_may_lack_some(tmp_path):
    """Tables by others, and from before blocks of zeros were written."""
    fill(tmp_path / "a.zarr", range(4)).finish()
    (tmp_path / "a.zarr/x/c/2/0").unlink()
    about = tmp_path / "a.zarr/zarr.json"
    about.write_text(about.read_text().replace('"blocks": "all"', '"blocks": "some"'))
    assert store.read_array(store.open_table(tmp_path / "a.zarr", "toy"), "x")[:, 0].tolist() == [0, 1, 0, 3]


def test_another_job_does_not_resume_it(tmp_path):
    fill(tmp_path / "a.zarr", [0, 2])
    writer = store.open_blocks(tmp_path / "a.zarr", spec(), {"kind": "toy", "samples": 9})
    assert not any(writer.is_done(b) for b in range(4))


def test_finished_table_replaces_the_old_one(tmp_path):
    fill(tmp_path / "a.zarr", range(4)).finish()
    fill(tmp_path / "a.zarr", range(4), {"run": 2}).finish()
    assert store.open_table(tmp_path / "a.zarr", "toy").attrs["run"] == 2
    assert [p.name for p in tmp_path.iterdir()] == ["a.zarr"]


def test_model_round_trip_reads_single_tensors(tmp_path):
    store.write_model(tmp_path / "m.meso", {"a": torch.arange(3), "b": torch.ones(2, 2)}, {"kind": "toy"})
    model = store.Model(tmp_path / "m.meso")
    assert model.names() == ["a", "b"]
    assert model.meta["kind"] == "toy"
    assert model.read("a").tolist() == [0, 1, 2]


def test_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "out.txt"
    path.write_text("old")

    def fail():
        with store.replacing(path) as beside:
            beside.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_hash_does_not_depend_on_key_order():
    assert store.content_hash({"a": 1, "b": 2}) == store.content_hash({"b": 2, "a": 1})
    assert store.content_hash({"a": 1}) != store.content_hash({"a": 2})


def test_cache_dir_can_be_moved(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHMESO_CACHE", str(tmp_path))
    assert store.cache_dir() == tmp_path


@pytest.mark.errors
def test_missing_and_foreign_tables_say_so(tmp_path):
    with pytest.raises(FormatError, match=r"no\.zarr: expected a toy table, found none; bake it first"):
        store.open_table(tmp_path / "no.zarr", "toy")
    fill(tmp_path / "a.zarr", [0])
    with pytest.raises(FormatError, match="an unfinished bake lies beside it"):
        store.open_table(tmp_path / "a.zarr", "toy")
    (tmp_path / "empty.zarr").mkdir()
    with pytest.raises(FormatError, match="expected a Zarr group"):
        store.open_table(tmp_path / "empty.zarr", "toy")
    fill(tmp_path / "b.zarr", range(4)).finish()
    with pytest.raises(FormatError, match="expected a mdf table, got 'toy'"):
        store.open_table(tmp_path / "b.zarr", "mdf")
    fill(tmp_path / "c.zarr", range(4)).finish()
    meta = tmp_path / "c.zarr" / "zarr.json"
    meta.write_text(meta.read_text().replace('"format": 1', '"format": 9'))
    with pytest.raises(FormatError, match="written by a newer torchmeso"):
        store.open_table(tmp_path / "c.zarr", "toy")


@pytest.mark.errors
def test_damaged_chunks_are_reported(tmp_path):
    fill(tmp_path / "a.zarr", range(4)).finish()
    for chunk in (tmp_path / "a.zarr" / "x" / "c").rglob("*"):
        if chunk.is_file():
            chunk.write_bytes(chunk.read_bytes()[:7])
    with pytest.raises(FormatError, match="'x' cannot be read"):
        store.read_array(store.open_table(tmp_path / "a.zarr", "toy"), "x")


@pytest.mark.errors
def test_no_damage_to_a_chunk_is_decoded(tmp_path):
    """Blosc itself believes what a chunk says: other values would come out, or it would read far behind its end."""
    fill(tmp_path / "a.zarr", range(4)).finish()
    chunk = tmp_path / "a.zarr/x/c/2/0"
    whole = chunk.read_bytes()
    assert torch.frombuffer(bytearray(whole), dtype=torch.uint8)[:2].tolist() == [2, 1]  # Blosc's versions come first
    for at in range(24):
        chunk.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        with pytest.raises(FormatError, match="'x' cannot be read"):
            store.read_array(store.open_table(tmp_path / "a.zarr", "toy"), "x")


@pytest.mark.errors
def test_missing_and_foreign_models_say_so(tmp_path):
    with pytest.raises(FormatError, match="expected a run-time model"):
        store.Model(tmp_path / "no.meso")
    (tmp_path / "junk.meso").write_bytes(b"junk")
    with pytest.raises(FormatError, match="expected a safetensors file"):
        store.Model(tmp_path / "junk.meso")
    save_file({"a": torch.ones(1)}, str(tmp_path / "foreign.meso"))
    with pytest.raises(FormatError, match="another safetensors file"):
        store.Model(tmp_path / "foreign.meso")
    save_file({"a": torch.ones(1)}, str(tmp_path / "new.meso"), {"torchmeso": json.dumps({"format": 9})})
    with pytest.raises(FormatError, match="newer torchmeso"):
        store.Model(tmp_path / "new.meso")
    store.write_model(tmp_path / "m.meso", {"a": torch.ones(1)}, {})
    with pytest.raises(FormatError, match="expected a tensor 'b', found none"):
        store.Model(tmp_path / "m.meso").read("b")


def test_a_run_killed_once_the_table_had_its_name_leaves_nothing_to_resume(tmp_path):
    """What is left then are marks of blocks without the table; they must not make an empty table of the next run."""
    fill(tmp_path / "a.zarr", range(4)).finish()
    fill(tmp_path / "b.zarr", range(4))
    part = tmp_path / "a.zarr.part"
    (tmp_path / "b.zarr.part").rename(part)
    os.rename(part / "table", tmp_path / "table")
    writer = store.open_blocks(tmp_path / "a.zarr", spec(), {"kind": "toy"})
    assert not any(writer.is_done(b) for b in range(4))


def test_a_run_killed_while_tables_changed_places(tmp_path):
    fill(tmp_path / "a.zarr", range(4)).finish()
    os.rename(tmp_path / "a.zarr", tmp_path / "a.zarr.old.part")
    fill(tmp_path / "a.zarr", range(4)).finish()
    assert [p.name for p in tmp_path.iterdir()] == ["a.zarr"]
    fill(tmp_path / "a.zarr.old.part" / "x", [])
    fill(tmp_path / "a.zarr", range(4)).finish()
    assert [p.name for p in tmp_path.iterdir()] == ["a.zarr"]


def test_chunks_that_a_killed_run_was_writing_are_not_kept(tmp_path):
    writer = fill(tmp_path / "a.zarr", range(4))
    (tmp_path / "a.zarr.part" / "table" / "x" / "0.abc.partial").write_bytes(b"half")
    writer.finish()
    assert not list((tmp_path / "a.zarr").rglob("*.partial"))


def test_what_a_killed_process_left_is_removed(tmp_path):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    for process in (gone.pid, os.getppid(), "word", 10**30):
        (tmp_path / f"out.{process}.part.txt").write_text("half")
    with store.replacing(tmp_path / "out.txt") as beside:
        beside.write_text("whole")
    left = {p.name for p in tmp_path.iterdir()}
    assert left == {"out.txt", *(f"out.{process}.part.txt" for process in (os.getppid(), "word", 10**30))}


def full(*_, **__):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.errors
def test_a_full_disk_is_one_sentence(tmp_path, monkeypatch):
    def write():
        with store.replacing(tmp_path / "a.txt") as beside:
            beside.write_text("half")
            full()

    with pytest.raises(StorageError, match=r"a\.txt: could not be written \(No space left on device\); make room"):
        write()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(StorageError, match=r"made/a\.txt"), store.writing("made/a.txt"), store.writing("b"):
        raise StorageError("made/a.txt: as it was said first")
    with pytest.raises(FileNotFoundError), store.writing("a"):  # no matter of writing
        Path("none").read_text()
    monkeypatch.setattr("zarr.storage._local._put", full)
    with pytest.raises(StorageError, match=r"a\.zarr: could not be written"):
        fill(tmp_path / "a.zarr", range(4))


@pytest.mark.errors
def test_a_place_that_cannot_be_written_to(tmp_path):
    (tmp_path / "file").write_text("no folder")
    for name in ("a.meso", "a.zarr"):
        with pytest.raises(StorageError, match="could not be written"):
            if name == "a.zarr":
                fill(tmp_path / "file" / name, range(4))
            else:
                store.write_model(tmp_path / "file" / name, {"a": torch.ones(1)}, {})


@pytest.mark.errors
def test_damage_is_named(tmp_path):
    def read(error):
        with store.reading("a.meso"):
            raise error

    with pytest.raises(FormatError, match=r"a\.meso: expected 'h' in the file, found none"):
        read(KeyError("h"))
    with pytest.raises(FormatError, match=r"a.meso: cannot be read \(TypeError: no number\)"):
        read(TypeError("no number"))
    with pytest.raises(StorageError, match="ours"):
        read(StorageError("ours"))
    save_file({"a": torch.ones(1)}, str(tmp_path / "bad.meso"), {"torchmeso": "{not json"})
    with pytest.raises(FormatError, match=r"bad.meso: cannot be read \(JSONDecodeError"):
        store.Model(tmp_path / "bad.meso")
    fill(tmp_path / "c.zarr", range(4)).finish()
    meta = tmp_path / "c.zarr" / "zarr.json"
    meta.write_text(meta.read_text().replace('"format": 1', '"format": "one"'))
    with pytest.raises(FormatError, match="expected a format number, got 'one'"):
        store.open_table(tmp_path / "c.zarr", "toy")


@pytest.mark.errors
def test_a_model_that_cannot_be_written(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise SafetensorError("No space left on device")

    monkeypatch.setattr("safetensors.torch.save_file", fail)
    with pytest.raises(StorageError, match=r"m\.meso: could not be written \(No space left on device\)"):
        store.write_model(tmp_path / "m.meso", {"a": torch.ones(1)}, {})
    assert not list(tmp_path.iterdir())
