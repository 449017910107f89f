import sys

import numpy as np
import pytest
import torch

from torchmeso.errors import ConfigError, GeometryError
from torchmeso.geometry import mesh, shapes
from torchmeso.geometry.unwrap import UnwrapOptions, _chart_of, find_seams, unwrap

pytest.importorskip("xatlas")


def test_one_scale_all_over():
    ball = shapes.sphere(triangles=800)
    atlas = unwrap(ball.vertices, ball.faces, tile_size=0.25)
    dressed = mesh.dress(atlas.vertices, atlas.faces, atlas.uv)
    assert float(dressed.scale.median()) == pytest.approx(0.25, rel=0.05)
    assert bool(dressed.closed.all())
    assert torch.equal(atlas.vertices[atlas.faces], ball.vertices[ball.faces])


def test_seams_are_measured():
    """A cube's atlas cuts some of its edges, never more than there are: 12 edges of length 1 and 6 diagonals."""
    corners = torch.tensor([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
    atlas = unwrap(corners, faces, tile_size=1.0)
    assert atlas.seams.edges == pytest.approx(12 + 6 * 2**0.5, rel=1e-5)
    assert 5 <= atlas.seams.length <= 12 + 1e-5


def test_charts_have_one_scale_and_direction_and_are_not_mirrored():
    """Whatever xatlas did while packing: the signed area of every triangle is its world area, and +v goes up."""
    ball = shapes.sphere(triangles=3000)
    atlas = unwrap(ball.vertices, ball.faces, tile_size=0.5)
    p, q = atlas.vertices[atlas.faces].double(), atlas.uv[atlas.faces].double()
    e1, e2 = q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]
    flat = (e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]) / 2
    world = torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]).norm(dim=-1) / 2
    assert (flat > 0).double().mean() > 0.99
    assert float(flat.sum()) * 0.25 == pytest.approx(float(world.sum()), rel=1e-3)
    chart = _chart_of(atlas.faces, len(atlas.vertices))[atlas.faces[:, 0]]
    for k in range(atlas.charts):
        mine = chart == k
        assert float(flat[mine].sum()) * 0.25 == pytest.approx(float(world[mine].sum()), rel=2e-3)
    dressed = mesh.dress(atlas.vertices, atlas.faces, atlas.uv)
    area, sideways = world, (dressed.tangents[dressed.faces].mean(1)[:, 1] * world).double()
    for k in range(atlas.charts):
        mine = chart == k
        assert abs(float(sideways[mine].sum())) < 0.05 * float(area[mine].sum())  # the tangent's mean lies level
    assert mesh.anisotropy(dressed) < 1.1


def test_packed_charts_lie_beside_each_other():
    ball = shapes.sphere(triangles=800)
    atlas = unwrap(ball.vertices, ball.faces, tile_size=1.0, options=UnwrapOptions(packed=True, iterations=1))
    assert float(atlas.uv.min()) >= 0
    assert float(atlas.uv.max()) <= 1


def test_jumps_of_whole_tiles_are_no_seams():
    """A torus whose texture repeats a whole number of times goes on around it; half a tile more does not."""
    for tiles, share in (((4, 2), 0.0), ((4.5, 2), 1.0)):
        body = shapes.torus(tiles=tiles, triangles=400)
        ring = 2 * torch.pi * 0.4  # where both ends of u meet
        found = find_seams(body.vertices, body.faces, body.uv)
        assert found.length == pytest.approx(share * ring, rel=0.05)


@pytest.mark.errors
def test_refusals(monkeypatch):
    ball = shapes.sphere(triangles=100)
    with pytest.raises(ConfigError, match=r"unwrap\.tile_size"):
        unwrap(ball.vertices, ball.faces, tile_size=0)
    with pytest.raises(ConfigError, match=r"unwrap\.iterations: expected a value from 1 to 64, got 0"):
        UnwrapOptions(iterations=0)
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(GeometryError, match=r"install the extra: torchmeso\[mesh\]"):
        unwrap(ball.vertices, ball.faces, tile_size=1)


@pytest.mark.errors
def test_triangles_that_come_back_in_another_number(monkeypatch):
    ball = shapes.sphere(triangles=100)

    class Losing:
        width = height = 1

        def add_mesh(self, vertices, faces):
            self.vertices, self.faces = vertices, faces

        def generate(self, *_):
            pass

        def __getitem__(self, _):
            return np.arange(len(self.vertices)), self.faces[1:], np.zeros((len(self.vertices), 2))

    monkeypatch.setattr(pytest.importorskip("xatlas"), "Atlas", Losing)
    with pytest.raises(GeometryError, match="triangles back, got"):
        unwrap(ball.vertices, ball.faces, tile_size=1)
