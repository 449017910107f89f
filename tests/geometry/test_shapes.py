import math

import pytest
import torch

from torchmeso.errors import ConfigError
from torchmeso.geometry import components, shapes
from torchmeso.geometry.directions import dot


def area(mesh):
    p = mesh.vertices.double()[mesh.faces]
    return torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]).norm(dim=-1).sum() / 2


@pytest.mark.parametrize(
    ("name", "expected_area", "expected_volume"),
    [
        ("cylinder", 2 * math.pi * 2 + 2 * math.pi, 2 * math.pi),
        ("sphere", 4 * math.pi, 4 / 3 * math.pi),
        ("torus", 4 * math.pi**2 * 0.4, 2 * math.pi**2 * 0.16),
    ],
)
def test_area_and_volume(name, expected_area, expected_volume):
    mesh = shapes.SHAPES[name](triangles=40_000)
    assert float(area(mesh)) == pytest.approx(expected_area, rel=2e-3)
    volume = components.find(mesh.vertices, mesh.faces).volume
    assert float(volume[0]) == pytest.approx(expected_volume, rel=2e-3)


def test_knot_has_the_papers_triangle_count():
    assert len(shapes.torus_knot().faces) == 11_952


@pytest.mark.parametrize("name", list(shapes.SHAPES))
def test_normals_and_handedness(name):
    mesh = shapes.SHAPES[name](triangles=4_000)
    p = mesh.vertices[mesh.faces]
    face_normal = torch.nn.functional.normalize(torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), dim=-1)
    assert dot(face_normal[:, None], mesh.normals[mesh.faces]).min() > 0.8
    assert (mesh.sign == 1).all()
    assert dot(mesh.normals, mesh.tangents).abs().max() < 1e-5


def test_texture_scale_of_a_cylinder():
    mesh = shapes.cylinder(tiles=(8, 3), triangles=20_000)
    expected = math.sqrt((2 * math.pi * 2) / 24)
    side = mesh.normals[:, 1].abs() < 0.1
    assert mesh.scale[side].median() == pytest.approx(expected, rel=1e-3)


def test_triangle_counts_are_near_what_is_asked():
    for name in ("sphere", "torus", "torus_knot", "plane"):
        for asked in (600, 3_200, 50_000):
            assert len(shapes.SHAPES[name](triangles=asked).faces) == pytest.approx(asked, rel=0.12), (name, asked)


def test_wrapped_seams_share_positions_bit_for_bit():
    mesh = shapes.torus(triangles=600)
    assert components.weld(mesh.vertices).max() + 1 == 300


@pytest.mark.errors
@pytest.mark.parametrize(
    ("make", "message"),
    [(lambda: shapes.plane(size=(1.0, 0.0)), r"shape\.depth"), (lambda: shapes.sphere(radius=-1.0), r"shape\.radius"),
     (lambda: shapes.cylinder(height=float("nan")), r"shape\.height"), (lambda: shapes.torus(tube=0.0), r"shape\.tube"),
     (lambda: shapes.torus_knot(p=0), r"shape\.p: expected a value from 1")],
)  # fmt: skip
def test_sizes_that_make_no_shape(make, message):
    with pytest.raises(ConfigError, match=message):
        make()
