import math

import pytest
import torch

from torchmeso.compress import budget
from torchmeso.compress.budget import Budget, by_step, parse_size
from torchmeso.data.btf import Btf
from torchmeso.errors import ConfigError, SizeError
from torchmeso.geometry import hemisphere

SET = hemisphere.grid(3, 1, 45)


def test_sizes_are_read():
    assert [parse_size(x) for x in ("4MB", "300 kB", "65536", "1.5M")] == [4_000_000, 300_000, 65536, 1_500_000]


def test_psnr_is_that_of_all_values(rng):
    T = torch.rand(3, 3, 4, 5, 3, generator=rng)
    shown = T + 0.01
    expected = 20 * math.log10(float(torch.quantile(T.flatten(), 0.995)) / 0.01)
    assert budget.psnr_of(T, shown) == pytest.approx(expected, abs=1e-3)
    assert budget.psnr_of(T, T) == math.inf


def test_the_edge_of_a_budget_is_found():
    """A model of step s has 100 / s bytes and -20 log10 s dB."""

    def found(wanted):
        decibels = {"estimate": lambda s: -20 * math.log10(s), "measure": lambda s: -20 * math.log10(s)}
        return by_step(wanted, lambda s: s, (1e-4, 10.0), size=lambda s: int(100 / s), **decibels)

    assert found(Budget(psnr=40))[0] == pytest.approx(0.01, rel=0.01)
    assert found(Budget(psnr=40))[1] >= 40
    assert found(Budget(size=1000))[0] == pytest.approx(0.1, rel=0.01)


@pytest.mark.errors
def test_budgets_that_are_none_are_refused(monkeypatch):
    for wrong in ({}, {"psnr": 30.0, "size": 3}):
        with pytest.raises(ConfigError, match="--psnr or --size, and not both"):
            Budget(**wrong)
    with pytest.raises(ConfigError, match="expected a size like 4MB"):
        parse_size("four")
    monkeypatch.setattr(budget, "MOST_BYTES", 100)
    with pytest.raises(SizeError, match="take --method eigen with --rank"):
        budget.in_memory(Btf(images=torch.rand(3, 3, 4, 5, 3), lights=SET, views=SET))


@pytest.mark.errors
def test_what_cannot_be_reached_is_said():
    decibels = {"estimate": lambda s: -s, "measure": lambda s: -s}
    with pytest.raises(ConfigError, match=r"20 dB cannot be reached, -1\.0 dB is the best here; ask for less, please"):
        by_step(Budget(psnr=20), lambda s: s, (1.0, 9.0), size=int, more=", please", **decibels)
    with pytest.raises(ConfigError, match="5 bytes cannot be reached, 9 is the least; give more room"):
        by_step(Budget(size=5), lambda s: s, (1.0, 9.0), size=lambda s: 9, **decibels)
