from dataclasses import replace

import pytest
import torch

from tests.pipeline.small import small
from torchmeso.compress import gdm_svd as fits
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.data import gdm_coded, gdm_svd, store
from torchmeso.errors import ConfigError, FormatError
from torchmeso.pipeline import bake, render


def test_bakes_what_is_used_and_nothing_else(cache):
    said = []
    assets = bake.prepare(small(), lambda what, share: said.append(what))
    assert set(assets) == {"brick", "clay"}
    assert {"brick: MDF", "brick: BTF", "brick: eigen BTF"} == set(said)
    brick = assets["brick"]
    assert brick.material.mdf is not None
    assert brick.model_bytes > 0
    assert brick.raw_bytes > 0
    assert set(brick.seconds) == {"mdf", "btf", "compress"}
    assert assets["clay"].material.albedo == (0.5, 0.5, 0.5)
    assert len(list(cache.glob("*.meso"))) == 1


def test_second_time_comes_from_the_cache():
    first = bake.prepare(small())["brick"]
    said = []
    second = bake.prepare(small(), lambda what, share: said.append(what))["brick"]
    assert not said
    assert not second.seconds
    uv, w = torch.rand(5, 2), torch.tensor([[0.0, 0, 1]]).expand(5, 3)
    assert torch.equal(first.material.btf.evaluate(uv, w, w), second.material.btf.evaluate(uv, w, w))


def test_another_option_is_another_entry():
    brick = small().materials["brick"]
    paths = bake.table_paths(brick)
    finer = brick.model_copy(update={"mdf": replace(brick.mdf, texels=32)})
    assert bake.table_paths(finer)[0] == paths[0]
    assert bake.table_paths(finer)[1] != paths[1]
    more = brick.model_copy(update={"eigen": replace(brick.eigen, rank=3)})
    assert bake.table_paths(more) == paths
    assert bake.model_path(more) != bake.model_path(brick)


def test_double_sh_instead_of_eigen(cache):
    few = DoubleShOptions(light_terms=4, view_terms=4)
    brick = small().materials["brick"].model_copy(update={"double_sh": few})
    assert bake.model_path(brick) != bake.model_path(small().materials["brick"])
    found = bake.prepare_material("brick", brick).material
    assert found.btf.terms == (4, 4)
    assert found.mdf is not None
    assert bake.open_model(bake.model_path(brick), rank=1).btf.terms == (1, 1)


@pytest.mark.parametrize("kind", ["eigen", "double_sh"])
def test_adaptive_models_are_smaller_and_drawn_like_the_others(kind, tmp_path):
    """In torch and in the OpenCL frame, where there is one: the picture is the one of eight bits within the budget."""
    pictures, size = {}, {}
    for storage in ("uint8", "adaptive"):
        options = {
            "eigen": {"rank": 3, "storage": storage},
            "double_sh": {"light_terms": 4, "view_terms": 4, "storage": storage},
        }
        brick = {k: v for k, v in small().materials["brick"].model_dump().items() if k in ("btf", "mdf")}
        content = {"brick": {"meso": {"type": "brick"}, **brick, kind: options[kind]}, "clay": {"albedo": [1, 1, 1]}}
        settings = small(materials=content)
        size[storage] = bake.prepare(settings)["brick"].model_bytes
        for backend in ("torch", "auto"):
            found = render.render(settings.model_copy(update={"backend": backend})).picture
            pictures[storage, backend] = found.rgb
    assert size["adaptive"] < size["uint8"]
    for backend in ("torch", "auto"):
        assert (pictures["adaptive", backend] - pictures["uint8", backend]).square().mean().sqrt() < 0.02
    torch.testing.assert_close(pictures["adaptive", "auto"], pictures["adaptive", "torch"], rtol=0, atol=0.02)


def test_sh_pca_instead_of_eigen(cache):
    few = ShPcaOptions(rank=3, light_terms=4)
    brick = small().materials["brick"].model_copy(update={"sh_pca": few})
    assert bake.model_path(brick) != bake.model_path(small().materials["brick"])
    found = bake.prepare_material("brick", brick).material
    assert (found.btf.rank, found.btf.terms) == (3, 4)
    assert found.mdf is not None
    assert bake.open_model(bake.model_path(brick), rank=2).btf.rank == 2


def test_content_of_files_counts(tmp_path):
    from torchmeso.config_sections import MesoConfig
    from torchmeso.data import image

    image.write_png(tmp_path / "d.png", torch.rand(4, 4, 3))
    meso = MesoConfig.model_validate({"type": "pictures", "displacement": str(tmp_path / "d.png"), "h": 0.1})
    before = bake.describe_meso(meso)
    assert before == bake.describe_meso(meso)
    image.write_png(tmp_path / "d.png", torch.rand(4, 4, 3))
    assert bake.describe_meso(meso) != before


def test_finished_model_is_opened():
    bake.prepare(small())
    model = bake.model_path(small().materials["brick"])
    content = {"brick": {"model": str(model)}, "clay": {"albedo": [1, 1, 1]}}
    asset = bake.prepare(small(materials=content))["brick"]
    assert asset.material.mdf is not None
    assert asset.model_bytes == model.stat().st_size


