"""Small scenes that several tests of rendering share."""

import torch

from torchmeso.geometry.camera import Camera, look_at
from torchmeso.geometry.light import DirectionalLight
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
