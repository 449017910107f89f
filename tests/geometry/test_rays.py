import pytest
import torch

from torchmeso.errors import GeometryError
from torchmeso.geometry import rays, shapes
from torchmeso.geometry.directions import normalize


@pytest.fixture(scope="module")
def ball():
    mesh = shapes.sphere(triangles=20_000)
    return mesh, rays.RayScene(mesh.vertices, mesh.faces)


def test_distance_to_a_sphere(ball, rng):
    _, scene = ball
    w = normalize(torch.randn(500, 3, generator=rng))
    hits = scene.first_hit(3 * w, -w)
    torch.testing.assert_close(hits.t, torch.full((500,), 2.0), rtol=2e-3, atol=0)
    assert (hits.face >= 0).all()


def test_barycentric_position_is_the_hit_point(ball, rng):
    mesh, scene = ball
    w = normalize(torch.randn(500, 3, generator=rng))
    hits = scene.first_hit(3 * w, -w)
    point = (hits.barycentric[..., None] * mesh.vertices[mesh.faces[hits.face]]).sum(1)
    torch.testing.assert_close(point, (3 - hits.t)[:, None] * w, rtol=1e-4, atol=1e-5)


def test_misses_and_limits(ball):
    _, scene = ball
    origin = torch.tensor([[0.0, 0, 3], [0, 0, 3], [5, 0, 3]])
    direction = torch.tensor([[0.0, 0, -1]] * 3)
    limit = torch.tensor([10.0, 1.0, 10.0])
    hits = scene.first_hit(origin, direction, limit)
    assert hits.face[1:].tolist() == [-1, -1]
    assert hits.t[1:].isinf().all()
    assert hits.barycentric[1:].tolist() == [[1, 0, 0]] * 2
    assert scene.occluded(origin, direction, limit).tolist() == [True, False, False]


def test_many_threads_one_answer(ball, rng):
    _, scene = ball
    w = normalize(torch.randn(3 * rays.CHUNK + 17, 3, generator=rng))
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = scene.first_hit(3 * w, -w)
        torch.set_num_threads(2)
        two = scene.first_hit(3 * w, -w)
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))


def test_offset_leaves_the_surface(ball, rng):
    mesh, scene = ball
    w = normalize(torch.randn(2000, 3, generator=rng))
    hits = scene.first_hit(3 * w, -w)
    p = mesh.vertices[mesh.faces[hits.face]]
    normal = normalize(torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]))
    start = rays.offset((3 - hits.t)[:, None] * w, normal, 2.0)
    assert not scene.occluded(start, normal).any()


def test_no_rays_no_hits(ball):
    _, scene = ball
    assert len(scene.first_hit(torch.zeros(0, 3), torch.zeros(0, 3)).t) == 0
    assert len(scene.occluded(torch.zeros(0, 3), torch.zeros(0, 3))) == 0


@pytest.mark.errors
def test_empty_and_infinite_scenes_are_refused():
    with pytest.raises(GeometryError, match="at least one triangle"):
        rays.RayScene(torch.zeros(3, 3), torch.zeros(0, 3, dtype=torch.long))
    with pytest.raises(GeometryError, match="finite positions"):
        rays.RayScene(torch.full((3, 3), torch.nan), torch.tensor([[0, 1, 2]]))
