import pytest
import torch

from torchmeso.bench import extremes
from torchmeso.errors import MesoError


def test_names_are_unique():
    names = [c.name for c in extremes.cases(16)]
    assert len(set(names)) == len(names)
    names = [c.name for c in extremes.refusals()]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("case", [*extremes.refusals()], ids=lambda c: c.name)
def test_what_is_no_picture_is_refused(case):
    with pytest.raises(MesoError):
        case.make()


def test_a_table_has_the_spectrum_it_was_asked_for():
    spectrum = torch.logspace(0, -3, 24)
    A = extremes.table(spectrum).pictures().permute(0, 2, 3, 4, 1).reshape(-1, 24)
    torch.testing.assert_close(torch.linalg.svdvals(A.double()).float(), spectrum, rtol=1e-3, atol=1e-6)
