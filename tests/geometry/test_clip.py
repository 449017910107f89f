import torch

from tests.tolerances import FLOAT64
from torchmeso.geometry.clip import Polygons, cut, fan


def triangles(n, rng):
    points = torch.rand(n, 3, 2, dtype=torch.float64, generator=rng) * 2 - 1
    return Polygons(points, torch.full((n,), 3))


def area(polygons):
    tri, source = fan(polygons)
    a, b = tri[:, 1] - tri[:, 0], tri[:, 2] - tri[:, 0]
    total = torch.zeros(len(polygons.corners), dtype=torch.float64)
    return total.index_add_(0, source, (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) / 2)


def distance(polygons, normal, constant):
    return polygons.points @ torch.tensor(normal, dtype=torch.float64) + constant


def test_two_halves_make_the_whole(rng):
    whole = triangles(500, rng)
    d = distance(whole, [0.3, -0.7], 0.1)
    torch.testing.assert_close(area(cut(whole, d)) + area(cut(whole, -d)), area(whole), **FLOAT64)


def test_what_is_left_lies_inside(rng):
    left = cut(triangles(200, rng), distance(triangles(200, torch.Generator().manual_seed(0)), [1.0, 0.2], 0.0))
    valid = torch.arange(left.points.shape[1]) < left.corners[:, None]
    assert distance(left, [1.0, 0.2], 0.0)[valid].min() > -1e-12


def test_square_cut_out_of_a_large_triangle(rng):
    big = Polygons(torch.tensor([[[-9.0, -9], [9, -9], [0, 18]]], dtype=torch.float64), torch.tensor([3]))
    for normal, constant in (([1.0, 0], 0.5), ([-1.0, 0], 0.5), ([0, 1.0], 0.5), ([0, -1.0], 0.5)):
        big = cut(big, distance(big, normal, constant))
    assert big.corners.tolist() == [4]
    torch.testing.assert_close(area(big), torch.tensor([1.0], dtype=torch.float64), **FLOAT64)


def test_shared_edges_are_cut_at_the_same_bits(rng):
    for _ in range(50):
        a, b, c, d = torch.rand(4, 2, dtype=torch.float64, generator=rng)
        pair = Polygons(torch.stack([torch.stack([a, b, c]), torch.stack([b, a, d])]), torch.tensor([3, 3]))
        left = cut(pair, distance(pair, [0.5, -0.4], 0.02))
        sets = [set(map(tuple, left.points[i, : left.corners[i]].tolist())) for i in range(2)]
        if (distance(pair, [0.5, -0.4], 0.02)[0, :2] >= 0).sum() == 1:
            assert len(sets[0] & sets[1]) >= 2 or min(left.corners) < 3  # the kept corner and the cut point


def test_nothing_and_everything_is_left(rng):
    whole = triangles(10, rng)
    assert (cut(whole, torch.full((10, 3), -1.0, dtype=torch.float64)).corners == 0).all()
    kept = cut(whole, torch.ones(10, 3, dtype=torch.float64))
    assert (kept.corners == 3).all()
    assert torch.equal(kept.points[:, :3], whole.points)
    assert len(fan(cut(whole, -torch.ones(10, 3, dtype=torch.float64)))[0]) == 0
