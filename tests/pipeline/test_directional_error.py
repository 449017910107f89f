import json
import math
from dataclasses import replace

import pytest
import torch

from torchmeso.cli import main
from torchmeso.compress import eigen
from torchmeso.compress.eigen import EigenOptions
from torchmeso.data import btf, eigen_btf
from torchmeso.data.btf import Btf
from torchmeso.errors import BackendError, ConfigError
from torchmeso.geometry import hemisphere
from torchmeso.pipeline import directional_error

LIGHTS, VIEWS = hemisphere.grid(5, 2, 70), hemisphere.from_rings((0, 40), (1, 6), (0, 0))


@pytest.fixture
def table(rng):
    images = torch.rand(len(LIGHTS), len(VIEWS), 6, 5, 3, generator=rng)
    return Btf(images=images, lights=LIGHTS, views=VIEWS)


def test_a_model_of_full_rank_is_its_table(table):
    found = directional_error.measure(table, eigen.fit(table, EigenOptions(rank=7, storage="float32")))
    assert found.psnr.shape == (10, 7)
    assert found.texels == (30, 30)
    assert found.whole > 100
    assert found.max_error < 1e-4


def test_one_bad_picture_is_seen_at_its_light_and_its_view(table):
    spoilt = table.images.clone()
    spoilt[3, 2] *= 0.8
    found = directional_error.measure(table, replace(table, images=spoilt))
    assert int(found.over_lights.argmin()) == 3
    assert int(found.over_views.argmin()) == 2
    assert (found.psnr == directional_error.WORST_PSNR).sum() == 69
    worst = 10 ** (-found.psnr[3, 2].double() / 10)
    assert math.isclose(found.whole, -10 * math.log10(float(worst) / 70), abs_tol=1e-3)


def test_large_tables_are_taken_on_a_lattice(table, monkeypatch):
    monkeypatch.setattr(directional_error, "VALUES", 70 * 3 * 30 // 4)
    found = directional_error.measure(table, eigen.fit(table, EigenOptions(rank=7, storage="float32")))
    assert found.texels == (6, 30)
    assert found.whole > 100


def test_on_the_command_line(table, tmp_path, capsys):
    btf.save(table, tmp_path / "a.btf.zarr", dtype="float32")
    eigen_btf.save(eigen.fit(table, EigenOptions(rank=2)), tmp_path / "a.meso")
    names = [str(tmp_path / "a.btf.zarr"), str(tmp_path / "a.meso")]
    main(["compare", *names, "--out", str(tmp_path / "a.png")], standalone_mode=False)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    said = capsys.readouterr().out
    assert said.startswith("PSNR ") and "worst light" in said and "worst view" in said
    main(["compare", *names, "--json"], standalone_mode=False)
    about = json.loads(capsys.readouterr().out)
    assert len(about["over_lights"]) == 10 and len(about["over_views"]) == 7
    assert min(about["over_views"]) <= about["psnr"] <= max(about["over_views"])
    main(["compare", names[0], names[0]], standalone_mode=False)
    assert "PSNR 120.00 dB" in capsys.readouterr().out


@pytest.mark.errors
def test_what_cannot_be_compared_is_refused(table, tmp_path):
    with pytest.raises(ConfigError, match="expected a BTF table as the reference, got a model"):
        directional_error.compare(tmp_path / "a.meso", tmp_path / "b.meso")
    with pytest.raises(ConfigError, match="expected tables of one size, got 10 x 7 directions of 5 x 6 texels and"):
        directional_error.measure(table, Btf(images=table.images[:, :, :3], lights=LIGHTS, views=VIEWS))


@pytest.mark.errors
def test_drawing_needs_matplotlib(table, tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "matplotlib", None)
    with pytest.raises(BackendError, match="expected matplotlib"):
        directional_error.draw(directional_error.measure(table, table), tmp_path / "a.png")
