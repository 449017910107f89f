import pytest
import torch

from torchmeso.errors import GeometryError
from torchmeso.geometry.polycube import project
from torchmeso.geometry.quads import edges
from torchmeso.geometry.shapes import sphere


def ball():
    body = sphere(triangles=400)
    points, faces = torch.unique(body.vertices, dim=0, return_inverse=True)
    points = points.double()
    return points, faces[body.faces], points / points.abs().amax(1, keepdim=True) / 2


def uv_area(found):
    one, other = found.place[:, 1] - found.place[:, 0], found.place[:, 2] - found.place[:, 0]
    return (one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]) / 2


@pytest.mark.parametrize("parts", [1, 3])
def test_a_ball_on_one_cube(parts):
    points, faces, places = ball()
    found = project(points, faces, places + torch.tensor([3.0, -2, 0]), parts)
    assert len(found.quads) == 6 * parts**2
    around = edges(found.quads)
    assert bool((around.beside >= 0).all()) and not bool(around.along.any())
    closed = edges(found.faces)
    assert bool((closed.beside >= 0).all()) and not bool(closed.along.any())
    # Every square is covered once, the right way round.
    area = torch.zeros(len(found.quads), dtype=torch.float64).index_add_(0, found.cell, uv_area(found))
    torch.testing.assert_close(area, torch.ones_like(area), rtol=0, atol=1e-4)
    assert float(uv_area(found).min()) > -1e-5


def test_places_beside_their_squares_are_moved_onto_them():
    points, faces, places = ball()
    near_edges = (places.abs() > 0.4).sum(1) > 1
    found = project(points, faces, torch.where(near_edges[:, None], 0.97 * places, places))
    assert len(found.quads) == 6
    area = torch.zeros(6, dtype=torch.float64).index_add_(0, found.cell, uv_area(found))
    torch.testing.assert_close(area, torch.ones_like(area), rtol=0, atol=0.02)


def test_an_edge_that_is_bent_inwards():
    """Two squares of an L: triangles run from the floor to the wall."""
    along, across = torch.linspace(0, 2, 7, dtype=torch.float64), torch.linspace(0, 1, 4, dtype=torch.float64)
    x, y = torch.meshgrid(along, across, indexing="ij")
    flat = torch.stack([x, y, 0 * x], -1).reshape(-1, 3)
    places = torch.stack([flat[:, 0].clamp(max=1), flat[:, 1], (flat[:, 0] - 1).clamp(min=0)], -1) + 0.5
    number = torch.arange(28).reshape(7, 4)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = torch.stack([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)]).reshape(-1, 3)
    found = project(flat, faces, places)
    assert len(found.quads) == 2 and int((edges(found.quads).beside >= 0).sum()) == 2
    assert float(uv_area(found).sum()) == pytest.approx(2)


@pytest.mark.errors
def test_what_is_no_polycube_map_is_refused():
    points, faces, places = ball()
    with pytest.raises(GeometryError, match="polycube: expected triangles that lie flat on cubes"):
        project(points, faces, 0.7 * places)
