import pytest
import torch

from torchmeso.errors import ConfigError, GeometryError
from torchmeso.geometry import mesh, shapes, shell
from torchmeso.geometry.shell import BORDER, BOTTOM, OUTWARD, TOP

BODIES = {
    "torus": lambda: shapes.torus(triangles=400, tiles=(6, 2)),
    "sphere": lambda: shapes.sphere(triangles=300),
    "plane": lambda: shapes.plane(triangles=18),
    "cylinder": lambda: shapes.cylinder(triangles=200),
}


def volumes(built):
    p = built.vertices[built.tets]
    return torch.linalg.det(p[:, 1:] - p[:, :1])


@pytest.mark.parametrize("side", ["inward", "outward"])
@pytest.mark.parametrize("name", BODIES)
def test_tetrahedra_fill_the_prisms_and_know_each_other(name, side):
    body = BODIES[name]()
    built = shell.build(body, 0.05, side=side)
    assert len(built.tets) == 3 * len(built.face)
    assert (volumes(built) > 0).all()
    assert (built.kept == 1).all()
    tet, corner = (built.neighbour >= 0).nonzero().unbind(1)
    other = built.neighbour[tet, corner]
    back = (built.neighbour[other] == tet[:, None]).int().argmax(1)
    assert (built.neighbour[other, back] == tet).all()
    mine = built.tets[tet].gather(1, OUTWARD[corner]).sort(1).values
    theirs = built.tets[other].gather(1, OUTWARD[back]).sort(1).values
    assert torch.equal(mine, theirs)
    tops, bottoms, borders = ((built.neighbour == k).sum() for k in (TOP, BOTTOM, BORDER))
    assert tops == bottoms == len(built.face)
    assert (borders == 0) == (name != "plane")


def test_texture_coordinates_are_those_of_the_prism_mapping():
    """Corners lie where `prisms.to_world` takes their texture coordinates."""
    from torchmeso.geometry import prisms

    body = BODIES["torus"]()
    built = shell.build(body, 0.08)
    face = built.face.repeat_interleave(3)[:, None].expand(-1, 4)
    uv = body.uv.double()[body.faces[face]]
    share = prisms.barycentric(built.uvz[..., :2], uv)
    world = prisms.to_world(body, face, share, built.uvz[..., 2])
    torch.testing.assert_close(world, built.vertices[built.tets], rtol=0, atol=2e-6)


def test_boundary_faces_look_outwards():
    body = BODIES["torus"]()
    built = shell.build(body, 0.05)
    for base, count in (("solid", len(body.faces)), ("open", 2 * len(body.faces))):
        found = shell.boundary(built, base=base)
        assert len(found.faces) == count
        tip = built.vertices[built.tets[found.tet, found.corner]]
        a, b, c = built.vertices[found.faces].unbind(1)
        assert ((tip - a) * torch.linalg.cross(b - a, c - a)).sum(-1).max() < 0


def test_columns_shrink_where_prisms_would_turn_inside_out():
    """A tube of radius 0.4 whose shell is deeper than that."""
    body = shapes.torus(triangles=800, tiles=(4, 1))
    depth = 0.6 / float(body.scale.mean())
    built = shell.build(body, depth)
    assert (built.kept < 1).any()
    assert (volumes(built) > 0).all()
    assert built.kept.min() > shell.SHORTEST
    assert (built.uvz[..., 2].min() + depth).abs() < 1e-9  # all of the slab is still there, squeezed


def test_a_point_lies_on_one_side_only(rng):
    p, q = torch.randn(2, 1000, 2, generator=rng, dtype=torch.float64)
    p[:200] = q[:200] * torch.rand(200, 1, generator=rng, dtype=torch.float64)  # in line with the origin
    p[200:250] = 0
    ids = torch.randperm(2000, generator=rng).reshape(2, 1000)
    assert (shell.left_of(p, q, *ids) != shell.left_of(q, p, *ids.flip(0))).all()


def test_faces_of_no_area_are_left_out():
    flat = mesh.dress(
        torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [1, 1, 0]]),
        torch.tensor([[0, 1, 2], [0, 2, 3], [2, 4, 3]]),
        torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1], [1, 1]]),
    )
    built = shell.build(flat, 0.1)
    assert len(built.face) == 2
    assert (volumes(built) > 0).all()


def test_a_repeated_face_carries_one_prism():
    """Whatever corner it begins with; turned over it is another face."""
    from dataclasses import replace

    body = BODIES["torus"]()
    single = shell.build(body, 0.05)
    both = torch.cat([body.component, body.component])
    twice = shell.build(replace(body, faces=torch.cat([body.faces, body.faces.roll(1, 1)]), component=both), 0.05)
    assert torch.equal(single.face, twice.face)
    assert torch.equal(single.neighbour, twice.neighbour)
    turned = shell.build(replace(body, faces=torch.cat([body.faces, body.faces.flip(1)]), component=both), 0.05)
    assert len(turned.face) == 2 * len(single.face)


@pytest.mark.errors
def test_absurd_shells_are_refused():
    body = BODIES["plane"]()
    with pytest.raises(ConfigError, match="shell: h: expected a value from 0 to 1000"):
        shell.build(body, -1.0)
    from dataclasses import replace

    point = replace(body, vertices=torch.zeros_like(body.vertices))
    with pytest.raises(GeometryError, match="shell: expected at least one triangle with an area"):
        shell.build(point, 0.1)


def test_a_point_lies_in_the_tetrahedra_around_it(rng):
    own = shell.build(shapes.torus(triangles=300, tiles=(6, 2)), 0.1)
    for k in torch.randint(len(own.tets), (30,), generator=rng).tolist():
        share = torch.rand(4, generator=rng, dtype=torch.float64)
        share = share / share.sum()
        point = (share[:, None] * own.vertices[own.tets[k]]).sum(0)
        tets, place = shell.around(own, point)
        assert k in tets.tolist()
        torch.testing.assert_close(place[tets.tolist().index(k)], (share[:, None] * own.uvz[k]).sum(0))
    assert len(shell.around(own, torch.tensor([9.0, 0, 0]))[0]) == 0
    assert len(shell.around(own, torch.zeros(3))[0]) == 0
