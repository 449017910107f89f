import numpy as np
import torch

from torchmeso.geometry import shapes
from torchmeso.geometry.directions import normalize
from torchmeso.render import device
from torchmeso.render.scene import Material, Object, Scene, assemble


def world(mesh):
    return assemble(Scene(objects=(Object(mesh=mesh, material=Material()),), lights=()))


def test_structures_have_the_kernels_sizes():
    assert [x.itemsize for x in (device.FACET, device.REFLECTANCE, device.MDF, device.LIGHT)] == [64, 128, 64, 64]


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


def test_tables_stand_on_blocks_of_64_bytes():
    pool = device._Pool()
    arrays = [np.arange(n, dtype=np.float32) for n in (3, 16, 17, 1)]
    blocks = [pool.add(x) for x in arrays]
    whole = pool.joined()
    assert blocks == [0, 1, 2, 4]
    for block, x in zip(blocks, arrays, strict=True):
        np.testing.assert_array_equal(whole[64 * block : 64 * block + x.nbytes].view(np.float32), x)


def test_components_stand_in_vectors_of_four():
    x = torch.arange(6 * 3, dtype=torch.float32).reshape(1, 6, 3)
    grouped = device._grouped(x)
    assert grouped.shape == (1, 2, 16)
    torch.testing.assert_close(grouped.reshape(1, 8, 4)[:, :6, :3], x)
    assert grouped.reshape(1, 8, 4)[:, 6:].abs().sum() == 0
