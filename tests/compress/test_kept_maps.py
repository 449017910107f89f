import pytest
import torch

from torchmeso.compress import kept_maps
from torchmeso.compress.kept_maps import KeptCodes, KeptMaps
from torchmeso.data import journal
from torchmeso.data.btf import Btf
from torchmeso.data.journal import InMemory
from torchmeso.geometry import hemisphere

LAYOUT = slice(0, 2), slice(2, 5), slice(5, 6)


@pytest.fixture(params=["memory", "journal"])
def parts(request, tmp_path):
    if request.param == "memory":
        yield InMemory()
        return
    with journal.beside(tmp_path / "a.meso", "job") as kept:
        yield kept


@pytest.mark.parametrize("room", [1, 2 * 5 * 3 * 8 * 4, 1 << 20], ids=["rows", "pairs of rows", "bands"])
def test_maps_come_back_one_by_one_and_row_by_row(room, parts, rng, monkeypatch):
    monkeypatch.setattr(kept_maps, "ROOM", room)
    maps = torch.rand(5, 3, 6, 2, 4, generator=rng)
    kept = KeptMaps(parts=parts, name="m", layout=LAYOUT, count=5, before=(3,), after=(2, 4), dtype=torch.float32)
    assert kept.todo() == list(LAYOUT)
    told = []
    kept.keep(((rows, maps[:, :, rows]) for rows in LAYOUT[:2]), told.append)
    assert kept.todo() == [LAYOUT[2]]
    kept.keep([(LAYOUT[2], maps[:, :, LAYOUT[2]])])
    assert told == [2 / 6, 5 / 6]
    assert torch.equal(kept.collected(1, 3), maps[1:4])
    assert torch.equal(kept.row(3), maps[:, :, 3])
    kept.drop()
    assert kept.todo() == list(LAYOUT)


@pytest.mark.parametrize("room", [1, 2 * 6 * 4, 1 << 20], ids=["rows", "pairs of rows", "bands"])
def test_rows_are_computed_where_they_are_missing(room, parts, rng, monkeypatch):
    monkeypatch.setattr(kept_maps, "ROOM", room)
    images = torch.rand(3, 4, 6, 2, 3, generator=rng)
    images[:, :, 1] = 0
    btf = Btf(images=images, lights=hemisphere.grid(3, 1, 40), views=hemisphere.grid(4, 1, 40))
    kept = KeptMaps(parts=parts, name="m", layout=LAYOUT, count=3, before=(), after=(2,), dtype=torch.float32)
    rows = []

    def light_sums(samples):
        rows.append(1)
        if len(rows) == 3:
            raise KeyboardInterrupt
        return samples.sum((1, 3))

    with pytest.raises(KeyboardInterrupt):
        kept.keep_rows(btf, light_sums)
    kept.keep_rows(btf, light_sums)
    assert len(rows) <= 5 + 1 + 2  # black ones are not asked for, a piece that was cut off is done again
    torch.testing.assert_close(kept.collected(0, 3), images.sum((1, 4)), rtol=1e-6, atol=1e-6)
    assert not kept.todo()


def test_codes_come_back_by_map_and_by_rows(parts, rng):
    codes = torch.randint(0, 256, (4, 6, 2, 3), generator=rng, dtype=torch.uint8)
    scale, offset = torch.rand(4, 3, generator=rng), torch.rand(4, 3, generator=rng)
    kept = KeptCodes(parts=parts, name="q", count=4, shape=(6, 2, 3), dtype=torch.uint8)
    for k in range(4):
        assert not kept.complete()
        kept.keep(k, codes[k], scale[k], offset[k])
    assert kept.complete()
    for found, expected in zip(kept.of_map(2), (codes[2], scale[2], offset[2]), strict=True):
        assert torch.equal(found, expected)
    row = kept.opened(slice(3, 5))
    for at in (0, 1):
        expected = offset[:, None] + scale[:, None] * codes[:, 3 + at].float()
        torch.testing.assert_close(row(at), expected, rtol=1e-6, atol=1e-6)
    kept.drop()
    assert not kept.complete()
