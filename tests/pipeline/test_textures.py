import errno
import json

import numpy as np
import pytest
import torch
from PIL import Image

from torchmeso.algebra.spherical_harmonics import basis
from torchmeso.cli import main
from torchmeso.compress import double_sh, eigen, sh_pca
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.data import eigen_btf, image, sh_btf, sh_pca_btf
from torchmeso.data.btf import Btf
from torchmeso.data.mdf import Mdf
from torchmeso.errors import ConfigError, StorageError
from torchmeso.geometry import hemisphere
from torchmeso.pipeline import textures
from torchmeso.render.scene import Material

SET = hemisphere.grid(5, 2, 70)


@pytest.fixture
def table(rng):
    return Btf(images=torch.rand(10, 10, 4, 6, 3, generator=rng), lights=SET, views=SET)


def picture(path):
    if path.suffix == ".exr":
        return image.read_vectors(path)
    return torch.from_numpy(np.asarray(Image.open(path)).astype(np.float32))


@pytest.mark.parametrize("storage", ["uint8", "float16"])
def test_an_eigen_btf_is_put_together_from_its_textures(table, tmp_path, capsys, storage):
    model = eigen.fit(table, EigenOptions(rank=3, storage=storage))
    rng = torch.Generator().manual_seed(2)
    depth = Mdf(
        delta=torch.randint(0, 256, (10, 8, 8), generator=rng, dtype=torch.uint8),
        no_hit=torch.rand(10, 8, 8, generator=rng) > 0.9, directions=SET, h=0.2,
    )  # fmt: skip
    eigen_btf.save(model, tmp_path / "a.meso", silhouette=depth)
    out = tmp_path / "maps"
    main(["export", str(tmp_path / "a.meso"), "--to", str(out)], standalone_mode=False)
    assert capsys.readouterr().out == f"{out}\n"
    about = json.loads((out / "maps.json").read_text())
    l, v = 7, 4
    suffix = about["btf"]["files"].partition(":")[0][-4:]
    T = torch.zeros(4, 6, 3)
    for k in range(3):
        E = picture(out / "eigen" / f"k{k:02d}_l{l:03d}{suffix}")
        scale, offset = (torch.tensor(about["btf"][x][k]) for x in ("scale", "offset"))
        T += about["btf"]["view_weights"][v][k] * (offset + scale * E)
    expected = torch.einsum("hwkc,k->hwc", model.decoded()[l], model.weights[v])
    torch.testing.assert_close(T, expected, rtol=0, atol=1e-5)
    assert about["btf"]["lights_deg"][l] == [70, pytest.approx(144)]
    drop = np.asarray(Image.open(out / "mdf" / "v004.png"))
    assert np.array_equal(drop[..., 0], depth.delta[4].numpy())
    assert np.array_equal(drop[..., 1] == 0, depth.no_hit[4].numpy())
    height = image.read_vectors(out / "height.exr")[..., 0]
    assert float(height.max()) <= 0 and float(height.min()) >= -0.2001
    assert image.read(out / "ambient.exr").shape == (4, 6, 3)


def test_harmonics_are_put_together_from_their_textures(table, tmp_path):
    model = double_sh.fit(table, DoubleShOptions(light_terms=4, view_terms=4))
    sh_btf.save(model, tmp_path / "a.meso")
    textures.write(tmp_path / "a.meso", tmp_path / "maps")
    about = json.loads((tmp_path / "maps" / "maps.json").read_text())["btf"]
    y = basis(SET.directions(), 1)[3]
    T = torch.zeros(4, 6, 3)
    for i in range(4):
        for j in range(4):
            code = picture(tmp_path / "maps" / "sh" / f"i{i:02d}_j{j:02d}.png")
            T += y[i] * y[j] * (torch.tensor(about["offset"][i][j]) + torch.tensor(about["scale"][i][j]) * code)
    expected = torch.einsum("ijhwc,i,j->hwc", model.decoded(), y, y)
    torch.testing.assert_close(T, expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("storage", ["uint8", "float16"])
def test_components_are_put_together_from_their_textures(table, tmp_path, storage):
    model = sh_pca.fit(table, ShPcaOptions(rank=3, light_terms=4, storage=storage))
    sh_pca_btf.save(model, tmp_path / "a.meso")
    textures.write(tmp_path / "a.meso", tmp_path / "maps")
    about = json.loads((tmp_path / "maps" / "maps.json").read_text())["btf"]
    y, v = basis(SET.directions(), 1)[3], 4
    T = torch.zeros(4, 6, 3)
    for k in range(3):
        W = picture(tmp_path / "maps" / "sh_pca" / f"k{k:02d}_v{v:03d}{about['files'].partition(':')[0][-4:]}")
        T += (about["offset"][k] + about["scale"][k] * W) * (y @ torch.tensor(about["basis"][k]))
    expected = torch.einsum("hwk,kmc,m->hwc", model.decoded()[v], model.basis, y)
    torch.testing.assert_close(T, expected, rtol=0, atol=1e-5)


def test_a_folder_that_stood_there_is_replaced_whole(table, tmp_path):
    eigen_btf.save(eigen.fit(table, EigenOptions(rank=1)), tmp_path / "a.meso")
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "old.png").write_bytes(b"old")
    (tmp_path / "maps.part").mkdir()
    textures.write(tmp_path / "a.meso", tmp_path / "maps")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.meso", "maps"]
    assert sorted(p.name for p in (tmp_path / "maps").iterdir()) == ["ambient.exr", "eigen", "maps.json"]


@pytest.mark.errors
def test_a_full_disk_is_one_sentence_and_leaves_what_stood_there(table, tmp_path, monkeypatch):
    def fail(self, *_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    eigen_btf.save(eigen.fit(table, EigenOptions(rank=1)), tmp_path / "a.meso")
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "old.png").write_bytes(b"old")
    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(StorageError, match="No space left"):
        textures.write(tmp_path / "a.meso", tmp_path / "maps")
    assert (tmp_path / "maps" / "old.png").read_bytes() == b"old"


@pytest.mark.errors
def test_a_model_without_maps_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(textures, "open_model", lambda path: Material())
    with pytest.raises(ConfigError, match="expected a compressed BTF, got NoneType"):
        textures.write(tmp_path / "a.meso", tmp_path / "maps")
