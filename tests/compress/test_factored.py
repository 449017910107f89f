import pytest
import torch

from torchmeso.compress import budget, factored
from torchmeso.compress.factored import FactoredOptions
from torchmeso.data import factored_btf
from torchmeso.data.btf import Btf
from torchmeso.geometry import hemisphere
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions
from torchmeso.pipeline.bake import open_model

LIGHTS, VIEWS = hemisphere.grid(4, 2, 80), hemisphere.grid(5, 2, 75)


@pytest.fixture
def few(rng):
    """A table of three components of every channel, rows and columns of other numbers."""
    pair, texel = torch.rand(8, 10, 3, 3, generator=rng), torch.rand(5, 7, 3, 3, generator=rng)
    return Btf(images=torch.einsum("lvck,hwck->lvhwc", pair, texel), lights=LIGHTS, views=VIEWS)


@pytest.mark.parametrize(("colour", "rank"), [("rgb", 3), ("yuv", 9), ("log-y", 24)])
def test_as_many_components_as_there_are_give_the_table_back(colour, rank, few):
    model = factored.fit(few, FactoredOptions(rank=rank, colour=colour))
    torch.testing.assert_close(model.rows(0, 5), few.images, rtol=0, atol=2e-2)  # halves; measured 3e-3
    assert budget.psnr_of(few.images, model.rows(0, 5)) > 50


@pytest.mark.parametrize("colour", ["rgb", "log-y"])
def test_it_opens_as_an_eigen_btf_that_is_as_near(colour, tmp_path):
    options = BtfOptions(texels=12, lights="grid(8, 3, 80)", views="grid(8, 3, 80)", samples=4, bounces=0)
    table = bake_btf.in_memory(generators.weave(), options)
    T = table.pictures().float().clamp(min=0)
    model = factored.fit(Btf(images=T, lights=table.lights, views=table.views), FactoredOptions(rank=8, colour=colour))
    factored_btf.save(model, tmp_path / "a.meso")
    opened = open_model(tmp_path / "a.meso").btf
    assert opened.rank == model.opened_rank
    assert (
        budget.psnr_of(T, torch.einsum("lhwkc,vk->lvhwc", opened.decoded(), opened.weights))
        > budget.psnr_of(T, model.rows(0, 12)) - 0.35
    )  # measured 0.1 to 0.2
    assert open_model(tmp_path / "a.meso", rank=2).btf.rank == 2


def test_large_and_tiny_values_fit_into_halves(few):
    for unit in (1e5, 1e-5):
        table = Btf(images=few.images * unit, lights=LIGHTS, views=VIEWS)
        model = factored.fit(table, FactoredOptions(rank=3))
        assert budget.psnr_of(table.images, model.rows(0, 5)) > 50


def test_one_row_after_the_other_is_the_whole(few):
    model = factored.fit(few, FactoredOptions(rank=2))
    assert torch.equal(torch.cat([model.rows(r, r + 1) for r in range(5)], 2), model.rows(0, 5))
