import math

import pytest
import torch

from torchmeso.compress import budget, transform
from torchmeso.compress.budget import psnr
from torchmeso.compress.transform import TransformOptions, fit
from torchmeso.data import transform_btf
from torchmeso.data.btf import Btf
from torchmeso.errors import ConfigError, SizeError
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
    model, found = fit(smooth, TransformOptions(psnr=wanted))
    assert wanted <= found <= wanted + 1
    assert found == pytest.approx(psnr(smooth.images, model.expanded()), abs=1e-6)


def test_the_size_asked_for_is_kept_by_the_file(smooth, tmp_path):
    errors = []
    for room in (9000, 16000, 40000):
        model, found = fit(smooth, TransformOptions(size=room))
        transform_btf.save(model, tmp_path / "a.meso", psnr=found)
        spare = transform.FREE_BYTES + 100 * len(model.codes)
        assert 0.9 * room - spare <= (tmp_path / "a.meso").stat().st_size <= room
        errors.append(found)
    assert errors == sorted(errors)


def test_components_under_the_budget_are_not_stored(smooth):
    few, _ = fit(smooth, TransformOptions(psnr=25.0))
    many, _ = fit(smooth, TransformOptions(psnr=45.0))
    assert len(few.codes) <= 4 < len(many.codes) == 18
    assert len(fit(smooth, TransformOptions(size=20000, rank=2))[0].codes) == 2


def test_psnr_is_that_of_all_values(smooth):
    model, found = fit(smooth, TransformOptions(psnr=30.0))
    eigen = model.expanded()
    shown = torch.einsum("lhwkc,vk->lvhwc", eigen.decoded(), eigen.weights).double()
    error = (shown - smooth.images.double()).square().mean()
    peak = torch.quantile(smooth.images.flatten(), 0.995).double()
    assert found == pytest.approx(float(10 * torch.log10(peak**2 / error)), abs=1e-3)


def test_black_and_constant_tables_have_models():
    for value in (0.0, 0.5):
        btf = Btf(images=torch.full((18, 18, 4, 5, 3), value), lights=LIGHTS, views=VIEWS)
        model, found = fit(btf, TransformOptions(psnr=40.0))
        assert found >= 40 and len(model.codes) == 1


@pytest.mark.errors
@pytest.mark.parametrize(
    ("options", "text"),
    [
        (TransformOptions(), "--psnr or --size"),
        (TransformOptions(psnr=30, size=3), "and not both"),
        (TransformOptions(psnr=30, rank=19), "expected 1 to 18"),
        (TransformOptions(psnr=30, rank=0), "expected 1 to 18"),
        (TransformOptions(psnr=140), "140 dB cannot be reached"),
        (TransformOptions(psnr=60, rank=1), "or give more rank"),
        (TransformOptions(psnr=math.nan), "cannot be reached"),
        (TransformOptions(size=100), "100 bytes cannot be reached"),
    ],
)
def test_budgets_that_cannot_be_kept_are_refused(smooth, options, text):
    with pytest.raises(ConfigError, match=text):
        fit(smooth, options)


@pytest.mark.errors
def test_tables_beyond_memory_are_refused(smooth, monkeypatch):
    monkeypatch.setattr(budget, "MOST_BYTES", 1000)
    with pytest.raises(SizeError, match="take --method eigen"):
        fit(smooth, TransformOptions(psnr=30))
