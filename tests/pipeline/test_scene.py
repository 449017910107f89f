from pathlib import Path

import pytest
import torch
from PIL import Image

from tests.pipeline.small import small
from torchmeso import config
from torchmeso.config_sections import ObjectConfig
from torchmeso.data.textured import Textured
from torchmeso.errors import ConfigError, GeometryError
from torchmeso.geometry import mesh_file
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


TWO_PARTS = (
    "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    "usemtl front\nf 1/1 2/2 3/3\nusemtl back\nf 1/1 3/3 4/4\n"
)


def two_parts(tmp_path, **changes):
    (tmp_path / "a.obj").write_text(TWO_PARTS)
    item = {"mesh": str(tmp_path / "a.obj"), **changes}
    return small(objects=[item], materials={"red": {"albedo": [1, 0, 0]}, "blue": {"albedo": [0, 0, 1]}})


def test_parts_get_the_materials_they_are_given(tmp_path):
    settings = two_parts(tmp_path, material="red", materials={"back": "blue"})
    (item,) = scene.build(settings, bake.prepare(settings)).objects
    assert [m.albedo for m in item.materials] == [(1, 0, 0), (0, 0, 1)]
    assert item.part is not None
    assert item.part.tolist() == [0, 1]


def test_parts_of_one_material_are_one(tmp_path):
    settings = two_parts(tmp_path, material="red")
    (item,) = scene.build(settings, bake.prepare(settings)).objects
    assert (item.part, item.others) == (None, ())


def test_parts_look_as_their_file_says(tmp_path):
    Image.new("RGB", (2, 2), (255, 0, 0)).save(tmp_path / "c.png")
    (tmp_path / "a.mtl").write_text("newmtl front\nmap_Kd c.png\nnewmtl back\nKd 0.1 0.2 0.3\n")
    settings = two_parts(tmp_path)
    (tmp_path / "a.obj").write_text("mtllib a.mtl\n" + TWO_PARTS)
    (item,) = scene.build(settings, bake.prepare(settings)).objects
    front, back = item.materials
    assert isinstance(front.btf, Textured)
    assert front.btf.albedo[0, 0].tolist() == [1, 0, 0]
    assert back.albedo == (0.1, 0.2, 0.3)


def test_instances_share_what_was_read(tmp_path, monkeypatch):
    times = []
    read = mesh_file.read
    monkeypatch.setattr(mesh_file, "read", lambda *a, **k: times.append(a) or read(*a, **k))
    places = [{"translate": [i, 0, 0]} for i in range(5)]
    item = two_parts(tmp_path, material="red", instances=places).objects[0]
    settings = small(
        objects=[item.model_dump(), {**item.model_dump(), "instances": [], "translate": [0, 3, 0]}],
        materials={"red": {"albedo": [1, 0, 0]}},
    )
    objects = scene.build(settings, bake.prepare(settings)).objects
    assert len(times) == 1
    assert [float(o.mesh.vertices[:, 0].min()) for o in objects] == [0, 1, 2, 3, 4, 0]
    assert all(o.mesh.faces is objects[0].mesh.faces for o in objects)


@pytest.mark.errors
def test_parts_nobody_named(tmp_path):
    settings = two_parts(tmp_path, material="red", materials={"bakc": "blue"})
    with pytest.raises(ConfigError, match=r"a\.obj has no part 'bakc'; did you mean 'back'"):
        scene.build(settings, bake.prepare(settings))
    settings = two_parts(tmp_path, materials={"back": "blue"})
    with pytest.raises(
        ConfigError, match="expected a material for the part 'front', got none; name one in 'materials'"
    ):
        scene.build(settings, bake.prepare(settings))


def regional(**regions):
    content = {
        "materials": {"a": {"albedo": [1, 0, 0]}, "b": {"albedo": [0, 1, 0]}, "c": {"albedo": [0, 0, 1]}},
        "objects": [{"shape": "sphere", "options": {"triangles": 300}, "material": "a", **regions}],
        "camera": {"eye": [0, 0, 5]},
    }
    return config.parse(content, folder=Path())


def test_regions_dress_faces_by_where_they_lie():
    """The later one wins, and a placed body keeps the parts of the unplaced one."""
    upper = {"low": [-2, 0, -2], "high": [2, 2, 2], "material": "b"}
    right = {"low": [0.5, -2, -2], "high": [2, 2, 2], "material": "c"}
    settings = regional(regions=[upper, right], translate=[0, 100, 0])
    body = scene.read_body(settings.objects[0])
    middle = body.mesh.vertices[body.mesh.faces].mean(1)
    expected = torch.where(middle[:, 0] >= 0.5, 2, torch.where(middle[:, 1] >= 0, 1, 0))
    assert body.looks == ("a", "b", "c")
    assert torch.equal(body.part, expected)
    assert settings.objects[0].used_materials == {"a", "b", "c"}


@pytest.mark.errors
def test_a_region_without_faces_is_refused():
    far = {"low": [5, 5, 5], "high": [6, 6, 6], "material": "b"}
    with pytest.raises(ConfigError, match=r"expected faces between .* got none; the mesh lies between"):
        scene.read_body(regional(regions=[far]).objects[0])
    with pytest.raises(ConfigError, match="no material is called 'd'"):
        regional(regions=[{**far, "material": "d"}])


@pytest.mark.errors
def test_quads_are_shown_with_their_tiles_only():
    with pytest.raises(ConfigError, match=r"a\.surface is laid out in tiles, which this cannot show"):
        scene.read_body(ObjectConfig(mesh="a.surface", material="brick"))
