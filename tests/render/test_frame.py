from dataclasses import replace

import pytest
import torch

from tests.render.scenes import camera, moved, scene, sun
from torchmeso.errors import ConfigError, SizeError
from torchmeso.geometry import shapes
from torchmeso.geometry.rays import RayScene
from torchmeso.meso import bake_mdf, generators
from torchmeso.meso.bake_mdf import MdfOptions
from torchmeso.render.frame import FrameOptions, render
from torchmeso.render.scene import in_double


def test_white_ball_under_a_sun_behind_the_eye():
    """Radiance is the cosine between the normal and the light at every pixel."""
    view = camera((0, 0, 5))
    picture = render(scene(shapes.sphere(triangles=40_000), lights=(sun(0, 0, 1),)), view)
    origin, direction, _ = view.rays(view.pixel_centres())
    place = origin + picture.depth.unsqueeze(-1) * direction
    seen = picture.owner == 0
    torch.testing.assert_close(picture.rgb[..., 0][seen], place[..., 2][seen].clamp(min=0), rtol=0, atol=0.02)
    assert (picture.rgb[~seen] == 0).all()


def test_depth_equals_the_ray_caster():
    subject = scene(shapes.torus_knot(triangles=3000), moved(shapes.sphere(triangles=500), z=-1.0))
    view = camera((0, 1, 4))
    picture = render(subject, view)
    vertices = torch.cat([o.mesh.vertices for o in subject.objects])
    second = subject.objects[1].mesh.faces + len(subject.objects[0].mesh.vertices)
    caster = RayScene(vertices, torch.cat([subject.objects[0].mesh.faces, second]))
    origin, direction, _ = view.rays(view.pixel_centres().reshape(-1, 2))
    truth = caster.first_hit(origin, direction).t.reshape(picture.depth.shape)
    both = truth.isfinite() & picture.depth.isfinite()
    assert (truth.isfinite() != picture.depth.isfinite()).sum() <= 8  # pixels an edge runs through
    assert ((truth - picture.depth)[both].abs() < 0.02).float().mean() > 0.97


def test_nearer_object_wins_and_casts_a_shadow():
    ball, wall = moved(shapes.sphere(radius=0.3, triangles=2000), z=1.0), shapes.sphere(triangles=2000)
    picture = render(scene(ball, wall, lights=(sun(0.3, 0, 1),)), camera((0, 0, 5)))
    assert picture.owner[32, 32] == 0
    assert picture.shadowed[0][picture.owner == 1].any()
    bare = render(scene(ball, wall, lights=(sun(0.3, 0, 1),)), camera((0, 0, 5)), FrameOptions(shadows=False))
    assert not bare.shadowed.any()


def test_nothing_to_see():
    picture = render(scene(shapes.sphere(triangles=100), lights=(sun(0, 0, 1),)), camera((0, 0, 5), (0, 0, 9)))
    assert picture.coverage == 0
    assert (picture.rgb == 0).all()
    assert picture.depth.isinf().all()


def test_background_shows_where_nothing_is():
    subject = replace(scene(shapes.sphere(triangles=100)), background=(0.1, 0.2, 0.3))
    picture = render(subject, camera((0, 0, 5)))
    assert picture.rgb[0, 0].tolist() == pytest.approx([0.1, 0.2, 0.3])


@pytest.mark.parametrize("silhouette", ["none", "paper", "curved"])
def test_same_bits_twice_and_no_nan(silhouette):
    mdf = bake_mdf.in_memory(generators.brick(), MdfOptions(texels=32))
    subject = scene(shapes.torus(triangles=1000), shapes.plane(), mdf=mdf, lights=(sun(1, 2, 0), sun(-1, 1, 0)))
    first, second = (
        render(subject, camera((0, 2, 3)), FrameOptions(silhouette=silhouette, shadow_map_size=256)) for _ in range(2)
    )
    assert torch.equal(first.rgb, second.rgb)
    assert torch.isfinite(first.rgb).all()
    assert (first.counts["intervals carved"] > 0) == (silhouette != "none")


def test_one_pixel():
    picture = render(scene(shapes.sphere(triangles=100), lights=(sun(0, 0, 1),)), camera((0, 0, 5), size=1))
    assert picture.rgb.shape == (1, 1, 3)
    assert picture.rgb.mean() > 0.9


def test_light_pass_uses_the_same_silhouette():
    """A carved ball lets light through its rim: fewer floor pixels lie in shadow."""
    mdf = bake_mdf.in_memory(generators.weave(), MdfOptions(texels=64))
    ball = moved(shapes.sphere(radius=0.6, tiles=(6, 3), triangles=3000), y=0.8)
    floor = scene(shapes.plane(size=(6, 6))).objects
    subject = replace(scene(ball, mdf=mdf, lights=(sun(1, 1, 0),)), objects=scene(ball, mdf=mdf).objects + floor)
    view = camera((0, 5, 0.01), size=128)
    bare, paper, curved = (render(subject, view, FrameOptions(silhouette=s)) for s in ("none", "paper", "curved"))
    area = [int((p.shadowed[0] & (bare.owner == 1)).sum()) for p in (bare, paper, curved)]
    assert area[0] > max(area[1:]) > 0


@pytest.mark.errors
def test_absurd_sizes_are_refused():
    with pytest.raises(ConfigError, match=r"render\.shadow_map_size"):
        FrameOptions(shadow_map_size=1)
    with pytest.raises(SizeError, match="render fewer pixels"):
        render(scene(shapes.plane()), replace(camera((0, 1, 1)), width=16384, height=16384))


@pytest.mark.parametrize("silhouette", ["none", "paper", "curved"])
def test_float64_tells_how_far_float32_is_off(silhouette):
    mdf = bake_mdf.in_memory(generators.brick(), MdfOptions(texels=32))
    subject = scene(shapes.torus(triangles=400), shapes.plane(), mdf=mdf, lights=(sun(1, 2, 0),))
    view, options = camera((0, 2, 3), size=64), FrameOptions(silhouette=silhouette, shadow_map_size=64)
    rough, exact = render(subject, view, options), render(in_double(subject), view, options)
    assert exact.rgb.dtype == exact.depth.dtype == torch.float64
    off = (rough.rgb - exact.rgb).abs().amax(-1)
    assert ((off > 1 / 255).sum()) <= 2  # decisions on their threshold
    assert off.median() < 1e-6
