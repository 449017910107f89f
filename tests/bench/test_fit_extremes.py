import pytest
import torch

from torchmeso.bench import fit_extremes
from torchmeso.bench.fit_extremes import Fit
from torchmeso.bench.suite import Context
from torchmeso.data.btf import Btf
from torchmeso.errors import MesoError


@pytest.mark.parametrize("case", list(fit_extremes.fits()), ids=lambda case: case.name)
def test_fits_at_the_edge_are_sound(case):
    lost, error = fit_extremes.judge(case)
    assert lost == 0
    assert error <= case.bound


@pytest.mark.parametrize("case", list(fit_extremes.refusals()), ids=lambda case: case.name)
def test_what_no_model_can_be_made_of_is_refused(case):
    with pytest.raises(MesoError):
        case.make()


def test_rows_turn_red(monkeypatch):
    table = fit_extremes._table(fit_extremes.SET)

    def fail(table):
        raise KeyError("bug")

    spoilt = Btf(images=table.images * torch.nan, lights=table.lights, views=table.views)
    cases = (
        Fit(name="bug", what="a bug", table=table, fit=fail, bound=0.5),
        Fit(name="nan", what="not finite", table=table, fit=lambda t: spoilt, bound=fit_extremes.NEVER),
    )
    monkeypatch.setattr(fit_extremes, "fits", lambda: cases)
    rows = list(fit_extremes.stress(Context()))
    assert [(r.id, r.met) for r in rows] == [
        ("fit.bug.finite", False), ("fit.bug.error", False), ("fit.nan.finite", False)
    ]  # fmt: skip
    monkeypatch.setattr(
        fit_extremes, "refusals", lambda: [fit_extremes.Refusal(name=n, what=n, make=f) for n, f in
        (("accepted", lambda: 1), ("bug", lambda: fail(1)))]
    )  # fmt: skip
    assert [(r.met, str(r.peer)) for r in fit_extremes.refused(Context())] == [
        (False, "accepted"), (False, "KeyError: 'bug'")
    ]  # fmt: skip
