import pytest
import torch

from torchmeso.errors import GeometryError
from torchmeso.geometry.cube_projection import project
from torchmeso.geometry.quads import edges
from torchmeso.geometry.shapes import sphere


@pytest.fixture(scope="module")
def ball():
    body = sphere(triangles=500)
    points, faces = torch.unique(body.vertices, dim=0, return_inverse=True)
    return points.double() + torch.tensor([3.0, -1, 2]), faces[body.faces]


@pytest.mark.parametrize("parts", [1, 4, 5])
def test_a_ball_lies_in_the_quads_of_a_cube(ball, parts):
    found = project(*ball, parts, middle=(3.0, -1.0, 2.0))
    assert len(found.quads) == 6 * parts**2
    around = edges(found.quads)
    assert bool((around.beside >= 0).all()) and not bool(around.along.any())
    closed = edges(found.faces)
    assert bool((closed.beside >= 0).all()) and not bool(closed.along.any())
    # Each corner of a triangle lies at its place: directions of the quad's own corners, at equal angles.
    p = found.vertices[found.faces] - torch.tensor([3.0, -1, 2])
    direction = p / p.abs().amax(-1, keepdim=True)
    grid = torch.tensor([(parts + 1) ** 2, parts + 1, 1])
    at = found.quads[..., None] // grid % (parts + 1)
    corner = torch.tan(torch.pi / 4 * (2 * at.double() / parts - 1))[found.cell]
    a, b = found.place.unbind(-1)
    south = corner[:, None, 0] + a[..., None] * (corner[:, None, 1] - corner[:, None, 0])
    north = corner[:, None, 3] + a[..., None] * (corner[:, None, 2] - corner[:, None, 3])
    torch.testing.assert_close(torch.lerp(south, north, b[..., None]), direction, rtol=0, atol=1e-6)


def test_places_run_anticlockwise_as_the_triangles_do(ball):
    place = project(*ball, 3).place
    one, other = place[:, 1] - place[:, 0], place[:, 2] - place[:, 0]
    assert float((one[:, 0] * other[:, 1] - one[:, 1] * other[:, 0]).min()) > -1e-9


@pytest.mark.errors
def test_a_middle_on_the_mesh_is_refused(ball):
    points, faces = ball
    with pytest.raises(GeometryError, match="cube: expected a middle that is not on the mesh"):
        project(points, faces, 2, middle=tuple(points[0].tolist()))
