import pytest
import torch
import yaml

from tests.data import bonn
from tests.pipeline.small import CONTENT
from torchmeso.config import parse
from torchmeso.data import btf
from torchmeso.data.btf import Btf
from torchmeso.errors import GeometryError
from torchmeso.geometry import mesh, mesh_file
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
