"""Budgets from a file to a file: the same bits as in memory, in any bands, after any interruption."""

from dataclasses import replace

import pytest
import torch

from torchmeso.compress import budget_stream, double_sh_budget, eigen_budget, kept_maps, transform
from torchmeso.compress.budget import Budget
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.transform import TransformOptions
from torchmeso.data import bands, btf, eigen_btf, sh_btf, store, transform_btf
from torchmeso.data.btf import Btf
from torchmeso.data.journal import Journal
from torchmeso.errors import ConfigError
from torchmeso.geometry import hemisphere

LIGHTS, VIEWS = hemisphere.grid(6, 3, 80), hemisphere.grid(5, 3, 75)
MOST = DoubleShOptions(light_terms=9, view_terms=4)
JOBS = {
    "eigen, an error": (EigenOptions(rank=15), Budget(psnr=26)),
    "eigen, a size": (EigenOptions(rank=15), Budget(size=12_000)),
    "eigen adaptive, an error": (EigenOptions(rank=15, storage="adaptive"), Budget(psnr=26)),
    "eigen adaptive, a size": (EigenOptions(rank=15, storage="adaptive"), Budget(size=9_000)),
    "double-sh, an error": (MOST, Budget(psnr=7)),
    "double-sh adaptive, a size": (replace(MOST, storage="adaptive"), Budget(size=7_000)),
    "transform, an error": (TransformOptions(), Budget(psnr=30)),
    "transform, a size": (TransformOptions(rank=12), Budget(size=9_000)),
}

QUICK = ("eigen, an error", "eigen adaptive, a size", "double-sh, an error", "transform, a size")
EACH = [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in JOBS]


@pytest.fixture
def table(rng, tmp_path):
    """A table on disk of a few components and noise, with a black row."""
    maps = torch.rand(18, 8, 8, 4, 3, generator=rng)
    images = torch.einsum("lhwkc,vk->lvhwc", maps, torch.rand(15, 4, generator=rng))
    images = images + 0.02 * torch.rand(images.shape, generator=rng)
    images[:, :, 2] = 0
    btf.save(Btf(images=images, lights=LIGHTS, views=VIEWS), tmp_path / "a.btf.zarr", dtype="float32")
    return btf.load(tmp_path / "a.btf.zarr")


def in_memory(table, options, wanted, path):
    whole = Btf(images=table.rows(0, 8), lights=LIGHTS, views=VIEWS)
    coded = getattr(options, "storage", None) == "adaptive"
    if isinstance(options, EigenOptions):
        model, psnr = eigen_budget.fit(whole, wanted, storage=options.storage, rank=options.rank)
        eigen_btf.save(model, path, coded=coded, psnr=round(psnr, 2))
    elif isinstance(options, DoubleShOptions):
        harmonic, psnr = double_sh_budget.fit(whole, wanted, options)
        sh_btf.save(harmonic, path, coded=coded, psnr=round(psnr, 2))
    else:
        packed, psnr = transform.fit(whole, wanted, options)
        transform_btf.save(packed, path, psnr=round(psnr, 2))
    return psnr


def tensors(path):
    model = store.Model(path)
    return model.meta, {name: model.read(name) for name in sorted(model.names())}


def fit(table, name, path, **more):
    options, wanted = JOBS[name]
    return budget_stream.fit(table, options, wanted, path, key="k", backend="torch", **more)


