import math

import torch

from torchmeso.geometry import components, shapes


def tetrahedron(shift=0.0, size=1.0):
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * size + shift
    return vertices, torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])


def join(*meshes):
    first, vertices, faces = 0, [], []
    for v, f in meshes:
        vertices.append(v)
        faces.append(f + first)
        first += len(v)
    return torch.cat(vertices), torch.cat(faces)


def test_equal_positions_are_welded_and_negative_zero_is_zero():
    number = components.weld(torch.tensor([[0.0, 1, 2], [3, 4, 5], [-0.0, 1, 2]]))
    assert number[0] == number[2] != number[1]


def test_closed_and_open_parts_are_told_apart():
    v, f = join(tetrahedron(), tetrahedron(5.0))
    found = components.find(v, f[:-1])
    assert found.of_face.tolist() == [0] * 4 + [1] * 3
    assert found.closed.tolist() == [True, False]
    assert math.isclose(found.volume[0], 1 / 6, rel_tol=1e-6)


def test_volume_is_exact_far_from_the_origin():
    v, f = tetrahedron(1e4)
    assert math.isclose(components.find(v, f).volume[0], 1 / 6, rel_tol=1e-3)


def test_split_vertices_do_not_open_a_mesh():
    v, f = tetrahedron()
    assert components.find(v[f.flatten()], torch.arange(12).reshape(4, 3)).closed.tolist() == [True]


def test_two_sheets_glued_on_an_edge_are_still_closed():
    """Four faces meet at one edge: two tetrahedra that share it."""
    v, f = tetrahedron()
    other = torch.tensor([[0, 4, 1], [0, 1, 5], [1, 4, 5], [0, 5, 4]]).flip(1)
    v = torch.cat([v, torch.tensor([[0.0, -1, 0], [0, 0, -1]])])
    found = components.find(v, torch.cat([f, other]))
    assert found.closed.tolist() == [True]


def test_turned_face_opens_the_part():
    v, f = tetrahedron()
    assert components.find(v, torch.cat([f[:3], f[3:].flip(1)])).closed.tolist() == [False]


def test_inside_out_is_found_but_a_cavity_is_kept():
    shell = join(tetrahedron(size=10.0), (tetrahedron(1.0)[0], tetrahedron()[1].flip(1)))
    found = components.find(*shell)
    assert components.inside_out(found, *shell).tolist() == [False, False]
    v, f = tetrahedron()
    found = components.find(v, f.flip(1))
    assert components.inside_out(found, v, f.flip(1)).tolist() == [True]


def test_no_faces_no_components():
    assert len(components.find(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long)).closed) == 0


def test_built_in_shapes_are_one_closed_part():
    for name in ("cylinder", "sphere", "torus", "torus_knot"):
        mesh = shapes.SHAPES[name]()
        assert mesh.closed.tolist() == [True], name


def test_sheets_with_two_sides_keep_one():
    """A body drawn twice, back to back, and one of two bodies that touch."""
    v, f = tetrahedron()
    doubled = torch.cat([f, f.roll(1, 1).flip(1)])
    found = components.find(v, doubled)
    assert components.twins(found, v, doubled).tolist() == [False] * 4 + [True] * 4
    assert not components.twins(components.find(v, f), v, f).any()
    apex = torch.cat([v, torch.tensor([[-1.0, -1, -1]])])
    touching = torch.cat([f, torch.tensor([[1, 2, 3]]).flip(1), torch.tensor([[1, 2, 4], [2, 3, 4], [3, 1, 4]])])
    found = components.find(apex, touching)
    assert len(found.closed) == 1
    assert not components.twins(found, apex, touching).any()


def test_nothing_has_no_twins():
    v, f = torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long)
    assert components.twins(components.find(v, f), v, f).tolist() == []
