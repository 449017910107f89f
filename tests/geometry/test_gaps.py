import math

import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.errors import FormatError
from torchmeso.geometry import gaps, hemisphere


def test_rings_are_found_from_angles():
    assert gaps.meant([(30.0, 60.0)], "one").directions().shape == (1, 3)
    full = gaps.angles_deg(hemisphere.ubo81())
    assert gaps.meant(full, "all") == hemisphere.ubo81()
    assert gaps.meant([a for a in full if a[0] != 30], "a ring lost") == hemisphere.ubo81()
    own = hemisphere.from_rings((0, 20, 50), (1, 7, 9), (0, 10, 0))
    rounded = [(theta, float(round(phi))) for theta, phi in gaps.angles_deg(own)]
    found = gaps.meant(rounded, "rounded to degrees")
    assert (found.count, found.theta_deg) == (own.count, own.theta_deg)
    assert gaps.locate(own, rounded) == list(range(17))
    assert gaps.meant([a for a in rounded if a != (50, 40)], "one lost").count == (1, 7, 9)


def test_directions_are_located_across_the_full_turn():
    ring = hemisphere.from_rings((40,), (3,), (5,))
    assert gaps.locate(ring, [(40, 365), (40, 5), (40, 245), (40, 60), (41, 5)]) == [0, 0, 2, None, None]


def test_filling_keeps_what_is_there_and_gives_constants_back():
    lights = hemisphere.ubo81()
    present = torch.rand(81, generator=torch.Generator().manual_seed(2)) > 0.6
    weights = gaps.filling(lights, present)
    torch.testing.assert_close(weights.sum(1), torch.ones(81, dtype=torch.float64), **FLOAT64)
    assert torch.equal(weights[present], torch.eye(81, dtype=torch.float64)[present])
    assert not weights[:, ~present].any()
    assert weights.min() > -0.2  # kriging overshoots, a little


@pytest.mark.parametrize("lost", ["ring", "pole", "scattered"])
def test_filling_is_nearer_than_the_nearest(lost):
    lights = hemisphere.ubo81()
    w = lights.directions(torch.float64)
    theta = torch.tensor([a for a, _ in gaps.angles_deg(lights)])
    if lost == "scattered":
        present = torch.rand(81, generator=torch.Generator().manual_seed(3)) > 0.4
    else:
        present = theta != {"ring": 45, "pole": 0}[lost]
    f = 0.3 + (w @ torch.tensor([0.4, -0.2, 0.5], dtype=torch.float64)).square()
    filled = gaps.filling(lights, present) @ f
    cosine = (w @ w.T).masked_fill(~present, -2)
    nearest = f[cosine.argmax(1)]
    error, worse = ((x - f)[~present].square().mean().sqrt() for x in (filled, nearest))
    assert error < 0.8 * worse  # measured 0.68, 0.10 and 0.56


def test_rings_without_a_pole_are_filled():
    lights = hemisphere.grid(6, 2, 70)
    present = torch.arange(12) != 3
    weights = gaps.filling(lights, present)
    assert math.isclose(float(weights[3].sum()), 1, rel_tol=1e-12)
    assert set(weights[3].topk(3).indices.tolist()) == {2, 4, 9}


@pytest.mark.errors
def test_what_is_no_ring_is_refused():
    with pytest.raises(FormatError, match="x: expected even steps in azimuth at theta 20, got 0, 50, 120, 190"):
        gaps.meant([(20, 0), (20, 50), (20, 120), (20, 190)], "x")
    with pytest.raises(FormatError, match="x: expected at most 4096 directions on rings"):
        gaps.meant([(20, 0), (20, 0.01)], "x")
    with pytest.raises(FormatError, match=r"x: expected polar angles from 0 to 89\.9 .* got theta 90, phi 10"):
        gaps.meant([(20, 0), (90, 10)], "x")
