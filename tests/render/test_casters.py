from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.data.test_gdm import layered
from tests.render.scenes import moved, scene
from torchmeso.geometry import mesh, shapes
from torchmeso.render import casters
from torchmeso.render.casters import corners_of, extents
from torchmeso.render.scene import Material, Object, Scene, assemble

FROM_ABOVE = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


def turned(shape, x_deg):
    angle = torch.deg2rad(torch.tensor(x_deg))
    matrix = torch.eye(4)
    matrix[1, 1], matrix[1, 2], matrix[2, 1], matrix[2, 2] = angle.cos(), -angle.sin(), angle.sin(), angle.cos()
    return mesh.transform(shape, matrix)


def corners(*meshes):
    return corners_of(assemble(scene(*meshes)))


def test_only_open_sheets_in_one_plane_are_flat():
    """A cylinder's side is open too, and its normals sum up to nothing."""
    tube, ball = shapes.cylinder(triangles=200), shapes.sphere(triangles=200)
    sheet = moved(turned(shapes.plane(triangles=50), 33.0), x=5.0, y=2.0)
    bent = shapes.plane(triangles=50)
    vertices = bent.vertices.clone()
    vertices[7, 1] += 1e-3
    bent = replace(bent, vertices=vertices)
    found = corners(tube, sheet, ball, bent)
    assert [x.shape[1] for x in found.flats] == [len(sheet.vertices)]
    assert found.bodies.shape[1] == len(tube.vertices) + len(ball.vertices) + len(bent.vertices)


def test_of_a_ball_on_a_wide_floor_the_ball_is_covered():
    whole, cast = extents(corners(shapes.plane(size=(40, 40)), moved(shapes.sphere(radius=0.5), x=3, y=1)), FROM_ABOVE)
    assert whole.high[:2] == pytest.approx([20, 20])
    assert cast.low[:2] == pytest.approx([2.5, -0.5], abs=0.01)
    assert cast.high[:2] == pytest.approx([3.5, 0.5], abs=0.01)


def test_sheets_are_covered_where_one_is_over_another():
    awning = moved(shapes.plane(size=(4, 2)), x=10, y=1)
    _, cast = extents(corners(shapes.plane(size=(20, 20)), awning), FROM_ABOVE)
    assert cast.low[:2] == pytest.approx([8, -1])
    assert cast.high[:2] == pytest.approx([10, 1])  # beyond, the awning is over nothing


def test_sheets_side_by_side_and_a_sheet_alone_shadow_nothing():
    for sheets in ([shapes.plane()], [shapes.plane(), moved(shapes.plane(), x=5)]):
        _, cast = extents(corners(*sheets), FROM_ABOVE)
        assert (cast.high == cast.low).all()


def test_all_but_the_largest_of_many_sheets_count_as_bodies(monkeypatch):
    monkeypatch.setattr(casters, "MOST_FLATS", 2)
    sizes = (1.0, 4.0, 2.0, 3.0)
    found = corners(*(moved(shapes.plane(size=(s, s)), y=k) for k, s in enumerate(sizes)))
    assert [float(np.ptp(x[0])) for x in found.flats] == pytest.approx([4, 3])
    assert found.bodies.shape[1] == 8


def test_a_shell_on_a_sheet_is_a_body():
    """What stands in it casts shadows on the rest."""
    material = Material(gdm=layered(-0.2))
    floor = Object(mesh=shapes.plane(size=(4, 4), triangles=8), material=material)
    found = corners_of(assemble(Scene(objects=(floor,), lights=())))
    assert not found.flats
    assert float(np.ptp(found.bodies[1])) > 0
