import math

import pytest
import torch

from tests.render.scenes import scene, sun
from tests.tolerances import FLOAT32
from torchmeso.data.btf import Btf
from torchmeso.geometry import hemisphere, shapes
from torchmeso.geometry.frames import Frame
from torchmeso.geometry.light import DirectionalLight, PointLight
from torchmeso.render.btf_shade import shade
from torchmeso.render.scene import Material, Object, Points, Scene


def points(n=1, owner=0):
    """Points at the origin of a level surface: t = x, b = y, n = z."""
    axes = torch.eye(3)[:, None].expand(3, n, 3)
    owners = torch.full((n,), owner, dtype=torch.long)
    return Points(torch.zeros(n, 3), torch.rand(n, 2), Frame(*axes), torch.ones(n), owners, torch.zeros(n))


def lit(subject, n=1, wo=(0.0, 0.0, 1.0), blocked=False):
    dark = torch.full((len(subject.lights), n), blocked)
    return shade(subject, points(n), torch.tensor([wo]).expand(n, 3), dark)


def constant_btf(value):
    """T = value cos(theta_i) as a table: exact in the interpolation at normal incidence."""
    lights = views = hemisphere.grid(6, 3, 80)
    cosine = lights.directions()[:, 2]
    images = (value * cosine)[:, None, None, None, None].expand(len(lights), len(views), 2, 2, 3).contiguous()
    return Btf(images=images, lights=lights, views=views)


@pytest.mark.parametrize("theta_deg", [0, 30, 60, 89])
def test_white_diffuser_reflects_the_cosine(theta_deg):
    theta = math.radians(theta_deg)
    subject = scene(shapes.plane(), lights=(sun(math.sin(theta), 0, math.cos(theta)),))
    torch.testing.assert_close(lit(subject), torch.full((1, 3), math.cos(theta)), **FLOAT32)


def test_no_light_from_below_and_none_in_shadow():
    assert (lit(scene(shapes.plane(), lights=(sun(0.1, 0, -1),))) == 0).all()
    assert (lit(scene(shapes.plane(), lights=(sun(0, 0, 1),)), blocked=True) == 0).all()


def test_lights_add_up_and_ambient_is_added_once():
    two = (sun(0, 0, 1), sun(0, 1, 1))
    subject = scene(shapes.plane(), albedo=(0.5, 0.25, 1.0), lights=two, ambient=0.1)
    expected = torch.tensor([[0.5, 0.25, 1.0]]) * (1 + math.sqrt(0.5) + 0.1)
    torch.testing.assert_close(lit(subject), expected, **FLOAT32)


def test_the_papers_ambient_shows_only_where_no_light_arrives():
    plane = scene(shapes.plane()).objects
    subject = Scene(objects=plane, lights=(sun(0, 0, 1),), ambient=0.1, ambient_rule="paper")
    assert lit(subject)[0, 0] == pytest.approx(1)
    assert lit(subject, blocked=True)[0, 0] == pytest.approx(0.1)


def test_point_light_falls_off_with_the_square():
    lamp = PointLight(position=torch.tensor([0.0, 0, 2]), intensity=torch.full((3,), 4 * math.pi))
    assert lit(scene(shapes.plane(), lights=(lamp,)))[0, 0] == pytest.approx(1)


def test_btf_table_equals_the_diffuser_it_holds(rng):
    """(1/pi) E T and the ambient integral of a table of T = 0.5 cos(theta)."""
    subject = Scene(
        objects=(Object(mesh=shapes.plane(), material=Material(btf=constant_btf(0.5))),),
        lights=(DirectionalLight(direction=torch.tensor([0.0, 0, 1]), irradiance=torch.full((3,), 2.0)),),
        ambient=0.2,
    )
    ring = math.cos(math.radians(80 * 0.5 / 2.5))
    expected = 0.5 * ring * 2 / math.pi + 0.2 * 0.5
    assert lit(subject)[0, 0] == pytest.approx(expected, rel=0.01)


def test_each_object_is_shaded_with_its_own_material():
    red, blue = Material(albedo=(1.0, 0, 0)), Material(albedo=(0, 0, 1.0))
    subject = Scene(
        objects=(Object(mesh=shapes.plane(), material=red), Object(mesh=shapes.plane(), material=blue)),
        lights=(sun(0, 0, 1),), ambient=0,
    )  # fmt: skip
    both = points(3)._replace(owner=torch.tensor([0, 0, 1]))
    wo = torch.tensor([[0.0, 0, 1]]).expand(3, 3)
    got = shade(subject, both, wo, torch.zeros(1, 3, dtype=torch.bool))
    torch.testing.assert_close(got, torch.tensor([[1.0, 0, 0], [1, 0, 0], [0, 0, 1]]), **FLOAT32)


def test_negative_values_of_a_low_rank_become_black():
    subject = Scene(
        objects=(Object(mesh=shapes.plane(), material=Material(btf=constant_btf(-1.0))),),
        lights=(sun(0, 0, 1),), ambient=0,
    )  # fmt: skip
    assert (lit(subject) == 0).all()
