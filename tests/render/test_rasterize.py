import math

import numpy as np
import pytest
import torch

from tests.reference.rasterize import a_buffer
from torchmeso.geometry import shapes
from torchmeso.geometry.camera import Camera, look_at
from torchmeso.geometry.rays import RayScene
from torchmeso.render import rasterize as module
from torchmeso.render.rasterize import barycentric, rasterize, set_up

KINDS = ("shared edges", "slivers", "coincident faces", "behind the eye", "soup", "on pixel centres")


def camera(width=64, height=64, distance=3.0, projection="perspective"):
    eye, axes = look_at(*torch.tensor([[0.3, 0.5, 1.0], [0, 0, 0], [0, 1, 0]], dtype=torch.float64) * distance)
    return Camera(eye=eye, axes=axes, width=width, height=height, projection=projection, view_height=distance * 0.8)


def scene(kind, rng):
    """A few to 400 triangles with one kind of trouble."""
    n = int(rng.integers(1, 401))
    view = camera(projection=rng.choice(["perspective", "perspective", "orthographic"]))
    if kind == "on pixel centres":
        eye, axes = look_at(*torch.tensor([[0.0, 0, 9], [0, 0, 0], [0, 1, 0]], dtype=torch.float64))
        view = Camera(eye=eye, axes=axes, projection="orthographic", view_height=64.0, width=64, height=64)
        corners = rng.integers(-20, 21, (n, 3, 3)) * np.array([1.0, 1.0, 0.1]) + np.array([0.5, 0.5, 0.0])
        return view, corners.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3)
    corners = rng.normal(size=(n, 1, 3)) * 0.5 + rng.normal(size=(n, 3, 3)) * rng.choice([0.05, 0.3, 1.0])
    if kind == "shared edges":
        side = max(2, math.isqrt(n // 2))
        grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, side + 1)] * 2), -1).reshape(-1, 2)
        points = np.concatenate([grid, 0.2 * rng.normal(size=(len(grid), 1))], 1)
        points[:, :2] += rng.normal(size=(len(grid), 2)) * rng.choice([0.0, 0.05])
        i = np.arange((side + 1) ** 2).reshape(side + 1, side + 1)
        a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
        return view, points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    if kind == "slivers":
        corners[:, 2] = corners[:, 0] + (corners[:, 1] - corners[:, 0]) * rng.uniform(-1, 2, (n, 1))
        corners[:, 2] += rng.normal(size=(n, 3)) * rng.choice([0, 1e-6, 1e-3, 1e-2, 3e-2])
        corners[:, 1] += (corners[:, 1] - corners[:, 0]) * 5
    if kind == "coincident faces":
        half = max(1, n // 2)
        corners = np.concatenate([corners[:half], corners[:half][:, rng.permutation(3)]])
        corners[:half, 2] = corners[:half, 2] * rng.choice([1.0, 1.0, 0.5])
    if kind == "behind the eye":
        corners = corners + view.eye.numpy() * rng.uniform(0.6, 1.4, (n, 1, 1))
    return view, corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3)


def compare(view, points, faces):
    """Return (fragments, wrong, order ties) of the rasteriser against the A-buffer."""
    layers = rasterize(view, torch.from_numpy(points), torch.from_numpy(faces))
    truth = a_buffer(view, layers.triangles)
    if len(truth.pixel) != len(layers.pixel) or not np.array_equal(truth.pixel, layers.pixel.numpy()):
        return len(truth.pixel), abs(len(truth.pixel) - len(layers.pixel)) + 1, 0
    t, mine = layers.t.numpy().astype(np.float64), layers.triangle.numpy()
    differs = mine != truth.triangle
    # A tie: within a run of nearly equal depths the order may differ, the set of triangles may not.
    near = np.abs(np.diff(truth.t)) <= 2e-7 * truth.t[1:]
    near &= truth.pixel[1:] == truth.pixel[:-1]
    run = np.concatenate([[0], np.cumsum(~near)])[: len(mine)]
    same_set = np.array_equal(mine[np.lexsort((mine, run))], truth.triangle[np.lexsort((truth.triangle, run))])
    wrong_depth = np.abs(t - truth.t) > 2e-7 * truth.t
    tie = differs & (np.concatenate([[False], near]) | np.concatenate([near, [False]]))
    return len(t), int((differs & ~tie).sum() + wrong_depth.sum() + (not same_set)), int(tie.sum())


