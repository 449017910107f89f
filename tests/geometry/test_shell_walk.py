"""Faces that rays pass, against planes: the slow way to find where a ray leaves a tetrahedron."""

import pytest
import torch

from torchmeso.geometry import shapes, shell, shell_walk
from torchmeso.geometry.directions import normalize
from torchmeso.geometry.shell import OUTWARD


@pytest.fixture
def walked(rng):
    """A shell, and rays from a point inside of a tetrahedron each, taken back to before its face."""
    built = shell.build(shapes.torus(triangles=120, tiles=(6, 2)), 0.2)
    tet = torch.randint(len(built.tets), (500,), generator=rng)
    share = torch.rand(500, 4, generator=rng, dtype=torch.float64) + 0.05
    share = share / share.sum(1, keepdim=True)
    inside = (share[..., None] * built.vertices[built.tets[tet]]).sum(1)
    direction = normalize(torch.randn(500, 3, generator=rng, dtype=torch.float64))
    return built, tet, inside, direction


def planes_met(built, tet, origin, direction):
    """Distances (n, 4) to the planes of the faces opposite each corner, and whether each faces the ray."""
    p = built.vertices[built.tets[tet][:, OUTWARD]]
    normal = torch.linalg.cross(p[:, :, 1] - p[:, :, 0], p[:, :, 2] - p[:, :, 0])
    slope = (normal * direction[:, None]).sum(-1)
    return ((p[:, :, 0] - origin[:, None]) * normal).sum(-1) / slope, slope < 0


def test_rays_from_inside_leave_by_the_nearest_plane_ahead(walked):
    built, tet, inside, direction = walked
    through = shell_walk.prepare(built)
    rays, face, enters = shell_walk.enter(through, inside, direction, tet, torch.full_like(tet, -1))
    assert enters.all()
    t, facing = planes_met(built, tet, inside, direction)
    behind = torch.where(facing, t, -torch.inf)
    assert torch.equal(6 - face.corner.sum(0), behind.argmax(1))
    torch.testing.assert_close((face.shares() * face.t).sum(0), behind.amax(1), rtol=0, atol=1e-12)
    out, passed = shell_walk.leave(through, rays, tet, face)
    ahead = torch.where(facing, torch.inf, t)
    assert torch.equal(out, ahead.argmin(1))
    torch.testing.assert_close((passed.shares() * passed.t).sum(0), ahead.amin(1), rtol=0, atol=1e-12)


def test_texture_coordinates_are_the_shares_of_the_corners(walked):
    built, tet, inside, direction = walked
    through = shell_walk.prepare(built)
    rays, face, _ = shell_walk.enter(through, inside, direction, tet, torch.full_like(tet, -1))
    _, passed = shell_walk.leave(through, rays, tet, face)
    ends = [through.place(tet, f, f.shares()) for f in (face, passed)]
    ways = [(f.shares() * f.t).sum(0) for f in (face, passed)]
    middle = torch.lerp(*ends, (-ways[0] / (ways[1] - ways[0]))[:, None])  # the ray begins at 0, between them
    corner = built.vertices[built.tets[tet]]
    sides = (corner[:, 1:] - corner[:, :1]).mT
    others = torch.linalg.solve(sides, (inside - corner[:, 0])[..., None])[..., 0]
    share = torch.cat([1 - others.sum(1, keepdim=True), others], 1)
    torch.testing.assert_close(middle, (share[..., None] * built.uvz[tet]).sum(1), rtol=0, atol=1e-10)


def test_a_face_has_the_same_vertices_on_both_sides(walked):
    built, tet, inside, direction = walked
    through = shell_walk.prepare(built)
    rays, face, _ = shell_walk.enter(through, inside, direction, tet, torch.full_like(tet, -1))
    out, passed = shell_walk.leave(through, rays, tet, face)
    ahead = built.neighbour[tet, out]
    goes = (ahead >= 0).nonzero()[:, 0]
    on = shell_walk.go_on(through, tet, out, passed).select(goes)
    assert torch.equal(built.tets[ahead[goes]].gather(1, on.corner.T), passed.vertex[:, goes].T)


def test_a_ray_beside_its_face_is_moved_into_it():
    """By a face half as wide at most: what rounding does is far less."""
    built = shell.build(shapes.plane(triangles=2, tiles=(1, 1)), 0.2)
    bound = shell.boundary(built)
    k = int((bound.kind == shell.TOP).nonzero()[0, 0])
    corner = built.vertices[bound.faces[k]]
    edge = corner[:2].mean(0)
    away = edge - corner.mean(0)
    down = -normalize(torch.linalg.cross(corner[1] - corner[0], corner[2] - corner[0]))[None]
    for beside, enters in ((1e-12, True), (0.5, False)):
        origin = (edge + beside * away - down[0])[None]
        rays, face, found = shell_walk.enter(
            shell_walk.prepare(built), origin, down, bound.tet[k : k + 1], bound.corner[k : k + 1]
        )
        assert bool(found[0]) is enters
        if enters:
            assert float((rays.origin[:, 0] - origin[0]).norm()) < 1e-6
            assert (face.shares() >= 0).all()
