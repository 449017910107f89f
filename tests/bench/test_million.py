import torch

from torchmeso.bench import million
from torchmeso.geometry import shapes
from torchmeso.render.rasterize import rasterize
from torchmeso.render.scene import Material, Object, Scene, assemble


def test_a_crowd_stands_apart_and_in_the_picture():
    body = Object(mesh=shapes.torus_knot(triangles=200), material=Material())
    scene = million.crowd(body, 84, Scene(objects=(body,), lights=()))
    centres = torch.stack([o.mesh.vertices.mean(0) for o in scene.objects])
    apart = torch.cdist(centres, centres) + 10 * torch.eye(84)
    assert float(apart.min()) > 0.6
    world = assemble(scene)
    camera = next(million._moving())
    x, y, w, _ = camera.project(world.vertices.double()).unbind(-1)
    inside = (x / w > 0) & (x / w < camera.width) & (y / w > 0) & (y / w < camera.height)
    assert float(inside.double().mean()) > 0.95
    small = million.view((0.0, 0.0, 8.0), width=80, height=60, fov_deg=44)
    assert (rasterize(small, world.vertices, world.faces).start.diff() > 0).double().mean() > 0.2
