import pytest
import torch

from torchmeso.bench import sweeps

CURVES = sweeps.curves()


@pytest.mark.parametrize("name", CURVES)
def test_no_container_jumps(name):
    assert sweeps.halving(CURVES[name], 300) < 0.6  # measured 0.50 to 0.54


def test_a_step_is_seen_beside_slopes():
    def curve(w):
        return torch.stack([w[:, 0] * 10, 0.3 * (w[:, 2] > 0.4)], 1)

    def smooth(w):
        return w[:, :1] * 10

    assert sweeps.halving(curve, 500) > 0.9
    assert sweeps.halving(smooth, 500) == pytest.approx(0.5, abs=1e-3)


def test_what_stands_still_is_continuous():
    assert sweeps.halving(lambda w: torch.ones(len(w), 1, dtype=w.dtype), 50) == 0.5


def test_sweeps_meet_pole_and_horizons():
    found = sweeps.directions(400)
    over = found["over_37"]
    assert over[:, 2].max() == 1
    assert over[0, 2] < -0.3 and over[-1, 2] < -0.3
    for w in found.values():
        torch.testing.assert_close(w.norm(dim=1), torch.ones(len(w), dtype=torch.float64))
