from pathlib import Path

import pytest
import torch
import yaml

from torchmeso import config
from torchmeso.config import load, parse
from torchmeso.config_sections import CameraConfig, ObjectConfig
from torchmeso.errors import ConfigError, FormatError, MesoError
from torchmeso.geometry.light import DirectionalLight, PointLight, SpotLight
from torchmeso.geometry.mesh_file import Finish

CONFIGS = sorted((Path(__file__).parents[1] / "configs").glob("*.yaml"))


def minimal(**changes):
    content = {
        "materials": {"clay": {"albedo": [0.5, 0.4, 0.3]}},
        "objects": [{"shape": "sphere", "material": "clay"}],
        "camera": {"eye": [0, 0, 5]},
    }
    return {**content, **changes}


def read(content):
    return parse(content, folder=Path("/somewhere"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda p: p.stem)
def test_configurations_that_ship_are_sound(path, monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHMESO_DATA", str(tmp_path))
    settings = config.load(path)
    settings.camera.build()
    assert settings.name == path.stem


def test_defaults_are_the_stages_own():
    settings = read(minimal(materials={"clay": {"meso": {"type": "brick"}}}))
    assert settings.materials["clay"].btf.lights == "grid(12, 5, 80)"
    assert settings.materials["clay"].mdf.texels == 256
    assert settings.materials["clay"].eigen.rank == 4
    assert settings.render.silhouette == "curved"


def test_numbers_written_without_a_point_are_numbers():
    """PyYAML reads 1e-3 as a string."""
    assert read(minimal(camera={"eye": [0, 0, 5], "near": "1e-3"})).camera.near == 1e-3


def test_paths_lie_beside_the_file_or_in_the_data_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHMESO_DATA", str(tmp_path))
    objects = [{"mesh": "a.obj", "material": "clay"}, {"mesh": "data:mesh/b.obj", "material": "clay"}]
    settings = read(minimal(objects=objects))
    assert settings.objects[0].mesh == "/somewhere/a.obj"
    assert settings.objects[1].mesh == str(tmp_path / "mesh" / "b.obj")


def test_mesostructure_takes_its_generators_arguments():
    tile = config.build_meso({"type": "brick", "rows": 6, "h": "0.2"})
    assert tile.h == 0.2
    with_pictures = read(minimal(materials={"clay": {"meso": {"type": "pictures", "displacement": "d.png", "h": 0.1}}}))
    meso = with_pictures.materials["clay"].meso
    assert meso is not None
    assert meso.files == [Path("/somewhere/d.png")]


def test_a_name_is_a_generator_or_a_file(monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHMESO_DATA", str(tmp_path))
    assert config.meso_called("brick").type == "brick"
    weave = config.meso_called("data:volume/a.TG3")
    assert (weave.type, weave.files) == ("textile", [tmp_path / "volume" / "a.TG3"])
    assert config.meso_called("b.obj").arguments == {"path": "b.obj"}


def test_objects_are_scaled_then_turned_then_moved():
    item = ObjectConfig(shape="sphere", material="x", scale=2, rotate_deg=(0, 90, 0), translate=(1, 0, 0))
    moved = item.matrix() @ torch.tensor([1.0, 0, 0, 1], dtype=torch.float64)
    torch.testing.assert_close(moved, torch.tensor([1.0, 0, -2, 1], dtype=torch.float64), rtol=0, atol=1e-6)


def test_instances_stand_behind_the_objects_own_place():
    instances = [{"translate": (0, 5, 0)}, {"rotate_deg": (0, 90, 0), "scale": 3}]
    item = ObjectConfig(shape="sphere", material="x", scale=2, translate=(1, 0, 0), instances=instances)
    first, second = item.places()
    point, exact = torch.tensor([1.0, 0, 0, 1], dtype=torch.float64), {"rtol": 0, "atol": 1e-12}
    torch.testing.assert_close(first @ point, torch.tensor([3.0, 5, 0, 1], dtype=torch.float64), **exact)
    torch.testing.assert_close(second @ point, torch.tensor([0.0, 0, -9, 1], dtype=torch.float64), **exact)
    assert len(ObjectConfig(shape="sphere", material="x").places()) == 1


def test_plain_materials_take_pictures():
    settings = read(minimal(materials={"clay": {"albedo_map": "c.png", "normal_map": "n.png", "normal_scale": 2}}))
    finish = settings.materials["clay"].finish
    assert finish == Finish(
        albedo=(1, 1, 1), albedo_map=Path("/somewhere/c.png"), normal_map=Path("/somewhere/n.png"), normal_scale=2
    )


def test_lights_and_camera():
    lights = [
        {"type": "directional", "direction": [0, 2, 0]},
        {"type": "point", "position": [0, 1, 0], "intensity": [1, 1, 1]},
        {"type": "spot", "position": [0, 1, 0], "at": [0, 0, 0], "intensity": [1, 1, 1]},
    ]
    built = [light.build() for light in read(minimal(lights=lights)).lights]
    assert [type(x) for x in built] == [DirectionalLight, PointLight, SpotLight]
    assert built[0].direction.tolist() == [0, 1, 0]
    assert built[2].axis.tolist() == [0, -1, 0]
    camera = CameraConfig(eye=(0, 0, 5), width=10, height=8).build()
    assert (camera.width, camera.height, camera.fov_deg) == (10, 8, 45)


def test_another_silhouette():
    assert config.with_silhouette(read(minimal()), "paper").render.silhouette == "paper"


FEATURE = {"on": "tile", "number": 0, "at": [1, 1], "taken": [0, 0], "size": [0, 4]}

REFUSED = [
    (minimal(camra={}), "unknown key 'camra'; did you mean 'camera'"),
    (minimal(camera={"eye": [0, 0, 1], "fov": 30}), r"unknown key 'camera\.fov'; did you mean 'fov_deg'"),
    (
        minimal(materials={"clay": {"albedo": [1, 1, 1], "btf": {"texel": 8}}}),
        r"clay\.btf\.texel'; did you",
    ),
    (minimal(materials={"clay": {"meso": {"type": "brik"}}}), "got 'brik'; did you mean 'brick'"),
    (
        minimal(materials={"clay": {"meso": {"type": "brick", "colums": 2}}}),
        "'colums'; did you mean 'columns'",
    ),
    (minimal(materials={"clay": {"meso": {"type": "pictures", "h": 1}}}), "pictures needs the option 'displacement'"),
    (minimal(materials={"clay": {}}), "exactly one of 'meso', 'model'"),
    (minimal(objects=[{"shape": "sphere", "material": "cley"}]), "no material is called 'cley'; did you mean 'clay'"),
    (minimal(objects=[{"shape": "sfere", "material": "clay"}]), "got 'sfere'; did you mean 'sphere'"),
    (minimal(objects=[{"shape": "sphere", "material": "clay", "options": {"radios": 1}}]), "did you mean 'radius'"),
    (minimal(objects=[{"mesh": "a.obj", "materials": {"skin": "cley"}}]), "called 'cley'; did you mean 'clay'"),
    (minimal(objects=[{"shape": "sphere"}]), "a built-in 'shape' needs a 'material'"),
    (
        minimal(objects=[{"mesh": "a.obj", "instances": [{"rotate": 1}]}]),
        r"instances\.0\.rotate'; did you mean 'rotate_deg'",
    ),
    (minimal(objects=[{"mesh": "a.obj", "tile_size": 1, "unwrap": {"iteration": 1}}]), "did you mean 'iterations'"),
    (minimal(materials={"clay": {"meso": {"type": "brick"}, "normal_map": "n.png"}}), "'normal_map' belongs to"),
    (minimal(materials={"clay": {"meso": {"type": "brick"}, "double_sh": {}, "sh_pca": {}}}), "at most one of 'double"),
    (minimal(materials={"clay": {"meso": {"type": "brick"}, "sh_pca": {"rnak": 3}}}), "did you mean 'rank'"),
    (minimal(objects=[{"material": "clay"}]), "exactly one of 'shape' and 'mesh'"),
    (minimal(objects=[{"mesh": "a.obj", "material": "clay", "options": {"radius": 1}}]), "belong to built-in shapes"),
    (minimal(objects=[{"mesh": "a.obj", "material": "clay", "unwrap": True}]), "needs 'tile_size'"),
    (minimal(lights=[{"type": "point", "positon": [0, 0, 1], "intensity": [1, 1, 1]}]), "did you mean 'position'"),
    (minimal(lights=[{"type": "lamp"}]), "expected tags: 'directional', 'point', 'spot'"),
    (minimal(render={"silhouette": "curve"}), r"render\.silhouette: .*got 'curve'"),
    (minimal(render={"shadow_map_size": 1}), r"render\.shadow_map_size: expected a value from 8"),
    (minimal(camera={"eye": [0, 0, 1], "width": "wide"}), r"camera\.width: .*got 'wide'"),
    ({"materials": {"clay": {"albedo": [1, 1, 1]}}, "camera": {"eye": [0, 0, 1]}}, "'objects' is missing"),
    (minimal(materials={"clay": {"albedo": [1, 1, 1], "gdm": {}}}), "'gdm' says how to bake a 'meso'"),
    (minimal(materials={"clay": {"albedo": [1, 1, 1], "floor": [1, 1, 1]}}), "'shell' and 'floor' belong to a 'gdm'"),
    (minimal(materials={"clay": {"meso": {"type": "weave"}, "gdm": {}, "shell": {"base": "x"}}}), "got 'x'"),
    (
        minimal(objects=[{"mesh": "a.surface", "materials": {"skin": "clay"}}]),
        "a mesh laid out in quads .* has one 'material'",
    ),
    (minimal(materials={"clay": {"wang": {"features": [FEATURE]}}}), "'size': expected at least one row and column"),
]


@pytest.mark.errors
@pytest.mark.parametrize(("content", "message"), REFUSED, ids=range(len(REFUSED)))
def test_mistakes_are_named(content, message):
    with pytest.raises(ConfigError, match=message):
        read(content)


@pytest.mark.errors
def test_values_without_sense_are_refused():
    with pytest.raises(ConfigError, match="expected a direction towards the light"):
        read(minimal(lights=[{"type": "directional", "direction": [0, 0, 0]}])).lights[0].build()
    spot = {"type": "spot", "position": [0, 1, 0], "at": [0, 1, 0], "intensity": [1, 1, 1]}
    with pytest.raises(ConfigError, match="expected another place"):
        read(minimal(lights=[spot])).lights[0].build()
    with pytest.raises(ConfigError, match=r"meso\.rows: input should be a valid integer"):
        config.build_meso({"type": "brick", "rows": "many"})
    with pytest.raises(ConfigError, match="got 'brik'"):
        config.build_meso({"type": "brik"})
    with pytest.raises(ConfigError, match=r"meso: expected a mesostructure, got 'weave\.xml'"):
        config.meso_called("weave.xml")


@pytest.mark.errors
def test_files_that_are_no_configurations(tmp_path, monkeypatch):
    with pytest.raises(FormatError, match="found none; check the path"):
        config.load(tmp_path / "none.yaml")
    (tmp_path / "a.yaml").write_text("a: [1,")
    with pytest.raises(FormatError, match="expected YAML"):
        config.load(tmp_path / "a.yaml")
    (tmp_path / "b.yaml").write_text("- 1")
    with pytest.raises(FormatError, match="expected keys and values, got list"):
        config.load(tmp_path / "b.yaml")
    monkeypatch.setenv("TORCHMESO_DATA", str(tmp_path / "absent"))
    with pytest.raises(FormatError, match="set TORCHMESO_DATA"):
        read(minimal(objects=[{"mesh": "data:a.obj", "material": "clay"}]))


def test_shapes_take_their_options():
    item = ObjectConfig.model_validate({"shape": "plane", "options": {"size": [6, "4"]}, "tiles": 3, "material": "x"})
    body = item.build_shape()
    assert (body.vertices.amax(0) - body.vertices.amin(0)).tolist() == [6, 0, 4]
    assert body.uv.amax(0).tolist() == [3, 3]


@pytest.mark.errors
def test_options_of_the_wrong_kind():
    item = ObjectConfig.model_validate({"shape": "plane", "options": {"size": "big"}, "material": "x"})
    with pytest.raises(ConfigError, match=r"objects\.options\.size: .*got 'big'"):
        item.build_shape()


@pytest.mark.errors
@pytest.mark.parametrize(
    ("text", "message"),
    [("a: 2026-13-45", "expected YAML"), ("[" * 5000, "expected YAML"), ("a: " + "9" * 5000, "expected YAML"),
     ("a: &x [*x]", "a section that holds itself"), (".nan", "camera.eye.0: input should be a finite number"),
     (".inf", "finite number")],
)  # fmt: skip
def test_text_that_is_no_configuration(text, message, tmp_path):
    if text.startswith("."):
        text = yaml.safe_dump(minimal(camera={"eye": [float(text[1:]), 0, 1]}))
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(MesoError, match=message):
        load(tmp_path / "a.yaml")
