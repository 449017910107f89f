"""Level and upright faces against boxes."""

import pytest
import torch

from tests.meso.looks import box_distance, looks, straight_down, wrong
from torchmeso.errors import ConfigError
from torchmeso.meso import generators
from torchmeso.meso.bake_mdf import RayCastMdf


def brick_height(uv, rows, columns, h, mortar, bevel):
    u, v = uv[:, 0] % 1, uv[:, 1] % 1
    row = (v * rows).floor()
    y = v - row / rows
    x = (u - 0.5 * (row % 2) / columns) % (1 / columns)
    edge = torch.minimum(torch.minimum(x, 1 / columns - x), torch.minimum(y, 1 / rows - y)) - mortar / 2
    return torch.where(edge < 0, -h, -h + h * (edge / bevel).clamp(max=1))


def test_brick(rng):
    uv, wo = straight_down(rng)
    D = RayCastMdf(generators.brick(h=0.1, mortar=0.03, bevel=0.02)).evaluate(uv, wo)
    expected = -brick_height(uv, 4, 2, 0.1, 0.03, 0.02)
    assert ((D - expected).abs() > 1e-4).float().mean() < 2e-3


def grid_boxes(count, bar, h):
    for k in range(count):
        low, high = (k + 0.5) / count - bar / 2, (k + 0.5) / count + bar / 2
        for bottom, top in ((-bar, 0.0), (-h, bar - h)):
            yield (-torch.inf, low, bottom, torch.inf, high, top)
            yield (low, -torch.inf, bottom, high, torch.inf, top)
        for j in range(count):
            yield (low, (j + 0.5) / count - bar / 2, -h, high, (j + 0.5) / count + bar / 2, 0.0)


def test_blocks(rng):
    meso = generators.blocks(count=3, h=0.3, gap=0.08, seed=3)
    p = meso.geometry.vertices[meso.geometry.part.new_tensor(range(4, 4 + 8 * 9))].reshape(9, 8, 3)
    boxes = torch.cat([p.amin(1), p.amax(1)], -1).tolist()
    low, side = torch.tensor(boxes)[:, 0] * 3 % 1 / 3, torch.tensor(boxes)[:, 3] - torch.tensor(boxes)[:, 0]
    torch.testing.assert_close(low, torch.full((9,), 0.04), rtol=0, atol=1e-6)
    torch.testing.assert_close(side, torch.full((9,), 1 / 3 - 0.08), rtol=0, atol=1e-6)
    uv, wo = looks(rng, 60)
    expected = torch.minimum(box_distance(uv, wo, boxes), 0.3 / wo[:, 2])
    assert wrong(RayCastMdf(meso).evaluate(uv, wo), expected, 2e-4) < 2e-3  # rays within float32 of an edge


@pytest.mark.parametrize("backing", [False, True])
def test_grid(backing, rng):
    meso = generators.grid(count=2, h=0.3, bar=0.1, backing=backing)
    uv, wo = looks(rng, 60)
    expected = box_distance(uv, wo, list(grid_boxes(2, 0.1, 0.3)))
    expected = torch.minimum(expected, 0.3 / wo[:, 2]) if backing else expected
    assert wrong(RayCastMdf(meso).evaluate(uv, wo), expected, 2e-4) < 2e-3
    assert bool(expected.isinf().any()) != backing


def test_holes_of_a_grid_are_as_large_as_they_should_be(rng):
    uv, wo = straight_down(rng)
    D = RayCastMdf(generators.grid(count=3, bar=0.08)).evaluate(uv, wo)
    assert float(D.isinf().double().mean()) == pytest.approx((1 - 3 * 0.08) ** 2, abs=0.02)


def test_bricks_differ_in_shade_and_the_seed_decides():
    a, b = generators.brick(seed=1), generators.brick(seed=2)
    assert len(a.geometry.palette.albedo.unique(dim=0)) == 9
    assert not torch.equal(a.geometry.palette.albedo, b.geometry.palette.albedo)
    assert torch.equal(a.geometry.palette.albedo, generators.brick(seed=1).geometry.palette.albedo)


def test_one_block_reaches_the_top_and_none_is_too_low():
    z = generators.blocks(count=5, h=0.2, lowest=0.5).geometry.vertices[4:].reshape(25, 8, 3)[..., 2].amax(1)
    assert float(z.max()) == 0
    assert float(z.min()) >= -0.1 - 1e-6
    assert len(z.unique()) == 25


@pytest.mark.errors
def test_impossible_shapes_are_refused():
    with pytest.raises(ConfigError, match="even number of rows"):
        generators.brick(rows=3)
    with pytest.raises(ConfigError, match="leave a top on every brick"):
        generators.brick(mortar=0.22)
    with pytest.raises(ConfigError, match=r"blocks\.gap: expected a value from 0 to 0\.2375"):
        generators.blocks(gap=0.3)
    with pytest.raises(ConfigError, match=r"grid\.bar: expected a value from 0\.001 to 0\.147"):
        generators.grid(bar=0.2)
