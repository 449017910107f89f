from dataclasses import replace

import pytest

from torchmeso.compress import double_sh_budget
from torchmeso.compress.budget import Budget
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.data import sh_btf
from torchmeso.errors import ConfigError
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions

MOST = DoubleShOptions(light_terms=9, view_terms=9)


@pytest.fixture(scope="module")
def brick():
    options = BtfOptions(texels=16, lights="grid(8, 3, 80)", views="grid(8, 3, 80)", samples=1, bounces=0)
    return bake_btf.in_memory(generators.brick(), options)


def written(found, storage, psnr, path):
    sh_btf.save(found, path, coded=storage == "adaptive", psnr=round(psnr, 2))
    return path.stat().st_size


@pytest.mark.parametrize("wanted", [14.0, 16.0])
def test_the_error_asked_for_is_kept_by_few_coefficients(wanted, brick, tmp_path):
    size = {}
    for storage in ("uint8", "adaptive"):
        found, psnr = double_sh_budget.fit(brick, Budget(psnr=wanted), replace(MOST, storage=storage))
        assert wanted <= psnr
        assert found.terms < (9, 9)
        size[storage] = written(found, storage, psnr, tmp_path / "a.meso")
    assert 1.5 * size["adaptive"] < size["uint8"]


@pytest.mark.parametrize("storage", ["uint8", "adaptive"])
def test_the_size_asked_for_is_kept_by_the_file(storage, brick, tmp_path):
    errors = []
    for room in (15_000, 30_000, 90_000):
        found, psnr = double_sh_budget.fit(brick, Budget(size=room), replace(MOST, storage=storage))
        assert written(found, storage, psnr, tmp_path / "a.meso") <= room
        errors.append(psnr)
    assert errors == sorted(errors)


def test_pairs_that_directions_cannot_tell_apart_are_not_tried(brick):
    """Three rings hold no 36 coefficients."""
    found, _ = double_sh_budget.fit(brick, Budget(size=100_000), DoubleShOptions(light_terms=36, view_terms=1))
    assert found.terms[0] <= 16


@pytest.mark.errors
def test_budgets_that_cannot_be_kept_are_refused(brick):
    with pytest.raises(ConfigError, match="60 dB cannot be reached"):
        double_sh_budget.fit(brick, Budget(psnr=60), MOST)
    with pytest.raises(ConfigError, match="100 bytes cannot be reached"):
        double_sh_budget.fit(brick, Budget(size=100), MOST)
