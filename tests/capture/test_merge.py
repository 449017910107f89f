import pytest
import torch
from reference import merge as slow

from torchmeso.capture import merge
from torchmeso.errors import ConfigError, ShapeError
from torchmeso.geometry.hemisphere import parse


def test_weight_is_the_volume_of_a_corner_of_a_box():
    s, c, p, q = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 5]])
    assert merge.tetrahedron_weight(s, c, p, q) == pytest.approx(5)
    assert merge.tetrahedron_weight(s, p + q, p, q) == pytest.approx(0)  # the camera in the laser's sheet


def test_the_mean_is_the_plain_loop(rng):
    d = torch.randn(7, 6, 5, generator=rng, dtype=torch.float64)
    valid = torch.rand(7, 6, 5, generator=rng) < 0.4
    weight = torch.rand(7, generator=rng, dtype=torch.float64)
    weight[2] = 0
    found = merge.merge(torch.where(valid, d, torch.nan), valid, weight, tolerance=0.8)
    for y in range(6):
        for x in range(5):
            values = [v if ok else None for v, ok in zip(d[:, y, x].tolist(), valid[:, y, x].tolist(), strict=True)]
            wanted = slow.merged(values, weight.tolist(), 0.8)
            assert bool(found.valid[y, x]) == (wanted is not None)
            assert found.distance[y, x].item() == pytest.approx(wanted or 0, abs=1e-12)


def test_an_outlier_and_unseen_points_do_not_count():
    d = torch.tensor([1.0, 1.1, 0.9, 5.0, -1.0])[:, None, None]
    valid = torch.tensor([True, True, True, True, False])[:, None, None]
    found = merge.merge(d, valid, torch.ones(5), tolerance=0.5)
    assert found.distance.item() == pytest.approx(1.0)
    assert (found.count.item(), found.rejected.item()) == (3, 1)


def test_tables_hold_drops_and_mark_what_nobody_saw():
    directions = parse("grid(4, 2, 80)")
    cosine = directions.directions(torch.float64)[:, 2]
    depth = 0.1
    distance = (depth / cosine)[:, None, None].expand(-1, 4, 4).float()
    valid = torch.ones(distance.shape, dtype=torch.bool)
    valid[1, 2, 3] = False
    mdf = merge.to_mdf(distance, valid, directions, 0.2)
    assert (mdf.delta[valid].float() / 255 - 0.5).abs().max() <= 0.5 / 255 + 1e-6
    assert mdf.no_hit is not None and mdf.no_hit.sum() == 1 and mdf.delta[1, 2, 3] == 0
    assert merge.to_mdf(distance, valid | True, directions, 0.2).no_hit is None


def test_holes_are_filled_from_their_surroundings_and_marked():
    value = torch.arange(5.0).expand(5, 5).clone()
    valid = torch.ones(5, 5, dtype=torch.bool)
    valid[2, 2] = False
    filled, marked = merge.fill(value, valid)
    assert filled[2, 2].item() == pytest.approx(2) and marked.nonzero().tolist() == [[2, 2]]
    torch.testing.assert_close(filled[valid], value[valid])


@pytest.mark.errors
def test_what_cannot_be_merged_is_refused():
    nothing = torch.zeros(0, 2, 2)
    with pytest.raises(ShapeError, match="at least one laser position"):
        merge.merge(nothing, nothing.bool(), torch.zeros(0), tolerance=1)
    one = torch.zeros(1, 2, 2)
    with pytest.raises(ConfigError, match="weight"):
        merge.merge(one, one.bool(), torch.tensor([-1.0]), tolerance=1)
    with pytest.raises(ShapeError, match="at least one measured point"):
        merge.fill(one[0], one[0].bool())
