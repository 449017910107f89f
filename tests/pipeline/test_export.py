import pytest
import torch
import yaml

from tests.data import bonn
from tests.pipeline.small import CONTENT
from torchmeso.config import parse
from torchmeso.data import btf, btfdbb
from torchmeso.data.btf import Btf
from torchmeso.errors import ConfigError, GeometryError
from torchmeso.geometry import hemisphere, mesh, mesh_file
from torchmeso.pipeline import describe, export, picture_sets, scene


def test_a_configuration_is_written_where_it_stands(tmp_path):
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(CONTENT))
    export.to_glb(tmp_path / "small.yaml", tmp_path / "small.glb")
    found = mesh_file.read(tmp_path / "small.glb")
    assert [group.name for group in found.groups] == ["brick", "clay"]
    assert found.groups[1].finish is not None
    assert found.groups[1].finish.albedo == (0.5, 0.5, 0.5)
    body = mesh.dress_file(found)
    torus, plane = (scene.build_mesh(o) for o in parse(CONTENT, folder=tmp_path).objects)
    corner = torch.cat([torus.tangents[torus.faces], plane.tangents[plane.faces]])
    torch.testing.assert_close(body.tangents[body.faces], corner, rtol=0, atol=1e-6)
    assert body.closed.tolist() == [True, False]


def test_a_table_is_written_as_pictures_that_make_a_table_again(tmp_path, monkeypatch, rng):
    monkeypatch.setenv("TORCHMESO_CACHE", str(tmp_path / "cache"))
    images = torch.rand(7, 4, 3, 5, 3, generator=rng)
    btf.save(Btf(images=images, lights=bonn.LIGHTS, views=bonn.VIEWS), tmp_path / "a.btf.zarr", dtype="float32")
    export.to_exr_stack(tmp_path / "a.btf.zarr", tmp_path / "stack")
    assert describe.file(tmp_path / "stack")["values"] == "linear"
    assert torch.equal(btf.load(picture_sets.as_table(tmp_path / "stack")).pictures(), images)


@pytest.mark.errors
def test_a_mesh_without_texture_coordinates_is_refused(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(GeometryError, match=r"a\.obj: expected texture coordinates, got none"):
        export.to_glb(tmp_path / "a.obj", tmp_path / "a.glb")
    assert not (tmp_path / "a.glb").exists()


def bright_table(path, rng):
    """A raw table with highlights of 30, one lobe wide."""
    lights, views = hemisphere.grid(6, 3, 80), hemisphere.ubo81()
    half = lights.directions()[:, None] + views.directions()
    lobe = (half / half.norm(dim=-1, keepdim=True))[..., 2] ** 40
    albedo = torch.rand(4, 5, 3, generator=rng)
    images = (0.3 * albedo + 30 * lobe[..., None, None, None]) * lights.directions()[:, 2].reshape(-1, 1, 1, 1, 1)
    btf.save(Btf(images=images, lights=lights, views=views), path, dtype="float32")
    return images


def test_a_btf_is_written_as_a_bonn_file(tmp_path, rng):
    images = bright_table(tmp_path / "a.btf.zarr", rng)
    told = []
    export.to_bonn(tmp_path / "a.btf.zarr", tmp_path / "a.btf", report=lambda *x: told.append(x))
    found = btfdbb.read(tmp_path / "a.btf")
    assert (found.views, found.lights.count) == (hemisphere.ubo81(), (6, 6, 6))
    assert float(found.images.max()) > 20
    assert float((found.images - images).abs().max() / images.max()) < 4e-3  # halves of logarithms; measured 7e-4
    assert told[-1] == ("factors", pytest.approx(1))
    export.to_bonn(tmp_path / "a.btf.zarr", tmp_path / "b.btf", method="bdi")
    assert torch.equal(btfdbb.read(tmp_path / "b.btf").images, images.half().float())


@pytest.mark.errors
def test_a_rank_is_no_dial_of_plain_chunks(tmp_path, rng):
    bright_table(tmp_path / "a.btf.zarr", rng)
    with pytest.raises(ConfigError, match="leave --rank out"):
        export.to_bonn(tmp_path / "a.btf.zarr", tmp_path / "b.btf", method="bdi", rank=3)
