import json

import pytest
import torch
from safetensors.torch import save_file

from torchmeso.data import store
from torchmeso.errors import FormatError


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


def test_another_job_does_not_resume_it(tmp_path):
    fill(tmp_path / "a.zarr", [0, 2])
    writer = store.open_blocks(tmp_path / "a.zarr", spec(), {"kind": "toy", "samples": 9})
    assert not any(writer.is_done(b) for b in range(4))


def test_finished_table_replaces_the_old_one(tmp_path):
    fill(tmp_path / "a.zarr", range(4)).finish()
    fill(tmp_path / "a.zarr", [1], {"run": 2}).finish()
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
