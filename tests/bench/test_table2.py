import pytest
import torch

from torchmeso.bench import table2
from torchmeso.bench.suite import Context
from torchmeso.data import btf, image, sh_btf


def base(rng):
    return torch.rand(81, 81, 4, 4, 3, generator=rng).half()


def test_the_table_repeats_the_brick_with_a_gain_and_noise(tmp_path, rng):
    small = base(rng)
    table2.write_table(small, 10, tmp_path / "a.btf.zarr", Context())
    table = btf.load(tmp_path / "a.btf.zarr")
    assert table.texels == (10, 10)
    assert table.encoding == "srgb"
    shown = table.pictures()
    repeated = small.float().repeat(1, 1, 3, 3, 1)[:, :, :10, :10]
    share = (shown * repeated).sum((0, 1, 4)) / (repeated * repeated).sum((0, 1, 4))
    assert 0.65 < share.min() < 0.9 < share.max() < 1.02
    assert (shown - share[:, :, None] * repeated).abs().mean() < 0.03


def test_pictures_are_named_as_bonn_does(tmp_path, rng, monkeypatch):
    from torchmeso.pipeline import picture_sets

    monkeypatch.setenv("TORCHMESO_CACHE", str(tmp_path / "cache"))
    n_bytes = table2.write_pictures(torch.full((81, 81, 4, 4, 3), 0.5).half(), 8, tmp_path / "set")
    assert n_bytes == sum(p.stat().st_size for p in (tmp_path / "set").iterdir())
    found = picture_sets.survey(tmp_path / "set")
    assert (found.lights.name, found.views.name, found.n_missing) == ("ubo81", "ubo81", 0)
    with found.opened() as read:
        assert image.decode_codes(read(found.files[80, 80])).mean() < 0.5


@pytest.mark.slow
def test_a_fit_is_measured_in_a_process_of_its_own(tmp_path, rng, device):
    table2.write_table(base(rng), 6, tmp_path / "a.btf.zarr", Context())
    table2.drop(tmp_path / "a.btf.zarr")
    run = table2.compress(tmp_path / "a.btf.zarr", tmp_path / "a.meso", "--view-terms", 9)
    assert sh_btf.load(tmp_path / "a.meso").terms == (25, 9)
    assert run.asked > 81 * 81 * 6 * 6 * 3 / 2
    assert 100e6 < run.peak < 4e9
    assert run.wall > 0
    assert run.cpu > 0
    assert table2.drop_and_read(tmp_path / "a.btf.zarr") > 0


def test_what_is_too_large_is_not_measured(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHMESO_CACHE", str(tmp_path))
    monkeypatch.setattr(table2, "ROOM", 1e9)
    rows = list(table2.streamed(Context()))
    assert [row.id for row in rows] == [f"compress.stream.{n}.{k}" for n in (128, 256, 800) for k in (25, 36)]
    assert all(row.value is None and "GB of disk" in row.why for row in rows)
    assert not list(tmp_path.iterdir())


def test_the_rows_of_table_ii(tmp_path, rng, device, monkeypatch):
    """Of a table of four texels, so that only the figures' form is tested."""
    monkeypatch.setenv("TORCHMESO_CACHE", str(tmp_path))
    monkeypatch.setattr(table2, "brick", lambda size: base(rng))
    write, run = table2.write_table, table2.Run(10.0, 12.0 * table2.CORES, int(1.5e9), int(3e8), int(2e8))
    monkeypatch.setattr(table2, "write_table", lambda b, size, path, context: write(b, 4, path, context))

    def compress(source, out, *options, cache=None):
        out.write_bytes(b"x" * 100)
        return run

    monkeypatch.setattr(table2, "compress", compress)
    rows = {row.id: row for row in table2.streamed(Context(quick=True))}
    assert "paper 613 s, 61x" in rows["compress.stream.128.25"].peer
    assert rows["compress.stream.256.36.memory"].met
    assert rows["compress.stream.800.25"].why == "full run only"
    monkeypatch.setattr(table2, "write_pictures", lambda b, size, folder: folder.mkdir() or 7)
    (row,) = table2.pictures(Context(quick=True))
    assert (row.id, row.value) == ("compress.jpeg.128.25", 10.0)
    assert not list(tmp_path.iterdir())
