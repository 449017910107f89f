import math

import pytest
import torch

from tests.pipeline.small import CONTENT, small
from torchmeso import cli, config
from torchmeso.data import image
from torchmeso.errors import ConfigError, FormatError
from torchmeso.pipeline import animate, environment, render, truth
from torchmeso.pipeline import scene as scenes
from torchmeso.pipeline.bake import prepare


@pytest.fixture
def a_map(tmp_path):
    """Dim grey, a bright lamp to the right and up."""
    radiance = torch.full((16, 32, 3), 0.3)
    radiance[4, 24] = torch.tensor([60.0, 50.0, 40.0])
    image.write_exr(tmp_path / "map.exr", radiance)
    return str(tmp_path / "map.exr")


def clay(**settings):
    objects = [{"shape": "sphere", "options": {"triangles": 300}, "material": "clay"}]
    return small(objects=objects, lights=[], environment=settings)


def built(settings):
    return environment.prepare(settings, scenes.build(settings, prepare(settings)))


def test_an_environment_takes_the_place_of_ambient_light_unless_that_is_asked_for(a_map):
    assert small().ambient == 0.05
    assert small(environment={"map": a_map}).ambient == 0
    assert small(environment={"map": a_map}, ambient=0.2).ambient == 0.2


def test_lights_turn_with_the_environment(a_map):
    lit = built(clay(map=a_map, lights=20))
    R = environment.about((0.0, 1.0, 0.0), 30.0).float()
    for before, after in zip(lit(0.0).lights, lit(30.0).lights, strict=True):
        torch.testing.assert_close(after.direction, R @ before.direction)
        assert torch.equal(after.irradiance, before.irradiance)


def test_harmonics_turn_with_the_environment(a_map):
    still, turned = (
        built(clay(map=a_map, method="frequency", degree=4)),
        built(clay(map=a_map, method="frequency", degree=4, rotate_deg=(0, 30, 0))),
    )
    e, f = still(30.0).distant.coefficients, turned(0.0).distant.coefficients
    torch.testing.assert_close(e, f, rtol=1e-5, atol=1e-5)


def test_a_plain_sphere_looks_the_same_by_either_method(a_map):
    pictures = [
        render.render(clay(map=a_map, method=method, lights=400, degree=7)).picture
        for method in ("sampling", "frequency")
    ]
    seen = pictures[0].owner == 0
    lights, harmonics = (p.rgb[seen] for p in pictures)
    assert float(lights.max()) > 0.3
    assert float((lights - harmonics).square().mean().sqrt() / lights.mean()) < 0.06  # the lamp's harmonics end at 7


def test_more_lights_than_a_kernel_holds_add_up(a_map, device):
    settings = clay(map=a_map, lights=150)
    fast, exact = (
        render.render(settings.model_copy(update={"backend": b, "ambient": 0.1, "background": (0.1, 0.2, 0.3)})).picture
        for b in ("opencl", "torch")
    )
    assert fast.shadowed.shape == exact.shadowed.shape
    close = (fast.rgb - exact.rgb).abs().amax(-1) < 1e-3
    assert float(close.float().mean()) > 0.98
    assert torch.equal(fast.rgb[fast.owner < 0], exact.rgb[exact.owner < 0])


@pytest.mark.parametrize("method", ["sampling", "frequency"])
def test_frames_of_a_turning_environment(method, a_map, tmp_path):
    settings = clay(map=a_map, method=method, lights=10)
    files = animate.render(settings, tmp_path / "a.png", frames=3, way="environment")
    pictures = [image.read(f) for f in files]
    assert not torch.equal(pictures[0], pictures[1])
    shift = [float(p[:, 24:].mean() - p[:, :24].mean()) for p in pictures]
    assert shift[0] > shift[1] + 0.01 or shift[0] > shift[2] + 0.01  # the lamp begins on the right


def test_bodies_shadow_each_other_by_transfer_and_are_followed_once(a_map, monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHMESO_CACHE", str(tmp_path / "cache"))
    objects = [
        {"shape": "sphere", "options": {"triangles": 300}, "material": "clay"},
        {"shape": "plane", "options": {"size": [6, 6], "triangles": 800}, "translate": [0, -1, 0], "material": "clay"},
    ]
    settings = {"map": a_map, "degree": 3, "rays": 256, "bounces": 1}
    with_shadows, without = (
        small(objects=objects, lights=[], environment={**settings, "method": m}) for m in ("transfer", "frequency")
    )
    shadowed, plain = (render.render(c).picture for c in (with_shadows, without))
    floor = shadowed.owner == 1
    ratio = shadowed.rgb[floor].mean(-1) / plain.rgb[floor].mean(-1)
    assert float(ratio.min()) < 0.6 and float(ratio.median()) > 0.75
    monkeypatch.setattr(environment.transfer, "bake", None)  # a second time it comes from the cache
    again = built(with_shadows)(0.0).distant
    assert again.at_vertices is not None


def test_environments_from_the_command_line(a_map, tmp_path, capsys):
    (tmp_path / "a.yaml").write_text(
        "materials: {clay: {albedo: [0.5, 0.5, 0.5]}}\nobjects: [{shape: sphere, material: clay}]\n"
        "camera: {eye: [0, 1, 3], width: 32, height: 24}\n"
    )
    out = str(tmp_path / "a.exr")
    for options in (["--env", a_map], ["--env", "sky", "--env-method", "frequency"]):
        cli.main(["render", str(tmp_path / "a.yaml"), *options, "--out", out, "--force"], standalone_mode=False)
        assert out in capsys.readouterr().out and float(image.read(out).max()) > 0.05


def test_the_truth_is_lit_by_the_environment_too(a_map, monkeypatch, tmp_path):
    monkeypatch.setenv("TORCHMESO_CACHE", str(tmp_path / "cache"))
    settings = clay(map=a_map, lights=100)
    exact, picture = truth.render(settings).rgb, render.render(settings).picture
    seen = picture.owner == 0
    assert float((picture.rgb[seen] - exact[seen]).abs().mean() / exact[seen].mean()) < 0.05


def test_the_sky_needs_no_file():
    scene = built(config.with_environment(small(), "sky", "sampling"))(0.0)
    assert len(scene.lights) == 200 and scene.ambient == 0
    up = sum(float(light.irradiance[1]) * max(float(light.direction[1]), 0.0) for light in scene.lights)
    assert 0.3 < up / math.pi < 3


@pytest.mark.errors
def test_what_is_no_environment_is_refused(a_map):
    with pytest.raises(ConfigError, match="a map or a sky"):
        built(clay(map=a_map, sky={}))
    with pytest.raises(ConfigError, match="--env-method needs an environment"):
        config.with_environment(small(), None, "frequency")
    with pytest.raises(ConfigError, match="expected an environment to turn"):
        animate.render(small(), "a.png", frames=2, way="environment")
    with pytest.raises(FormatError, match="found none"):
        built(clay(map="nowhere.hdr"))
    with pytest.raises(ConfigError, match=r"unknown key 'environment.light'; did you mean 'lights'"):
        small(environment={"light": 5})
    assert "environment" not in CONTENT
