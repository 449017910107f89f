import threading

import pytest
import torch

from torchmeso.data import bands, btf, picture_set, store
from torchmeso.data.btf import Btf
from torchmeso.errors import FormatError, ShapeError, SizeError
from torchmeso.geometry import hemisphere

LIGHTS, VIEWS = hemisphere.grid(4, 2, 80), hemisphere.grid(3, 2, 75)


@pytest.fixture
def codes(rng):
    return torch.randint(0, 256, (8, 6, 37, 5, 3), dtype=torch.uint8, generator=rng)


def as_table(codes, path):
    """Write codes as tables of pictures are: chunks of all lights and 16 rows."""
    attributes = btf.table_attributes(LIGHTS, VIEWS, 0.0, "srgb")
    writer = store.open_blocks(path, picture_set.specs(tuple(codes.shape), "srgb"), attributes)
    writer["images"][:] = codes.numpy()
    writer.finish()
    return btf.load(path)


def collected(table, room):
    found = [(b.rows, b.stored.clone()) for b in bands.ahead(table, bands.layout(table, room))]
    assert [rows.start for rows, _ in found] == [0, *(rows.stop for rows, _ in found)][:-1]
    return torch.cat([stored for _, stored in found], 2)


@pytest.mark.parametrize("room", [1, 2000, 16 * 720, 33 * 720, 1 << 30])
def test_bands_hold_the_table_as_it_is_stored(room, codes, tmp_path):
    table = as_table(codes, tmp_path / "a.btf.zarr")
    assert torch.equal(collected(table, room), codes)
    assert torch.equal(collected(Btf(images=codes, lights=LIGHTS, views=VIEWS, encoding="srgb"), room), codes)


def test_bands_are_whole_rows_of_chunks_unless_memory_forces(codes, tmp_path):
    table = as_table(codes, tmp_path / "a.btf.zarr")
    row = 8 * 6 * 5 * 3
    heights = {room: bands.layout(table, room * row)[0].stop for room in (1, 7, 8, 15, 16, 31, 32, 100)}
    assert heights == {1: 1, 7: 7, 8: 16, 15: 16, 16: 16, 31: 16, 32: 32, 100: 37}


def chunks_read(table, monkeypatch, room):
    """Return how many bytes of chunks zarr fetches for a pass."""
    from zarr.storage import LocalStore

    sizes = []
    get = LocalStore.get

    async def counted(self, key, *arguments, **named):
        found = await get(self, key, *arguments, **named)
        sizes.append(0 if found is None else len(found))
        return found

    monkeypatch.setattr(LocalStore, "get", counted)
    for _ in bands.ahead(table, bands.layout(table, room)):
        pass
    return sum(sizes)


def test_no_chunk_is_read_twice_and_none_that_was_not_asked_for(codes, tmp_path, monkeypatch):
    table = as_table(codes, tmp_path / "a.btf.zarr")
    once = chunks_read(table, monkeypatch, 1 << 30)
    size = sum(p.stat().st_size for p in (tmp_path / "a.btf.zarr").rglob("c/**/*") if p.is_file())
    assert once <= 1.1 * size
    in_three = chunks_read(table, monkeypatch, 16 * 720)
    assert in_three <= once + 3 * 6 * 100  # the index of each shard again
    in_rows = chunks_read(table, monkeypatch, 1)
    assert in_rows > 10 * once


def test_only_the_rows_and_views_asked_for_are_read(codes, tmp_path, monkeypatch):
    from zarr.storage import LocalStore

    table = as_table(codes, tmp_path / "a.btf.zarr")
    sizes = []
    get = LocalStore.get

    async def counted(self, key, *arguments, **named):
        found = await get(self, key, *arguments, **named)
        sizes.append(0 if found is None else len(found))
        return found

    monkeypatch.setattr(LocalStore, "get", counted)
    table.rows(32, 37)
    assert sum(sizes) < 1.1 * 5 / 37 * codes.numel() + 6 * 200
    sizes.clear()
    table.seen_from(2)
    assert sum(sizes) < 1.1 * codes.numel() / 6 + 200


def test_rows_become_linear_one_at_a_time(codes, tmp_path):
    table = as_table(codes, tmp_path / "a.btf.zarr")
    found = [row for band in bands.ahead(table, bands.layout(table, 2000)) for row in bands.each_row(table, band)]
    assert torch.equal(torch.stack(found, 2), table.pictures())


def test_the_next_band_is_read_while_this_one_is_worked_on(codes, tmp_path, monkeypatch):
    table = as_table(codes, tmp_path / "a.btf.zarr")
    begun = [threading.Event() for _ in range(3)]
    stored_rows = Btf.stored_rows

    def noticed(self, start, stop, room=None):
        begun[start // 16].set()
        return stored_rows(self, start, stop, room)

    monkeypatch.setattr(Btf, "stored_rows", noticed)
    reading = bands.ahead(table, bands.layout(table, 16 * 720))
    next(reading)
    assert begun[1].wait(10)
    assert not begun[2].is_set()
    reading.close()
    assert not [t for t in threading.enumerate() if t.name.startswith("ThreadPoolExecutor") and t.is_alive()]


def test_nothing_is_read_where_nothing_is_wanted(codes, tmp_path):
    assert list(bands.ahead(as_table(codes, tmp_path / "a.btf.zarr"), [])) == []


@pytest.mark.errors
def test_damage_is_told_by_the_one_who_asks(codes, tmp_path, monkeypatch):
    table = as_table(codes, tmp_path / "a.btf.zarr")
    for path in (tmp_path / "a.btf.zarr").rglob("c/**/0"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(FormatError, match="cannot be read"):
        collected(table, 1 << 30)
    bad = Btf(images=torch.full((8, 6, 4, 5, 3), torch.nan), lights=LIGHTS, views=VIEWS)
    with pytest.raises(ShapeError, match="got nan at light 0, view 0, row 0"):
        next(bands.each_row(bad, next(bands.ahead(bad, bands.layout(bad)))))
    monkeypatch.setattr(bands, "LIMIT", 100)
    with pytest.raises(SizeError, match="a row of texels: needs"):
        bands.layout(bad)
