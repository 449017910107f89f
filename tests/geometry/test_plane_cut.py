import torch

from torchmeso.geometry import plane_cut
from torchmeso.geometry.quads import edges
from torchmeso.geometry.shapes import sphere


def area(pieces):
    p = pieces.vertices[pieces.faces]
    return torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]).norm(dim=-1) / 2


def test_each_piece_lies_on_one_side_and_nothing_is_lost_or_torn(rng):
    body = sphere(triangles=200)
    points, faces = torch.unique(body.vertices, dim=0, return_inverse=True)
    pieces = whole = plane_cut.whole(points.double(), faces[body.faces])
    normals = torch.randn(4, 3, generator=rng, dtype=torch.float64)
    for normal in normals:
        pieces = plane_cut.cut(pieces, pieces.vertices @ normal, slack=1e-12)
    for normal in normals:
        d = (pieces.vertices @ normal)[pieces.faces]
        assert bool(((d > -1e-9).all(1) | (d < 1e-9).all(1)).all())
    assert len(pieces.faces) > len(whole.faces) + 50
    torch.testing.assert_close(
        torch.zeros(len(whole.faces), dtype=torch.float64).index_add_(0, pieces.source, area(pieces)), area(whole)
    )
    found = edges(pieces.faces)
    assert bool((found.beside >= 0).all()) and not bool(found.along.any())  # still closed, the same way round


def test_corners_on_the_cut_and_triangles_left_out():
    points = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=torch.float64)
    whole = plane_cut.whole(points, torch.tensor([[0, 1, 2], [0, 2, 3]]))
    along_diagonal = plane_cut.cut(whole, points[:, 0] - points[:, 1])
    assert along_diagonal.faces.equal(whole.faces)
    across = plane_cut.cut(whole, points.sum(1) - 1, torch.tensor([True, True]))
    assert len(across.faces) == 4 and across.source.tolist() == [0, 0, 1, 1]
    assert plane_cut.cut(whole, points[:, 0] - 0.5, torch.tensor([False, False])).faces.equal(whole.faces)
