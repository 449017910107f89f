import math

import pytest
import torch

from torchmeso.compress import budget, transform
from torchmeso.compress.budget import Budget
from torchmeso.compress.kept_maps import KeptMaps
from torchmeso.compress.transform import TransformOptions, fit
from torchmeso.data import transform_btf
from torchmeso.data.btf import Btf
from torchmeso.data.journal import InMemory
from torchmeso.data.transform_btf import cosines
from torchmeso.errors import ConfigError
from torchmeso.geometry import hemisphere

LIGHTS, VIEWS = hemisphere.grid(6, 3, 80), hemisphere.grid(6, 3, 75)


@pytest.fixture
def smooth(rng):
    """A table of few smooth components, and a little noise."""
    maps = torch.rand(18, 4, 4, 3, 3, generator=rng).repeat_interleave(4, 1).repeat_interleave(4, 2)
    images = torch.einsum("lhwkc,vk->lvhwc", maps, torch.rand(18, 3, generator=rng))
    images = images + 0.01 * torch.randn(images.shape, generator=rng)
    return Btf(images=images, lights=LIGHTS, views=VIEWS)


@pytest.mark.parametrize("wanted", [25.0, 33.0, 41.0])
def test_the_error_asked_for_is_kept_and_not_much_exceeded(smooth, wanted):
    model, found = fit(smooth, Budget(psnr=wanted))
    assert wanted <= found <= wanted + 1
    eigen = model.expanded()
    shown = torch.einsum("lhwkc,vk->lvhwc", eigen.decoded(), eigen.weights)
    assert found == pytest.approx(budget.psnr_of(smooth.images, shown), abs=1e-5)


def test_the_size_asked_for_is_kept_by_the_file(smooth, tmp_path):
    errors = []
    for room in (9000, 16000, 40000):
        model, found = fit(smooth, Budget(size=room))
        transform_btf.save(model, tmp_path / "a.meso", psnr=found)
        spare = transform.FREE_BYTES + 100 * len(model.codes)
        assert 0.9 * room - spare <= (tmp_path / "a.meso").stat().st_size <= room
        errors.append(found)
    assert errors == sorted(errors)


def test_components_under_the_budget_are_not_stored(smooth):
    few, _ = fit(smooth, Budget(psnr=25.0))
    many, _ = fit(smooth, Budget(psnr=45.0))
    assert len(few.codes) <= 4 < len(many.codes) == 18
    assert len(fit(smooth, Budget(size=20000), TransformOptions(rank=2))[0].codes) == 2


def test_psnr_is_that_of_all_values(smooth):
    model, found = fit(smooth, Budget(psnr=30.0))
    eigen = model.expanded()
    shown = torch.einsum("lhwkc,vk->lvhwc", eigen.decoded(), eigen.weights).double()
    error = (shown - smooth.images.double()).square().mean()
    peak = torch.quantile(smooth.images.flatten(), 0.995).double()
    assert found == pytest.approx(float(10 * torch.log10(peak**2 / error)), abs=1e-3)


def test_black_and_constant_tables_have_models():
    for value in (0.0, 0.5):
        btf = Btf(images=torch.full((18, 18, 4, 5, 3), value), lights=LIGHTS, views=VIEWS)
        model, found = fit(btf, Budget(psnr=40.0))
        assert found >= 40 and len(model.codes) == 1


def test_the_histogram_knows_the_error_of_every_step(rng):
    C = torch.randn(3, 4, 3, 16, 16, generator=rng) * torch.logspace(-2, 1, 3)[:, None, None, None, None]
    maps = KeptMaps(
        parts=InMemory(), name="C", layout=(slice(0, 16),), count=3, before=(4, 3), after=(16,), dtype=torch.float32
    )
    maps.keep([(slice(0, 16), cosines(C, inverse=True, along=(-2,)))])
    histogram, largest = transform._statistics(maps, InMemory(), lambda share: None)
    torch.testing.assert_close(largest.float(), C.abs().amax((2, 3, 4)), rtol=1e-5, atol=1e-6)
    for step in (3e-3, 0.03, 1.0, 10.0):
        codes = transform._codes(C, step)
        error = float((codes.float() * step - C).double().square().sum())
        assert transform._expected(histogram, step)[0] == pytest.approx(error, rel=0.02)
        used = (codes != 0).flatten(2).any(2)
        assert transform._used(largest, step) == tuple(
            int(x.nonzero().max()) + 1 if x.any() else 1 for x in (used.any(1), used.any(0))
        )


@pytest.mark.errors
@pytest.mark.parametrize(
    ("wanted", "rank", "text"),
    [
        (Budget(psnr=30), 19, "expected 1 to 18"),
        (Budget(psnr=30), 0, "expected 1 to 18"),
        (Budget(psnr=140), None, "140 dB cannot be reached"),
        (Budget(psnr=60), 1, "or give more rank"),
        (Budget(psnr=math.nan), None, "cannot be reached"),
        (Budget(size=100), None, "100 bytes cannot be reached"),
    ],
)
def test_budgets_that_cannot_be_kept_are_refused(smooth, wanted, rank, text):
    with pytest.raises(ConfigError, match=text):
        fit(smooth, wanted, TransformOptions(rank=rank))
