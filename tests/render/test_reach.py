from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.render.scenes import camera
from torchmeso.geometry import shapes
from torchmeso.geometry.light import DirectionalLight, PointLight, SpotLight
from torchmeso.render.frame import FrameOptions, Skips
from torchmeso.render.reach import reaching
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Material, Object, Scene


def sun(x, y, z, power=1.0):
    w = torch.tensor([x, y, z], dtype=torch.float32)
    return DirectionalLight(direction=w / w.norm(), irradiance=torch.full((3,), power))


def of(mesh):
    return Scene(objects=(Object(mesh=mesh, material=Material()),), lights=())


BALLS = np.array([[0.0, 0, 0, 1]])


def test_lights_under_the_horizon_of_a_floor_are_left_out():
    floor = of(shapes.plane(size=(2.0, 2.0), triangles=800))
    lights = (sun(0, 1, 0), sun(0, -1, 0), sun(1, 0, 0), sun(0.3, -0.1, 0.2), sun(0, 1, 0, power=0.0))
    assert reaching(lights, floor, BALLS) == [0, 2]


def test_some_of_a_body_is_always_lit(rng):
    ball = of(shapes.sphere(triangles=2000))
    w = torch.nn.functional.normalize(torch.randn(50, 3, generator=rng), dim=1)
    assert reaching([sun(*x) for x in w.tolist()], ball, BALLS) == list(range(50))


def test_one_vertex_that_sees_a_light_is_enough():
    mesh = shapes.plane(size=(2.0, 2.0), triangles=800)
    normals = mesh.normals.clone()
    normals[137] = torch.tensor([0.0, -1, 0])
    assert reaching([sun(0, -1, 0)], of(replace(mesh, normals=normals)), BALLS) == [0]


def test_spots_that_shine_past_and_points():
    spot = SpotLight(
        position=torch.tensor([0.0, 5, 0]), axis=torch.tensor([0.0, -1, 0]), intensity=torch.ones(3), outer_deg=30
    )
    point = PointLight(position=torch.tensor([0.0, 5, 0]), intensity=torch.ones(3))
    lights = (spot, replace(spot, axis=torch.tensor([0.0, 1, 0])), point, replace(point, intensity=torch.zeros(3)))
    assert reaching(lights, of(shapes.sphere(triangles=200)), BALLS) == [0, 2]


@pytest.mark.parametrize("silhouette", ["none", "curved"])
def test_a_floor_looks_the_same_without_them(silhouette, still_life, device):
    """Lights from all around, half of them from below a hilly floor that is half of the picture."""
    floor = Object(mesh=shapes.plane(size=(6.0, 6.0), triangles=200), material=still_life[0].material)
    lights = tuple(sun(x, y, 0.3) for x in (-1.0, 0.5) for y in (-2.0, -0.2, 0.1, 2.0))
    pictures, counts = [], []
    for on in (True, False):
        options = FrameOptions(silhouette=silhouette, shadow_map_size=64, skips=Skips(unlit=on))
        renderer = Renderer(Scene(objects=(floor,), lights=lights), options)
        pictures.append(renderer.render(camera((1.5, 2.0, 3.5), size=96)).rgb.clone())
        counts.append(renderer.counts["lights left out"])
    assert torch.equal(*pictures)
    assert counts == [4, 0]
