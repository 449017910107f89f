import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.geometry import hemisphere, kriging

SETS = ["ubo81", "grid(12, 5, 80)", "rings(0: 1)", "rings(40: 1 @ 30)", "rings(0: 1, 30: 5 @ 7)"]


def test_what_is_known_is_kept_and_constants_come_back():
    known = hemisphere.ubo81().directions(torch.float64)
    torch.testing.assert_close(kriging.weights(known, known), torch.eye(81, dtype=torch.float64), **FLOAT64)
    asked = hemisphere.ubo151().directions(torch.float64)
    torch.testing.assert_close(
        kriging.weights(known, asked).sum(1), torch.ones(len(asked), dtype=torch.float64), **FLOAT64
    )


def test_one_direction_is_all_there_is():
    known = torch.tensor([[0.6, 0.0, 0.8]], dtype=torch.float64)
    assert torch.equal(kriging.weights(known, known[[0, 0]]), torch.ones(2, 1, dtype=torch.float64))


def test_the_middle_of_two_is_their_mean():
    known = torch.tensor([[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8]], dtype=torch.float64)
    asked = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(kriging.weights(known, asked), torch.full((1, 2), 0.5, dtype=torch.float64), **FLOAT64)


def test_it_is_nearer_than_the_nearest():
    known, asked = (hemisphere.parse(s).directions(torch.float64) for s in ("ubo81", "grid(9, 4, 70)"))

    def smooth(w):
        return (w @ torch.tensor([0.3, 0.5, 0.8], dtype=torch.float64)).square()

    found = kriging.weights(known, asked) @ smooth(known)
    nearest = smooth(known)[(asked @ known.T).argmax(1)]
    assert (found - smooth(asked)).square().mean() < 0.1 * (nearest - smooth(asked)).square().mean()


@pytest.mark.parametrize(
    "name", ["ubo81", "grid(12, 5, 80)", "rings(0: 1)", "rings(40: 1 @ 30)", "rings(0: 1, 30: 5 @ 7)"]
)
def test_a_finer_set_holds_the_coarse_one(name):
    coarse = hemisphere.parse(name)
    fine, weights = kriging.finer(coarse)
    assert len(fine) <= 5 * len(coarse) + 2
    values = torch.arange(len(coarse), dtype=torch.float64)
    there = hemisphere.interpolate(fine, coarse.directions(torch.float64))
    table = hemisphere.with_pole(weights @ values, fine)
    torch.testing.assert_close((table[there.node] * there.weight).sum(-1), values, rtol=0, atol=1e-9)


def test_a_guess_is_the_mean_of_kriging_and_of_the_four_nearest(rng):
    known = hemisphere.ubo81().directions(torch.float64)
    asked = torch.randn(50, 3, generator=rng, dtype=torch.float64).abs()
    asked = torch.nn.functional.normalize(asked, dim=-1)
    found = kriging.guess(known, asked)
    torch.testing.assert_close(found.sum(1), torch.ones(len(asked), dtype=torch.float64), **FLOAT64)
    mean = 2 * found - kriging.weights(known, asked)
    for row, w in zip(mean, asked, strict=True):
        away = (known - w).norm(dim=1)
        near = away.argsort()[:4]
        share = away[near].clamp(min=1e-9) ** -2
        torch.testing.assert_close(row[near], share / share.sum(), rtol=0, atol=1e-9)
    torch.testing.assert_close(kriging.guess(known, known), torch.eye(81, dtype=torch.float64), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["ubo81", "grid(12, 5, 80)"])
def test_between_the_rings_the_table_is_nearer_to_the_guess_than_its_own_values(name):
    coarse, asked = hemisphere.parse(name), hemisphere.parse("grid(97, 31, 74)")
    fine, table = kriging.finer(coarse)
    known, w = coarse.directions(torch.float64), asked.directions(torch.float64)
    taps = hemisphere.interpolate(fine, w)
    expected, share = kriging.guess(known, w), hemisphere.solid_angles(asked)[:, None]

    def error(nodes):
        return float((((nodes[taps.node] * taps.weight[..., None]).sum(1) - expected).square() * share).sum())

    assert error(table) < 0.9 * error(kriging.guess(known, fine.directions(torch.float64)))


def test_a_dense_set_stays():
    dense = hemisphere.grid(120, 10, 80)
    fine, weights = kriging.finer(dense)
    assert fine is dense
    assert torch.equal(weights, torch.eye(1200, dtype=torch.float64))


def test_twins_share_their_weight():
    known = torch.tensor([[0.0, 0, 1], [0, 0, 1], [0.6, 0, 0.8]], dtype=torch.float64)
    found = kriging.weights(known, known[:1])
    torch.testing.assert_close(found, torch.tensor([[0.5, 0.5, 0]], dtype=torch.float64), rtol=0, atol=1e-9)
