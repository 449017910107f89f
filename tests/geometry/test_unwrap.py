import sys

import numpy as np
import pytest
import torch

from torchmeso.errors import ConfigError, GeometryError
from torchmeso.geometry import mesh, shapes
from torchmeso.geometry.unwrap import unwrap

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
    assert atlas.edge_length == pytest.approx(12 + 6 * 2**0.5, rel=1e-5)
    assert 5 <= atlas.seam_length <= 12 + 1e-5


@pytest.mark.errors
def test_refusals(monkeypatch):
    ball = shapes.sphere(triangles=100)
    with pytest.raises(ConfigError, match=r"unwrap\.tile_size"):
        unwrap(ball.vertices, ball.faces, tile_size=0)
    monkeypatch.setitem(sys.modules, "xatlas", None)
    with pytest.raises(GeometryError, match=r"install the extra: torchmeso\[mesh\]"):
        unwrap(ball.vertices, ball.faces, tile_size=1)


@pytest.mark.errors
def test_triangles_that_come_back_in_another_number(monkeypatch):
    ball = shapes.sphere(triangles=100)

    def lose(vertices, faces):
        return np.arange(len(vertices)), faces[1:], np.zeros((len(vertices), 2))

    monkeypatch.setattr(pytest.importorskip("xatlas"), "parametrize", lose)
    with pytest.raises(GeometryError, match="triangles back, got"):
        unwrap(ball.vertices, ball.faces, tile_size=1)
