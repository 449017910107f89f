import numpy as np
import pytest
import torch

from tests.render.test_rasterize import KINDS, camera, scene
from tests.tolerances import OPENCL_DEPTH
from torchmeso.geometry import shapes
from torchmeso.render.device_raster import DeviceRaster, upload_mesh
from torchmeso.render.rasterize import rasterize


def drawn(view, points, faces):
    """The fragments of the kernels, and of torch with equal depths put in the order of faces."""
    exact = rasterize(view, points, faces)
    raster = DeviceRaster(upload_mesh(points, faces), view.width, view.height)
    return exact, exact.triangles.face[exact.triangle], raster.lists(view)


@pytest.mark.parametrize("kind", KINDS)
def test_the_same_fragments(kind, device):
    rng = np.random.default_rng(7)
    for _ in range(8):
        view, points, faces = scene(kind, rng)
        exact, face, fast = drawn(view, torch.from_numpy(points), torch.from_numpy(faces))
        assert torch.equal(exact.pixel, fast.pixel)
        # Pieces of one cut face share its number, so fragments are compared as sets of (pixel, face).
        order, order_2 = (np.lexsort((f, exact.pixel)) for f in (face, fast.face))
        assert torch.equal(face[order], fast.face[order_2])
        assert ((exact.t - fast.t).abs() / exact.t).max() < OPENCL_DEPTH["rtol"] if len(fast.t) else True
        same = fast.pixel[1:] == fast.pixel[:-1]
        assert (fast.t.diff()[same] >= -1e-6 * fast.t[1:][same]).all()


def test_orders_coincident_faces_by_number(device):
    corners = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]]).repeat(20, 1)
    _, _, fast = drawn(camera(), corners, torch.arange(60).reshape(20, 3))
    same = fast.pixel[1:] == fast.pixel[:-1]
    assert len(fast.t) % 20 == 0
    assert (fast.face.diff()[same] == 1).all()


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (65, 63), (130, 70)])
def test_pictures_of_any_size(size, device):
    mesh = shapes.torus_knot(triangles=2000)
    exact, face, fast = drawn(camera(*size), mesh.vertices, mesh.faces)
    assert torch.equal(exact.pixel, fast.pixel)
    assert torch.equal(face, fast.face)


def test_drops_nothing(device):
    """Three hundred layers everywhere: more room is asked for than there was at first."""
    z = torch.linspace(-0.5, 0.5, 300)
    corner = torch.tensor([[-3.0, -3, 0], [3, -3, 0], [0, 4, 0]])
    vertices = (corner[None] + torch.stack([0 * z, 0 * z, z], -1)[:, None]).reshape(-1, 3)
    faces = torch.arange(900).reshape(-1, 3)
    exact, face, fast = drawn(camera(projection="orthographic"), vertices, faces)
    assert exact.start.diff().max() == 300
    assert torch.equal(exact.pixel, fast.pixel)
    assert torch.equal(face, fast.face)


def test_makes_room_for_triangles_that_are_cut(device):
    """More faces cross the near plane than there was room for at first."""
    rng = np.random.default_rng(3)
    view = camera()
    corners = view.eye.numpy() + rng.normal(size=(3000, 3, 3)) * 0.3
    exact, face, fast = drawn(view, torch.from_numpy(corners.reshape(-1, 3)), torch.arange(9000).reshape(-1, 3))
    assert torch.equal(exact.pixel, fast.pixel)
    assert torch.equal(face.bincount(minlength=3000), fast.face.bincount(minlength=3000))


def test_with_nothing_to_draw(device):
    _, _, fast = drawn(camera(), torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long))
    assert len(fast.t) == 0


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_objects_beside_the_view_and_around_the_eye(projection, device):
    """A hundred objects at random: those left out have no fragment, and are the ones beyond one side of the view."""
    rng = np.random.default_rng(5)
    view = camera(projection=projection, distance=1.5)
    middle = rng.normal(size=(100, 1, 3)) * 2
    points = torch.from_numpy((middle + rng.normal(size=(100, 12, 3)) * 0.2).reshape(-1, 3))
    faces = torch.arange(1200).reshape(-1, 3)
    owner = torch.arange(400, dtype=torch.int32) // 4
    raster = DeviceRaster(upload_mesh(points, faces, torch.stack([2 * torch.ones_like(owner), owner], 1)), 64, 64)
    exact, fast = rasterize(view, points, faces), raster.lists(view)
    assert torch.equal(exact.pixel, fast.pixel)
    low, high = (f(points.reshape(100, 12, 3), 1) for f in (torch.amin, torch.amax))
    which = torch.stack(torch.meshgrid(*[torch.tensor([0, 1])] * 3, indexing="ij"), -1).reshape(8, 3)
    x, y, w, depth = view.project(low[:, None] + which * (high - low)[:, None]).unbind(-1)
    outside = torch.stack([x < -w, x > (view.width + 1) * w, y < -w, y > (view.height + 1) * w, depth < view.near])
    beside = outside.all(-1).any(0)
    count = raster.views.counts()[0]
    assert 0 < count["beside"] == 4 * int(beside.sum()) < 400
    assert count["near_bodies"] == (~beside & (depth <= view.near).any(-1)).any()


def test_nothing_is_cut_where_nothing_can_cross(device):
    """The kernel for faces that cross the near plane or the guard band runs only where some may."""
    mesh = shapes.torus_knot(triangles=2000)
    raster = DeviceRaster(upload_mesh(mesh.vertices, mesh.faces), 64, 64)
    for distance, cut in ((9.0, False), (0.9, True)):
        raster.draw(camera(distance=distance))
        assert raster.views.may_cut == cut
        assert (raster.views.counts()[0]["crossing"] > 0) == cut
