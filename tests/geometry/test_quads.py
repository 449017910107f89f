import pytest
import torch

from tests.synthesize.test_quad_tiling import CUBE, grid
from torchmeso.errors import ConfigError, GeometryError
from torchmeso.geometry.quads import QuadMesh, edges, mended, patches, split

POINTS = torch.tensor([[x, y, z] for z in (0.0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))], dtype=torch.float64)
BOX = QuadMesh(POINTS, CUBE)


def volume(vertices, faces):
    p = vertices[faces]
    return float((p[:, 0] * torch.linalg.cross(p[:, 1], p[:, 2])).sum() / 6)


def test_a_mesh_in_order_stays_as_it_is():
    found, turned = mended(BOX)
    assert turned == 0 and found.quads.equal(CUBE)
    assert volume(found.vertices, patches(found).faces) == pytest.approx(1)


@pytest.mark.parametrize("wrong", [[2], [0, 3], [0, 1, 2, 3, 4, 5], [0, 1, 2, 3, 5]])
def test_quads_that_are_turned_over_are_turned_back(wrong):
    quads = CUBE.clone()
    quads[wrong] = quads[wrong].flip(1)
    found, turned = mended(QuadMesh(POINTS, quads))
    assert turned == len(wrong) and not bool(edges(found.quads).along.any())
    assert volume(found.vertices, patches(found).faces) == pytest.approx(1)
    assert found.quads[:, 0].equal(quads[:, 0])  # begun where they were


def test_sheets_keep_the_side_of_most_of_their_quads():
    quads = grid(3, 4, closed=False)
    quads[[0, 5]] = quads[[0, 5]].flip(1)
    points = torch.zeros(20, 3, dtype=torch.float64)
    found, turned = mended(QuadMesh(points, quads))
    assert turned == 2 and sorted(found.quads[0].tolist()) == sorted(quads[0].tolist())
    assert found.quads[1].equal(quads[1])


@pytest.mark.parametrize("parts", [1, 2, 5])
def test_small_quads_meet_and_fill_the_large_ones(parts):
    found = split(BOX, parts)
    assert len(found.mesh.quads) == 6 * parts**2
    around = edges(found.mesh.quads)
    assert bool((around.beside >= 0).all()) and not bool(around.along.any())
    pieces = patches(found.mesh, 2)
    assert volume(pieces.vertices, pieces.faces) == pytest.approx(1)
    assert found.quad.bincount().tolist() == [parts**2] * 6


def test_places_in_quads_are_bilinear(rng):
    bent = BOX._replace(vertices=POINTS + 0.3 * torch.rand(8, 3, generator=rng, dtype=torch.float64))
    found = patches(bent, 3)
    a, b = (x[..., None] for x in found.place.unbind(-1))
    p = bent.vertices[found.quads[found.cell]][:, None]
    expected = torch.lerp(torch.lerp(p[:, :, 0], p[:, :, 1], a), torch.lerp(p[:, :, 3], p[:, :, 2], a), b)
    torch.testing.assert_close(found.vertices[found.faces], expected)
    closed = edges(found.faces)
    assert bool((closed.beside >= 0).all()) and not bool(closed.along.any())


@pytest.mark.errors
def test_what_is_no_surface_of_quads_is_refused():
    moebius = torch.tensor([[0, 1, 3, 2], [2, 3, 5, 4], [4, 5, 0, 1]])
    with pytest.raises(GeometryError, match="expected a surface with two sides"):
        mended(QuadMesh(POINTS, moebius))
    with pytest.raises(GeometryError, match=r"expected four different corners, got \[0, 1, 0, 2\] at face 1"):
        mended(QuadMesh(POINTS, torch.tensor([[4, 5, 6, 7], [0, 1, 0, 2]])))
    with pytest.raises(GeometryError, match="at most two at an edge, got more beside face 0"):
        mended(QuadMesh(POINTS, torch.tensor([[0, 1, 2, 3], [1, 0, 4, 5], [0, 1, 6, 7]])))
    with pytest.raises(GeometryError, match="expected finite positions"):
        mended(QuadMesh(POINTS / 0, CUBE))
    with pytest.raises(ConfigError, match=r"quads.parts: expected a value from 1 to 64, got 0"):
        split(BOX, 0)
