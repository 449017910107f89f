import math

import pytest
import torch

from torchmeso.errors import SizeError
from torchmeso.geometry import shapes
from torchmeso.geometry.camera import Camera, look_at
from torchmeso.geometry.rays import RayScene
from torchmeso.meso import generators
from torchmeso.meso.displace import displace, refine


def area(vertices, faces):
    p = vertices.double()[faces]
    return float(torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]).norm(dim=-1).sum()) / 2


def test_sheet_on_a_plane_is_the_plane_lower():
    plane = shapes.plane(size=(2, 2), tiles=(4, 4), triangles=8)
    got = displace(plane, generators.sheet(h=0.2))
    torch.testing.assert_close(got.vertices[:, 1], torch.full((len(got.vertices),), -0.2 * 0.5), rtol=0, atol=1e-6)
    assert area(got.vertices, got.faces) == pytest.approx(4, rel=1e-5)


def test_sheet_on_a_ball_is_a_smaller_ball():
    ball = shapes.torus(tiles=(16, 6), triangles=8000)
    got = displace(ball, generators.sheet(h=0.2))
    ring = torch.stack([got.vertices[:, 0], got.vertices[:, 2]], -1).norm(dim=-1) - 1.0
    tube = torch.stack([ring, got.vertices[:, 1]], -1).norm(dim=-1)
    scale = ball.scale
    # 2 pi / 16 around the ring, 2 pi 0.4 / 6 around the tube: about 0.4 units per tile.
    assert tube.min() > 0.4 - 0.2 * scale.max() - 0.01
    assert tube.max() < 0.4 - 0.2 * scale.min() + 0.01


def test_texture_area_is_kept():
    """Cutting and tiling lose nothing: the floor and the tops of bricks together cover each tile of the base once."""
    body = shapes.torus(tiles=(7, 3), triangles=600)
    got = displace(body, generators.sheet())
    uv = got.uv.double()[got.faces]
    e1, e2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    covered = float((e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]).abs().sum()) / 2
    assert covered == pytest.approx(21, rel=1e-5)


@pytest.mark.parametrize("name", ["brick", pytest.param("weave", marks=pytest.mark.slow), "sheet"])
def test_no_cracks(name):
    """From outside, every ray well inside the outline of a closed body meets the mesostructure."""
    body = shapes.torus(tiles=(6, 2), triangles=1500)
    got = displace(body, generators.GENERATORS[name]())
    eye, axes = look_at(*(torch.tensor(x, dtype=torch.float64) for x in ((0.0, 2.2, 3.2), (0.0, 0, 0), (0.0, 1, 0))))
    view = Camera(eye=eye, axes=axes, width=150, height=150)
    origin, direction, _ = view.rays(view.pixel_centres().reshape(-1, 2))
    base = RayScene(body.vertices, body.faces).first_hit(origin, direction).face.reshape(150, 150) >= 0
    inner = -torch.nn.functional.max_pool2d(-base.float()[None], 21, 1, 10)[0] > 0
    hit = RayScene(got.vertices, got.faces).first_hit(origin, direction).face.reshape(150, 150) >= 0
    assert inner.sum() > 200
    assert hit[inner].all()


def test_parts_and_places_stay_with_their_triangles():
    meso = generators.brick()
    got = displace(shapes.plane(size=(1, 1), tiles=(2, 2)), meso)
    assert set(got.part.tolist()) == set(meso.geometry.part.tolist())
    world = got.vertices[:, [0, 2]]
    expected = torch.stack([(world[:, 0] + 0.5) * 2, (0.5 - world[:, 1]) * 2], -1)
    torch.testing.assert_close(got.uv, expected, rtol=0, atol=1e-5)


def test_refined_surface_is_the_same_surface():
    tile = generators.brick().geometry
    fine = refine(tile, 0.05)
    p = fine.vertices[fine.faces]
    assert (p.roll(-1, 1) - p).norm(dim=-1).max() <= 0.05
    assert area(fine.vertices, fine.faces) == pytest.approx(area(tile.vertices, tile.faces), rel=1e-5)


def test_refinement_converges():
    """Finer pieces follow the bend of the prisms: the area moves less and less."""
    body = shapes.torus(tiles=(4, 2), triangles=400)
    areas = [
        area(g.vertices, g.faces) for g in (displace(body, generators.brick(), max_edge=e) for e in (0.4, 0.2, 0.1))
    ]
    assert abs(areas[2] - areas[1]) < 0.6 * abs(areas[1] - areas[0])
    assert math.isclose(areas[2], areas[1], rel_tol=2e-3)


@pytest.mark.errors
def test_absurd_sizes_are_refused():
    with pytest.raises(SizeError, match="take fewer tiles"):
        displace(shapes.plane(tiles=(3000, 3000)), generators.weave())