def test_tables_in_a_folder_of_ones_own(tmp_path):
    brick = small().materials["brick"]
    paths = bake.bake_tables("brick", brick, bake.silent, {}, out=tmp_path / "t")
    assert [p.name for p in paths] == ["brick.btf.zarr", "brick.mdf.zarr"]
    seconds = {}
    assert bake.bake_tables("brick", brick, bake.silent, seconds, out=tmp_path / "t") == paths
    assert not seconds


@pytest.mark.errors
def test_refusals(tmp_path):
    brick = small().materials["brick"]
    bake.bake_tables("brick", brick, bake.silent, {}, out=tmp_path)
    other = brick.model_copy(update={"mdf": replace(brick.mdf, texels=8)})
    with pytest.raises(ConfigError, match="holds another table; give --force"):
        bake.bake_tables("brick", other, bake.silent, {}, out=tmp_path)
    bake.bake_tables("brick", other, bake.silent, {}, out=tmp_path, force=True)
    with pytest.raises(ConfigError, match=r"materials\.clay: expected a mesostructure"):
        bake.bake_tables("clay", small().materials["clay"], bake.silent, {})
    with pytest.raises(FormatError, match="expected a file, found none"):
        bake.file_hash(tmp_path / "none")


def test_what_is_not_asked_for_stays_on_disk(tmp_path, monkeypatch):
    """Without silhouettes no MDF is read; of eight components only as many as `rank` says."""
    material = small().materials["brick"]
    bake.prepare_material("brick", material)
    read = []
    original = store.Model.read
    monkeypatch.setattr(store.Model, "read", lambda self, name: read.append(name) or original(self, name))
    path = bake.model_path(material)
    assert bake.open_model(path, depth=False, rank=1).mdf is None
    assert [name for name in read if name.startswith(("mdf", "eigen.map"))] == ["eigen.map.0"]
    read.clear()
    bake.prepare(small(render={"silhouette": "none"}))
    assert not any(name.startswith("mdf") for name in read)
    read.clear()
    bake.prepare(small())
    assert {"mdf.delta", "eigen.map.0", "eigen.map.1"} <= set(read)


def test_the_rank_of_a_model(tmp_path):
    model = bake.model_path(small().materials["brick"])
    bake.prepare(small())
    content = {"materials": {"brick": {"model": str(model), "rank": 1}, "clay": {"albedo": [0.5, 0.5, 0.5]}}}
    assert bake.prepare(small(**content))["brick"].material.btf.rank == 1
    with pytest.raises(ConfigError, match="'rank' belongs to a 'model'"):
        small(materials={"brick": {"albedo": [1, 1, 1], "rank": 1}, "clay": {"albedo": [0.5, 0.5, 0.5]}})


SHELLED = {
    "weave": {
        "meso": {"type": "weave"}, "gdm": {"texels": 16, "layers": 6, "n_theta": 8, "n_phi": 12},
        "shell": {"side": "outward", "queries": 2}, "floor": [0.1, 0.2, 0.3],
    }
}  # fmt: skip


def in_shells(material=None):
    torus = {"shape": "torus", "options": {"triangles": 300}, "tiles": [4, 2], "material": "weave"}
    return small(materials={"weave": material or SHELLED["weave"]}, objects=[torus])


def test_a_material_in_a_shell_is_a_gdm(cache, tmp_path):
    said = []
    weave = bake.prepare(in_shells(), lambda what, share: said.append(what))["weave"]
    assert set(said) == {"weave: GDM"}
    assert weave.material.gdm.voxels == (6, 16, 16)
    assert weave.material.shell.side == "outward"
    assert weave.material.albedo == (0.1, 0.2, 0.3)
    assert set(weave.seconds) == {"gdm"}
    assert weave.raw_bytes == weave.model_bytes > 0
    said.clear()
    assert not bake.prepare(in_shells())["weave"].seconds
    (path,) = bake.bake_tables("weave", in_shells().materials["weave"], bake.silent, {}, out=tmp_path)
    assert path.name == "weave.gdm.zarr"
    given = bake.prepare(in_shells({"model": str(path), "shell": {"base": "open"}}))["weave"]
    assert given.material.shell.base == "open"
    assert given.material.gdm.voxels == (6, 16, 16)
    assert given.raw_bytes == 0
    table, packed = given.material.gdm, tmp_path / "weave.gdm.meso"
    gdm_coded.save(table, packed)
    coded = bake.prepare(in_shells({"model": str(packed), "floor": [0.1, 0.1, 0.1]}))["weave"]
    assert torch.equal(coded.material.gdm.distance, table.distance)
    assert coded.model_bytes == packed.stat().st_size < given.model_bytes
    gdm_svd.save(fits.fit(table, fits.GdmSvdOptions(rank=4)), packed)
    factored = bake.prepare(in_shells({"model": str(packed), "rank": 2}))["weave"]
    assert torch.equal(factored.material.gdm.left, table.left)
