import numpy as np
import torch

from torchmeso.geometry import shapes
from torchmeso.geometry.directions import normalize
from torchmeso.render import device
from torchmeso.render.scene import Material, Object, Scene, assemble


def world(mesh):
    return assemble(Scene(objects=(Object(mesh=mesh, material=Material()),), lights=()))


def test_structures_have_the_kernels_sizes():
    assert [x.itemsize for x in (device.FACET, device.LIGHT)] == [64, 64]


def test_gradients_carry_barycentric_coordinates_along_a_face():
    w = world(shapes.torus_knot(triangles=400))
    facets = device.face_records(w, torch.zeros(len(w.faces), 2, dtype=torch.int32))
    corner = w.vertices[w.faces].numpy()
    for name, k in (("first", 1), ("second", 2)):
        step = np.einsum("fc,fkc->fk", facets[name], corner - corner[:, :1])
        expected = np.zeros((len(w.faces), 3))
        expected[:, k] = 1
        np.testing.assert_allclose(step, expected, atol=2e-4)


def test_interpolated_normals_turn_no_further_than_said():
    w = world(shapes.sphere(triangles=200))
    facets = device.face_records(w, torch.zeros(len(w.faces), 2, dtype=torch.int32))
    weight = torch.rand(50, len(w.faces), 3, generator=torch.Generator().manual_seed(0))
    weight = weight / weight.sum(-1, keepdim=True)
    n = normalize(torch.einsum("sfk,fkc->sfc", weight, w.normals[w.faces]))
    off = (n - torch.from_numpy(facets["normal"])).norm(dim=-1).amax(0).numpy()
    assert (off <= facets["turn"]).all()
    assert (facets["turn"] < 0.5).all()
