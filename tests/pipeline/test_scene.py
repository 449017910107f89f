import pytest
import torch

from tests.pipeline.small import small
from torchmeso.config import ObjectConfig
from torchmeso.errors import GeometryError
from torchmeso.pipeline import bake, scene


def test_scene_has_what_the_configuration_names():
    settings = small()
    built = scene.build(settings, bake.prepare(settings))
    assert len(built.objects) == 2
    assert built.objects[0].material.mdf is not None
    assert float(built.objects[1].mesh.vertices[:, 1].max()) == pytest.approx(-0.6)
    assert len(built.lights) == 1
    assert scene.bare(built).objects[0].material.mdf is None
    assert scene.bare(built).objects[0].material.btf is built.objects[0].material.btf


def write_square(path, with_uv):
    texture = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n" if with_uv else ""
    face = "f 1/1 2/2 3/3 4/4\n" if with_uv else "f 1 2 3 4\n"
    path.write_text("v 0 0 0\nv 2 0 0\nv 2 0 -2\nv 0 0 -2\n" + texture + face)


def test_mesh_file_takes_more_tiles(tmp_path):
    write_square(tmp_path / "a.obj", with_uv=True)
    item = ObjectConfig(mesh=str(tmp_path / "a.obj"), material="x", tiles=(4, 2), translate=(0, 1, 0))
    body = scene.build_mesh(item)
    assert body.uv.amax(0).tolist() == [4, 2]
    assert (body.vertices[:, 1] == 1).all()


@pytest.mark.errors
def test_missing_texture_coordinates_are_offered(tmp_path):
    write_square(tmp_path / "a.obj", with_uv=False)
    with pytest.raises(GeometryError, match=r"expected texture coordinates, got none; make some with `unwrap: true`"):
        scene.build_mesh(ObjectConfig(mesh=str(tmp_path / "a.obj"), material="x"))


def test_unwrapped_mesh_reports_its_seams(tmp_path):
    pytest.importorskip("xatlas")
    write_square(tmp_path / "a.obj", with_uv=False)
    item = ObjectConfig(mesh=str(tmp_path / "a.obj"), material="x", unwrap=True, tile_size=0.5)
    with pytest.warns(
        UserWarning, match=r"unwrapped into 1 charts; texture seams are 0 world units long \(0% of all edges\)"
    ):
        body = scene.build_mesh(item)
    torch.testing.assert_close(body.scale, torch.full_like(body.scale, 0.5), rtol=1e-4, atol=0)