@pytest.mark.parametrize("kind", KINDS)
def test_layers_equal_the_a_buffer(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    counts = np.array([compare(*scene(kind, rng)) for _ in range(12)])
    assert counts[:, 1].sum() == 0
    assert counts[:, 0].sum() > 1_000


@pytest.mark.slow
def test_a_thousand_scenes_equal_the_a_buffer():
    """200 scenes of each kind, a million fragments, none wrong."""
    fragments = wrong = 0
    for seed, kind in enumerate(KINDS):
        rng = np.random.default_rng(100 + seed)
        counts = np.array([compare(*scene(kind, rng)) for _ in range(200)])
        fragments, wrong = fragments + counts[:, 0].sum(), wrong + counts[:, 1].sum()
    assert fragments >= 1_000_000
    assert wrong == 0


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_closed_meshes_give_every_ray_as_many_fronts_as_backs(projection):
    for name in ("torus", "torus_knot", "cylinder", "sphere"):
        mesh = shapes.SHAPES[name](triangles=1500)
        layers = rasterize(camera(150, 100, projection=projection), mesh.vertices, mesh.faces)
        sign = torch.where(layers.triangles.front[layers.triangle], 1, -1)
        balance = torch.zeros(150 * 100, dtype=torch.long).index_add_(0, layers.pixel, sign)
        assert (balance == 0).all(), name


def test_first_layer_is_what_a_ray_hits():
    mesh = shapes.torus_knot(triangles=4000)
    view = camera(120, 90)
    layers = rasterize(view, mesh.vertices, mesh.faces)
    xy = view.pixel_centres().reshape(-1, 2)
    o, d, _ = view.rays(xy)
    hits = RayScene(mesh.vertices, mesh.faces).first_hit(o, d)
    covered = layers.start.diff() > 0
    assert (covered != (hits.face >= 0)).float().mean() < 1e-3  # pixels whose centre lies within 1/512 px of an edge
    both = covered & (hits.face >= 0)
    first = layers.start[:-1][both]
    close = (layers.t[first] - hits.t[both]).abs() < 2e-3 * hits.t[both]
    assert close.float().mean() > 0.999
    assert (layers.triangle[first] == hits.face[both]).float().mean() > 0.995


def test_barycentric_coordinates_are_perspective_correct():
    mesh = shapes.torus(triangles=600)
    for projection in ("perspective", "orthographic"):
        view = camera(100, 80, projection=projection)
        layers = rasterize(view, mesh.vertices, mesh.faces)
        which = torch.arange(len(layers.t))
        b = barycentric(layers, view, which)
        assert (b >= 0).all()
        torch.testing.assert_close(b.sum(-1), torch.ones(len(which)), rtol=0, atol=1e-6)
        face = layers.triangles.face[layers.triangle]
        point = (b.double().unsqueeze(-1) * mesh.vertices.double()[mesh.faces[face]]).sum(1)
        xy = view.pixel_centres(torch.float64).reshape(-1, 2)[layers.pixel]
        o, d, _ = view.rays(xy)
        off = (point - (o + layers.t[:, None] * d)).norm(dim=-1)
        assert off.median() < 2e-3
        x, y, w, _ = view.project(point).unbind(-1)
        assert (torch.stack([x / w, y / w], -1) - xy).abs().max() < 1.5 / module.SUBPIXELS + 1e-3


def test_barycentric_coordinates_survive_clipping():
    """A floor under the camera: half of every triangle lies behind the eye."""
    mesh = shapes.plane(size=(40.0, 40.0), triangles=2)
    eye, axes = look_at(*torch.tensor([[0.0, 1.0, 0.0], [0, 0.9, -1.0], [0, 1, 0]], dtype=torch.float64))
    view = Camera(eye=eye, axes=axes, width=64, height=48)
    layers = rasterize(view, mesh.vertices, mesh.faces)
    assert layers.triangles.corner is not None
    assert layers.start.diff().max() == 1
    b = barycentric(layers, view, torch.arange(len(layers.t)))
    face = layers.triangles.face[layers.triangle]
    point = (b.unsqueeze(-1) * mesh.vertices[mesh.faces[face]]).sum(1)
    assert point[:, 1].abs().max() < 1e-4
    o, d, _ = view.rays(view.pixel_centres(torch.float64).reshape(-1, 2)[layers.pixel])
    exact = -o[:, 1] / d[:, 1]
    near = exact < 20
    assert ((layers.t - exact).abs() / exact)[near].max() < 2e-2  # the horizon's rows move with 1/512 px
    below = torch.zeros(48 * 64, dtype=torch.bool)
    below[layers.pixel] = True
    ray = view.rays(view.pixel_centres(torch.float64).reshape(-1, 2))[1]
    reach = -1 / ray[:, 1].clamp(max=-1e-9)
    hit = ray * reach[:, None] + eye
    inside = (hit[:, 0].abs() < 19.9) & (hit[:, 2].abs() < 19.9)
    assert below[inside].all()


def test_huge_triangles_are_cut_at_the_guard_band():
    view = camera(64, 48)
    far = torch.tensor([[-1e9, -1e9, -1.0], [1e9, -1e9, -1.0], [0.0, 2e9, -1.0]], dtype=torch.float64)
    layers = rasterize(view, far, torch.tensor([[0, 1, 2]]))
    assert (layers.start.diff() == 1).all()
    assert layers.triangles.xy.abs().max() <= module.GUARD_BAND * module.SUBPIXELS


def test_shared_edges_stay_closed_through_clipping():
    """From inside a torus, with the near plane and the guard band cutting: backs minus fronts is 1 everywhere."""
    mesh = shapes.torus(triangles=800)
    eye, axes = look_at(*torch.tensor([[1.05, 0.02, 0.0], [1.0, 0.05, -1.0], [0, 1, 0]], dtype=torch.float64))
    view = Camera(eye=eye, axes=axes, width=80, height=60, fov_deg=100, near=0.05)
    layers = rasterize(view, mesh.vertices, mesh.faces)
    sign = torch.where(layers.triangles.front[layers.triangle], 1, -1)
    balance = torch.zeros(80 * 60, dtype=torch.long).index_add_(0, layers.pixel, sign)
    assert (balance == -1).all()


def test_ties_are_ordered_by_triangle():
    quad = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    faces = torch.tensor([[0, 1, 2]] * 5)
    layers = rasterize(camera(), quad, faces)
    lists = layers.triangle.reshape(-1, 5)
    assert (lists == torch.arange(5)).all()


def test_nothing_is_dropped():
    """Three hundred layers on every covered pixel."""
    z = torch.linspace(-0.5, 0.5, 300)
    corner = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    vertices = (corner[None] + torch.stack([0 * z, 0 * z, z], -1)[:, None]).reshape(-1, 3)
    layers = rasterize(camera(projection="orthographic"), vertices, torch.arange(900).reshape(-1, 3))
    assert layers.start.diff().max() == 300
    deep = (layers.start.diff() == 300).nonzero()[0, 0]
    t = layers.t[layers.start[deep] : layers.start[deep + 1]]
    assert (t.diff() >= 0).all()


def test_empty_and_invisible_meshes():
    view = camera()
    nothing = rasterize(view, torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long))
    behind = rasterize(view, view.eye.float() * torch.tensor([[2.0], [2.1], [2.2]]), torch.tensor([[0, 1, 2]]))
    point = rasterize(view, torch.zeros(3, 3), torch.tensor([[0, 1, 2]]))
    for layers in (nothing, behind, point):
        assert len(layers.t) == 0
        assert (layers.start == 0).all()


def test_front_is_by_the_corners():
    quad = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]])
    eye, axes = look_at(*torch.tensor([[0.0, 0, 3], [0, 0, 0], [0, 1, 0]], dtype=torch.float64))
    view = Camera(eye=eye, axes=axes, width=16, height=16)
    assert set_up(view, quad, torch.tensor([[0, 1, 2]])).front.tolist() == [True]
    assert set_up(view, quad, torch.tensor([[0, 2, 1]])).front.tolist() == [False]
