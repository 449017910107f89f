import torch

from tests.tolerances import FLOAT64
from torchmeso.geometry import prisms, shapes


def test_top_is_the_base_surface_and_depth_follows_the_normal():
    mesh = shapes.sphere(triangles=800)
    face = torch.arange(len(mesh.faces))
    corner = torch.eye(3, dtype=torch.float64)[0].expand(len(face), 3)
    top = prisms.to_world(mesh, face, corner, torch.zeros(len(face), dtype=torch.float64))
    torch.testing.assert_close(top, mesh.vertices[mesh.faces[:, 0]].double(), **FLOAT64)
    deep = prisms.to_world(mesh, face, corner, torch.full((len(face),), -0.1, dtype=torch.float64))
    vertex = mesh.faces[:, 0]
    moved = -0.1 * mesh.scale[vertex, None].double() * mesh.normals[vertex].double()
    torch.testing.assert_close(deep - top, moved, **FLOAT64)


def test_neighbours_agree_on_their_common_face(rng):
    """No cracks: a point on a shared edge maps to one place from both triangles, at every depth."""
    mesh = shapes.torus(triangles=800)
    edges = {}
    for f, face in enumerate(mesh.faces.tolist()):
        for k in range(3):
            edges.setdefault(frozenset((face[k], face[(k + 1) % 3])), []).append((f, k))
    pairs = [e for e in edges.values() if len(e) == 2]
    a = torch.rand(len(pairs), dtype=torch.float64, generator=rng)
    z = -torch.rand(len(pairs), dtype=torch.float64, generator=rng)
    places = []
    for side in (0, 1):
        face = torch.tensor([p[side][0] for p in pairs])
        weights = torch.zeros(len(pairs), 3, dtype=torch.float64)
        for i, p in enumerate(pairs):
            f, k = p[side]
            tail = mesh.faces[f, k]
            ahead = tail < mesh.faces[f, (k + 1) % 3]
            weights[i, k] = a[i] if ahead else 1 - a[i]
            weights[i, (k + 1) % 3] = 1 - weights[i, k]
        places.append(prisms.to_world(mesh, face, weights, z))
    torch.testing.assert_close(places[0], places[1], **FLOAT64)


def test_barycentric_inverts_interpolation(rng):
    triangle = torch.rand(50, 3, 2, dtype=torch.float64, generator=rng)
    weights = torch.rand(50, 3, dtype=torch.float64, generator=rng)
    weights = weights / weights.sum(-1, keepdim=True)
    uv = (weights[..., None] * triangle).sum(1)
    torch.testing.assert_close(prisms.barycentric(uv, triangle), weights, rtol=1e-8, atol=1e-8)


def test_thin_triangles_are_told_whatever_their_size():
    """A right triangle of height 1e-3 and one of 1e-8, scaled and moved; far from 0 even the first is too thin."""
    for scale in (1e-3, 1.0, 1e3):
        good, bad = (torch.tensor([[0.0, 0], [1, 0], [0, height]]).double() * scale for height in (1e-3, 1e-8))
        assert prisms.is_thin(torch.stack([good, bad])).tolist() == [False, True]
    good = torch.tensor([[0.0, 0], [1, 0], [0, 1e-3]]).double()
    assert prisms.is_thin(torch.stack([good + 100, good + 1e4])).tolist() == [False, True]
    assert prisms.is_thin(torch.zeros(3, 2))
