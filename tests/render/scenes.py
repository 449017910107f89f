"""Small scenes that several tests of rendering share."""

import torch

from torchmeso.geometry import mesh
from torchmeso.geometry.camera import Camera, look_at
from torchmeso.geometry.light import DirectionalLight, PointLight, SpotLight
from torchmeso.geometry.mesh import Mesh
from torchmeso.render.scene import DistanceFunction, Material, Object, Scene

UP = (0.0, 1.0, 0.0)


def vector(*x: float) -> torch.Tensor:
    return torch.tensor(x, dtype=torch.float64)


def camera(eye, at=(0.0, 0.0, 0.0), size=64, up=UP, **options) -> Camera:
    """A square picture from `eye` to `at`."""
    place, axes = look_at(vector(*eye), vector(*at), vector(*up))
    return Camera(eye=place, axes=axes, width=size, height=size, **options)


def sun(*direction: float) -> DirectionalLight:
    """A light that gives a white diffuser facing it radiance 1."""
    towards = torch.nn.functional.normalize(torch.tensor(direction, dtype=torch.float32), dim=0)
    return DirectionalLight(direction=towards, irradiance=torch.full((3,), torch.pi))


def scene(*meshes: Mesh, mdf: DistanceFunction | None = None, albedo=(1.0, 1.0, 1.0), lights=(), ambient=0.0) -> Scene:
    """Meshes of one material; no ambient light unless asked for."""
    material = Material(mdf=mdf, albedo=albedo)
    return Scene(objects=tuple(Object(mesh=m, material=material) for m in meshes), lights=lights, ambient=ambient)


def moved(shape, x=0.0, y=0.0, z=0.0):
    """`shape` elsewhere."""
    matrix = torch.eye(4)
    matrix[:3, 3] = torch.tensor([x, y, z])
    return mesh.transform(shape, matrix)


LIGHTS = {
    "sun": (sun(1, 2, 1),),
    "point": (PointLight(position=torch.tensor([1.5, 2.0, 1.5]), intensity=torch.full((3,), 20.0)),),
    "spot": (
        SpotLight(
            position=torch.tensor([-1.0, 3.0, 1.0]),
            axis=torch.nn.functional.normalize(torch.tensor([0.3, -1.0, -0.3]), dim=0),
            intensity=torch.tensor([40.0, 30.0, 20.0]),
            outer_deg=35.0,
        ),
        sun(-1, 1, 0.2),
    ),
    "none": (),
}


def patched(body, *materials, height=0.0):
    """A body with other materials above each of several heights."""
    middle = body.vertices[body.faces].mean(1)[:, 1]
    part = sum((middle > height + 0.15 * k).long() for k in range(len(materials) - 1))
    return Object(mesh=body, material=materials[0], others=materials[1:], part=part)
