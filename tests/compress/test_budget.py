import math

import pytest
import torch

from torchmeso.compress import budget
from torchmeso.compress.budget import Budget, Estimate, by_step, parse_size
from torchmeso.data import bands
from torchmeso.data.journal import InMemory
from torchmeso.errors import ConfigError
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


@pytest.mark.parametrize(("off_db", "off_size"), [(0, 1.0), (0.3, 1.0), (0, 0.2), (0, 5.0)])
def test_the_edge_of_a_budget_is_found(off_db, off_size):
    """A step s has 100 / s bytes and -20 log10 s dB; estimates may be off."""
    tried = []

    def found(wanted):
        tried.clear()
        return by_step(
            wanted,
            (1e-4, 10.0),
            estimate=lambda s: Estimate(-20 * math.log10(s) + off_db, off_size * 100 / s),
            size=lambda s: tried.append(s) or int(100 / s),
            measure=lambda s: tried.append(s) or -20 * math.log10(s),
        )

    assert found(Budget(psnr=40))[0] == pytest.approx(0.01, rel=0.05)
    assert found(Budget(psnr=40))[1] >= 40
    assert len(tried) <= 3
    step, _ = found(Budget(size=1000))
    assert 980 <= int(100 / step) <= 1000
    assert len(tried) <= 4


def test_sizes_that_no_estimate_follows_are_found_by_halving():
    """Sizes in stairs."""
    flat = {"estimate": lambda s: Estimate(0.0, 1.0), "measure": lambda s: 0.0}
    step, _ = by_step(Budget(size=60), (1e-3, 10.0), size=lambda s: 100 if s < 1 else 50, **flat)
    assert 1 <= step < 2


class Rows:
    """A table that is read in bands."""

    def __init__(self, T):
        self.T, self.lights, self.views, self.texels, self.read = T, SET, SET, tuple(T.shape[2:4]), []

    def rows(self, start, stop):
        self.read.append((start, stop))
        return self.T[:, :, start:stop]


@pytest.mark.parametrize("room", [1, 2 * 4 * 27 * 5, 1 << 20])
@pytest.mark.parametrize("samples", [20, 2_000_000])
def test_a_survey_is_that_of_the_table(room, samples, rng, monkeypatch):
    monkeypatch.setattr(bands, "ROOM", room)
    monkeypatch.setattr(budget, "SAMPLES", samples)
    T = torch.rand(3, 3, 4, 5, 3, generator=rng)
    found = budget.survey(Rows(T), InMemory(), ("light", "view", "colour"))
    assert found.values == T.numel()
    assert found.peak == budget.peak_of(T)
    if samples > T.numel():
        assert found.peak == pytest.approx(float(torch.quantile(T.flatten(), 0.995)), rel=1e-6)
    for axis, dim in {"light": 0, "view": 1, "colour": 4}.items():
        rows = T.movedim(dim, 0).flatten(1).double()
        torch.testing.assert_close(found.grams[axis], rows @ rows.T, rtol=1e-5, atol=1e-5)
    assert budget.survey(Rows(T), InMemory()).grams == {}


def test_a_survey_goes_on_where_it_stopped(rng, monkeypatch):
    monkeypatch.setattr(bands, "ROOM", 1)
    T, parts = torch.rand(3, 3, 4, 5, 3, generator=rng), InMemory()
    whole = budget.survey(Rows(T), InMemory(), ("view",))

    def dies(share):
        if share > 0.4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        budget.survey(Rows(T), parts, ("view",), dies)
    table = Rows(T)
    found = budget.survey(table, parts, ("view",))
    assert table.read == [(2, 3), (3, 4)]
    assert found.peak == whole.peak and torch.equal(found.grams["view"], whole.grams["view"])
    table.read.clear()
    budget.survey(table, parts, ("view",))
    assert table.read == []


def test_squared_errors_are_those_of_all_rows(rng, monkeypatch):
    T = torch.rand(3, 3, 4, 5, 3, generator=rng)
    shown = T + 0.1 * torch.rand(T.shape, generator=rng)
    for room in (1, 1 << 20):
        monkeypatch.setattr(bands, "ROOM", room)
        found = budget.squared_error(Rows(T), lambda rows: lambda at: shown[:, :, rows.start + at])
        assert found == pytest.approx(float((shown - T).double().square().sum()), rel=1e-6)


@pytest.mark.errors
def test_budgets_that_are_none_are_refused():
    for wrong in ({}, {"psnr": 30.0, "size": 3}):
        with pytest.raises(ConfigError, match="--psnr or --size, and not both"):
            Budget(**wrong)
    with pytest.raises(ConfigError, match="expected a size like 4MB"):
        parse_size("four")


@pytest.mark.errors
def test_what_cannot_be_reached_is_said():
    of = {"estimate": lambda s: Estimate(-s, 9 / s), "measure": lambda s: -s}
    with pytest.raises(ConfigError, match=r"20 dB cannot be reached, -1\.0 dB is the best here; ask for less, please"):
        by_step(Budget(psnr=20), (1.0, 9.0), size=int, more=", please", **of)
    for size in (lambda s: 9, lambda s: 9 + int(100 / s)):
        with pytest.raises(ConfigError, match=r"5 bytes cannot be reached, (9|20) is the least; give more room"):
            by_step(Budget(size=5), (1.0, 9.0), size=size, **of)
    hopeful = {"estimate": lambda s: Estimate(-s, 0), "measure": lambda s: -s}
    with pytest.raises(ConfigError, match="5 bytes cannot be reached, 9 is the least"):
        by_step(Budget(size=5), (1.0, 9.0), size=lambda s: 9, **hopeful)
