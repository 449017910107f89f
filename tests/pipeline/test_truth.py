from pathlib import Path

import pytest
import torch

from tests.pipeline.small import small
from torchmeso import config
from torchmeso.errors import ConfigError
from torchmeso.geometry import glb, shapes
from torchmeso.geometry.glb import Body
from torchmeso.geometry.light import DirectionalLight
from torchmeso.geometry.mesh_file import Finish, Group
from torchmeso.pipeline import render, truth
from torchmeso.transport.tracer import MeshTracer

CLAY = {"clay": {"albedo": [0.5, 0.25, 1.0]}}


def test_lit_plane_has_its_closed_form():
    """A diffuser without bounces: albedo (cos + ambient), nothing else."""
    settings = small(
        materials=CLAY, objects=[{"shape": "plane", "options": {"size": [20, 20]}, "material": "clay"}],
        lights=[{"type": "directional", "direction": [0, 3, 4]}], ambient=0.1, truth={"samples": 64, "bounces": 0},
        camera={"eye": [0, 4, 1], "width": 16, "height": 16},
    )  # fmt: skip
    found = truth.render(settings)
    assert (found.owner == 0).all()
    expected = torch.tensor([0.5, 0.25, 1.0]) * (0.6 + 0.1)
    torch.testing.assert_close(found.rgb, expected.expand(16, 16, 3), rtol=1e-3, atol=0)


def test_owner_and_background():
    found = truth.render(small(background=[0.1, 0.2, 0.3]))
    assert set(found.owner.flatten().tolist()) == {-1, 0, 1}
    assert torch.allclose(found.rgb[found.owner == -1], torch.tensor([0.1, 0.2, 0.3]))
    assert (found.depth.isinf() == (found.owner == -1)).all()


def test_kept_by_content(cache):
    said = []
    first = truth.render(small(), lambda what, share: said.append(what))
    assert said
    said.clear()
    again = truth.render(small(name="other", render={"silhouette": "none"}), lambda what, share: said.append(what))
    assert not said
    assert torch.equal(first.rgb, again.rgb)
    truth.render(small(ambient=0.5), lambda what, share: said.append(what))
    assert said
    assert len(list(cache.glob("*.truth"))) == 2


def test_shadows_of_a_ball_on_a_floor():
    settings = small(
        materials=CLAY,
        objects=[
            {"shape": "sphere", "options": {"radius": 0.5}, "translate": [0, 1, 0], "material": "clay"},
            {"shape": "plane", "options": {"size": [6, 6]}, "material": "clay"},
        ],
        camera={"eye": [0, 6, 0.01], "width": 64, "height": 64},
    )  # fmt: skip
    tracer, camera = MeshTracer(*truth.geometries(settings)), settings.camera.build()
    light = DirectionalLight(direction=torch.tensor([0.6, 0.8, 0.0]), irradiance=torch.ones(3))
    dark = truth.shadows(tracer, camera, light)
    owner, depth, origin, direction = truth.first_hits(tracer, camera)
    place = (origin + depth.flatten()[:, None] * direction).reshape(64, 64, 3)
    # On the floor the shadow is an ellipse around (-0.75, 0), stretched by 1 / 0.8 along x.
    inside = ((place[..., 0] + 0.75) * 0.8).square() + place[..., 2].square() < 0.25
    floor = owner == 1
    wrong = (dark != inside) & floor
    assert wrong.sum() <= 0.02 * floor.sum()


@pytest.mark.errors
def test_a_finished_model_has_no_known_geometry(tmp_path):
    settings = small(materials={**CLAY, "brick": {"model": str(tmp_path / "a.meso")}})
    with pytest.raises(ConfigError, match="expected the mesostructure of 'brick', got a finished model"):
        truth.geometries(settings)


