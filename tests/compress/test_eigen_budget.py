import pytest
import torch

from torchmeso.compress import budget, eigen, eigen_budget
from torchmeso.compress.budget import Budget
from torchmeso.compress.eigen import EigenOptions
from torchmeso.data import eigen_btf
from torchmeso.errors import ConfigError
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions


@pytest.fixture(scope="module")
def brick():
    options = BtfOptions(texels=16, lights="grid(8, 3, 80)", views="grid(8, 3, 80)", samples=1, bounces=0)
    return bake_btf.in_memory(generators.brick(), options)


def psnr_of(T, model):
    return budget.psnr_of(T, torch.einsum("lhwkc,vk->lvhwc", model.decoded(), model.weights))


@pytest.mark.parametrize("wanted", [20.0, 30.0, 38.0])
def test_the_fewest_components_for_an_error(wanted, brick):
    found, psnr = eigen_budget.fit(brick, Budget(psnr=wanted))
    T = brick.pictures().float()
    assert wanted <= psnr == pytest.approx(psnr_of(T, found), abs=1e-6)
    fewer = eigen.fit(brick, EigenOptions(rank=found.rank - 1))
    assert psnr_of(T, fewer) < wanted


@pytest.mark.parametrize("wanted", [20.0, 30.0, 38.0])
def test_adaptive_files_are_smaller_for_the_same_error(wanted, brick, tmp_path):
    size = {}
    for storage in ("uint8", "adaptive"):
        found, psnr = eigen_budget.fit(brick, Budget(psnr=wanted), storage=storage)
        assert psnr >= wanted
        eigen_btf.save(found, tmp_path / "a.meso", coded=storage == "adaptive", psnr=psnr)
        size[storage] = (tmp_path / "a.meso").stat().st_size
    assert 2.5 * size["adaptive"] < size["uint8"]  # measured 4.5 to 9


@pytest.mark.parametrize("storage", ["uint8", "adaptive", "float16"])
def test_the_size_asked_for_is_kept_by_the_file(storage, brick, tmp_path):
    errors = []
    for room in (45_000, 90_000, 160_000):
        found, psnr = eigen_budget.fit(brick, Budget(size=room), storage=storage)
        eigen_btf.save(found, tmp_path / "a.meso", coded=storage == "adaptive", psnr=round(psnr, 2))
        assert (tmp_path / "a.meso").stat().st_size <= room
        errors.append(psnr)
    assert errors == sorted(errors)


@pytest.mark.parametrize("storage", ["uint8", "float16"])
def test_the_model_is_the_one_of_a_fit_of_that_rank(storage, brick):
    found, _ = eigen_budget.fit(brick, Budget(psnr=30), storage=storage)
    plain = eigen.fit(brick, EigenOptions(rank=found.rank, storage=storage))
    for name in ("maps", "weights", "scale", "offset"):
        assert torch.equal(getattr(found, name), getattr(plain, name))


def test_no_more_components_than_asked_for(brick):
    for storage in ("uint8", "adaptive"):
        assert eigen_budget.fit(brick, Budget(size=500_000), storage=storage, rank=3)[0].rank <= 3


def test_a_black_table_has_a_model(brick):
    black = type(brick)(images=torch.zeros_like(brick.pictures()), lights=brick.lights, views=brick.views)
    for storage in ("uint8", "adaptive"):
        assert eigen_budget.fit(black, Budget(psnr=40), storage=storage)[0].rank == 1


@pytest.mark.errors
@pytest.mark.parametrize("storage", ["uint8", "adaptive"])
def test_budgets_that_cannot_be_kept_are_refused(storage, brick):
    for wanted, rank, text in (
        (Budget(psnr=140), None, "140 dB cannot be reached"),
        (Budget(psnr=38), 1, "ask for less, or give more rank"),
        (Budget(size=100), None, "100 bytes cannot be reached"),
        (Budget(psnr=30), 25, "expected a value from 1 to 24"),
    ):
        with pytest.raises(ConfigError, match=text):
            eigen_budget.fit(brick, wanted, storage=storage, rank=rank)


@pytest.mark.errors
def test_what_eight_bits_lose_is_not_found_rank_by_rank(brick, monkeypatch):
    """A budget just above what eight bits can do takes few fits, not one for each rank."""
    fits = []
    scores = eigen_budget.kept_scores
    monkeypatch.setattr(eigen_budget, "kept_scores", lambda *a, **k: fits.append(1) or scores(*a, **k))
    with pytest.raises(ConfigError, match="cannot be reached"):
        eigen_budget.fit(brick, Budget(psnr=70))
    assert len(fits) <= 3