@pytest.mark.parametrize("name", EACH)
@pytest.mark.parametrize(
    "room",
    [
        pytest.param(1, id="a row"),
        pytest.param(3 * 18 * 15 * 8 * 12, id="three rows", marks=pytest.mark.slow),
        pytest.param(1 << 28, id="all"),
    ],
)
def test_the_file_is_the_one_of_a_fit_in_memory(name, room, table, tmp_path, monkeypatch):
    expected = in_memory(table, *JOBS[name], tmp_path / "b.meso")
    monkeypatch.setattr(bands, "ROOM", room)
    assert fit(table, name, tmp_path / "a.meso") == expected
    (meta, streamed), (expected_meta, whole) = tensors(tmp_path / "a.meso"), tensors(tmp_path / "b.meso")
    assert meta == expected_meta
    assert list(streamed) == list(whole)
    assert all(torch.equal(streamed[n], whole[n]) for n in streamed)
    assert not list(tmp_path.glob("*.part"))
    wanted = JOBS[name][1]
    if wanted.size is not None:
        assert (tmp_path / "a.meso").stat().st_size <= wanted.size


class Killed(BaseException):
    """As if the process were gone."""


@pytest.mark.parametrize("name", EACH)
def test_a_search_that_was_killed_goes_on(name, table, tmp_path, monkeypatch):
    monkeypatch.setattr(bands, "ROOM", 1)
    reads, told = [], []
    stored_rows = Btf.stored_rows

    def counted(self, start, *more):
        if not isinstance(self.images, torch.Tensor):
            reads.append(start)
        return stored_rows(self, start, *more)

    monkeypatch.setattr(Btf, "stored_rows", counted)
    fit(table, name, tmp_path / "b.meso", progress=told.append)
    assert told[-1] <= 1 + 1e-9
    whole, calls = len(reads), len(told)
    for at in sorted({1, 8, calls // 2, calls}):
        reads.clear()
        seen = []

        def dies(share, at=at, seen=seen):
            seen.append(share)
            if len(seen) == at:
                raise Killed

        with pytest.raises(Killed):
            fit(table, name, tmp_path / "a.meso", progress=dies)
        assert not (tmp_path / "a.meso").exists()
        before = len(reads)
        fit(table, name, tmp_path / "a.meso")
        assert (tmp_path / "a.meso").read_bytes() == (tmp_path / "b.meso").read_bytes()
        assert len(reads) <= whole + 20  # what was being read and measured when it was killed
        if at == calls:
            assert len(reads) - before <= whole / 2
        (tmp_path / "a.meso").unlink()


@pytest.mark.parametrize("name", EACH)
def test_rows_and_maps_alone_are_in_memory(name, table, tmp_path, monkeypatch):
    """What is read, kept or collected at a time is a row of texels or a map, whatever the size of the texture."""
    monkeypatch.setattr(bands, "ROOM", 1)
    monkeypatch.setattr(kept_maps, "ROOM", 1)
    monkeypatch.setattr(Btf, "pictures", None)
    monkeypatch.setattr(Btf, "_stored", None)
    rows, sizes = [], []
    stored_rows, write, read = Btf.stored_rows, Journal.write, Journal.read

    def counted(self, start, stop, *more):
        if not isinstance(self.images, torch.Tensor):
            rows.append(stop - start)
        return stored_rows(self, start, stop, *more)

    def sized(self, *place, **which):
        found = read(self, *place, **which)
        sizes.append(found.numel())
        return found

    monkeypatch.setattr(Btf, "stored_rows", counted)
    monkeypatch.setattr(Journal, "write", lambda self, name, x: sizes.append(x.numel()) or write(self, name, x))
    monkeypatch.setattr(Journal, "read", sized)
    fit(table, name, tmp_path / "a.meso")
    assert set(rows) == {1}
    row, of_a_map = 18 * 15 * 8 * 3, 18 * 8 * 8 * 3
    grams = 18**2 + 15**2 + 3**2
    assert max(n for n in sizes if n != 2 * transform.BINS) <= max(row + grams, of_a_map)


@pytest.mark.errors
def test_what_cannot_be_kept_is_refused(table, tmp_path):
    for options in (EigenOptions(rank=15), MOST, TransformOptions()):
        with pytest.raises(ConfigError, match="100 bytes cannot be reached"):
            budget_stream.fit(table, options, Budget(size=100), tmp_path / "a.meso", key="k", backend="torch")
    assert not (tmp_path / "a.meso").exists()