@pytest.mark.errors
def test_a_mesostructure_laid_out_by_tiles_has_no_known_geometry():
    tiled = {"meso": {"type": "brick"}, "wang": {}}
    settings = small(objects=[{"mesh": "a.surface", "material": "brick"}], materials={**CLAY, "brick": tiled})
    with pytest.raises(ConfigError, match="'brick' is laid out by tiles, its mesostructure by none"):
        truth.geometries(settings)


def test_parts_and_instances_are_told_by_object(tmp_path):
    """A body of two looks at two places: the truth counts objects as the picture does."""
    body = shapes.sphere(radius=0.6, triangles=300)
    part = (body.vertices[body.faces].mean(1)[:, 1] > 0).long()
    path = tmp_path / "ball.glb"
    groups = (Group("lower", None), Group("upper", Finish(albedo=(0.9, 0.1, 0.1))))
    path.write_bytes(glb.encode([Body("ball", body, part, groups)]))
    ball = {"mesh": str(path), "materials": {"lower": "brick"}}
    places = [{"translate": [-0.8, 0, 0]}, {"translate": [0.8, 0, 0]}]
    settings = small(objects=[{**ball, "instances": places}, *small().model_dump()["objects"][1:]])
    found, picture = truth.render(settings), render.render(settings).picture
    assert set(found.owner.unique().tolist()) == set(picture.owner.unique().tolist()) == {-1, 0, 1, 2}
    assert (picture.owner == found.owner).double().mean() > 0.95
    red = (found.rgb[..., 0] > 2 * found.rgb[..., 1]) & (found.owner >= 0)
    assert set(found.owner[red].tolist()) == {0, 1}


@pytest.mark.parametrize("side", ["inward", "outward"])
def test_a_shell_has_a_floor_and_stands_on_its_side(side):
    """Pipes leave the ground free; where the mesh is the bottom of the shell, the floor lies on it."""
    weave = {
        "meso": {"type": "pipes"}, "gdm": {"texels": 8, "layers": 4}, "shell": {"side": side}, "floor": [1.0, 0.0, 0.0],
    }  # fmt: skip
    plane = {"shape": "plane", "options": {"size": [8, 8]}, "tiles": [8, 8], "material": "pipe"}
    settings = small(
        materials={"pipe": weave}, objects=[plane], lights=[], ambient=1.0,
        camera={"eye": [0, 6, 0.01], "width": 48, "height": 36}, truth={"samples": 4, "bounces": 0, "max_edge": 0.5},
    )  # fmt: skip
    found = truth.render(settings)
    red = (found.rgb[..., 0] > 5 * found.rgb[..., 1].clamp(min=1e-3)) & (found.owner == 0)
    assert red.any()
    h = settings.materials["pipe"].meso.build().h
    assert float(found.depth[18, 24]) == pytest.approx(6, abs=h + 0.05)
    floor = 6.0 if side == "outward" else 6.0 + h
    origin, direction, _ = settings.camera.build().rays(settings.camera.build().pixel_centres())
    height = (origin + found.depth[..., None] * direction)[..., 1][red]
    torch.testing.assert_close(height, torch.full_like(height, 6.0 - floor), rtol=0, atol=1e-3)


def test_another_shell_has_another_truth():
    """Its side, its base and its floor are seen; how a GDM is baked is not."""
    content = {
        "materials": {"a": {"meso": {"type": "weave"}, "gdm": {"texels": 8, "layers": 4}}},
        "objects": [{"shape": "sphere", "material": "a"}],
        "camera": {"eye": [0, 0, 5]},
    }

    def key(**changes):
        material = {**content["materials"]["a"], **changes}
        return truth._key(config.parse({**content, "materials": {"a": material}}, folder=Path()))

    shells = [{"shell": {"side": "outward"}}, {"shell": {"base": "open"}}, {"floor": [0, 0, 0]}, {}]
    assert len({key(**changes) for changes in shells}) == 4
    assert key() == key(gdm={"texels": 16, "layers": 8})
