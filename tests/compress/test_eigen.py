import pytest
import torch

from torchmeso.compress import eigen
from torchmeso.compress.eigen import EigenOptions, fit
from torchmeso.data import bands
from torchmeso.data import btf as btf_module
from torchmeso.data.btf import Btf
from torchmeso.errors import ConfigError, ShapeError
from torchmeso.geometry import hemisphere

LIGHTS, VIEWS = hemisphere.grid(4, 3, 80), hemisphere.grid(5, 2, 75)


def low_rank(rng, rank, noise=0.0):
    maps = torch.rand(len(LIGHTS), 6, 7, rank, 3, generator=rng)
    weights = torch.rand(len(VIEWS), rank, generator=rng)
    images = torch.einsum("lhwkc,vk->lvhwc", maps, weights)
    images = images + noise * torch.randn(images.shape, generator=rng)
    return Btf(images=images, lights=LIGHTS, views=VIEWS)


def written_out(model):
    return torch.einsum("lhwkc,vk->lvhwc", model.decoded(), model.weights)


def test_rank_n_reproduces_a_rank_n_table(rng):
    btf = low_rank(rng, 3)
    model = fit(btf, EigenOptions(rank=3, storage="float32"))
    torch.testing.assert_close(written_out(model), btf.images, rtol=0, atol=4e-5)  # measured 8e-6 in float32


@pytest.mark.parametrize("rank", [1, 2, 5, 10])
def test_error_is_the_svd_optimum(rng, rank):
    btf = low_rank(rng, 4, noise=0.2)
    matrix = btf.images.double().permute(0, 2, 3, 4, 1).reshape(-1, len(VIEWS))
    optimum = torch.linalg.svdvals(matrix)[rank:].square().sum().sqrt()
    model = fit(btf, EigenOptions(rank=rank, storage="float32"))
    error = (written_out(model).double() - btf.images.double()).norm()
    assert error <= optimum * (1 + 1e-5) + 1e-4


def test_error_falls_with_the_rank_and_storage_costs_little(rng):
    btf = low_rank(rng, 6, noise=0.05)
    errors = [
        float((written_out(fit(btf, EigenOptions(rank=k, storage="float32"))) - btf.images).norm())
        for k in range(1, 10)
    ]
    assert errors == sorted(errors, reverse=True)
    small = float((written_out(fit(btf, EigenOptions(rank=4, storage="uint8"))) - btf.images).norm())
    assert small < errors[3] * 1.1


def test_bands_do_not_matter(rng, monkeypatch, tmp_path):
    btf = low_rank(rng, 4, noise=0.1)
    whole = fit(btf, EigenOptions(rank=3, storage="float32"))
    btf_module.save(btf, tmp_path / "a.btf.zarr", dtype="float32")
    monkeypatch.setattr(bands, "ROOM", 1)
    banded = fit(btf_module.load(tmp_path / "a.btf.zarr"), EigenOptions(rank=3, storage="float32"))
    assert torch.equal(banded.maps, whole.maps)
    assert torch.equal(banded.weights, whole.weights)


def test_black_rows_cost_nothing(rng, monkeypatch):
    btf = low_rank(rng, 2)
    btf.images[:, :, 1:5] = 0
    multiplied = []
    gram = eigen.gram
    monkeypatch.setattr(eigen, "gram", lambda blocks, n: multiplied.append(blocks) or gram(blocks, n))
    model = fit(btf, EigenOptions(rank=2, storage="float32"))
    assert len(multiplied) == 2
    torch.testing.assert_close(written_out(model), btf.images, rtol=0, atol=4e-5)


def test_progress_reaches_one(rng):
    shares = []
    fit(low_rank(rng, 2), progress=shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1


@pytest.mark.errors
def test_bad_requests_are_refused(rng):
    with pytest.raises(ConfigError, match=r"compress\.rank: expected 1 to 10 \(the number of views\), got 11"):
        fit(low_rank(rng, 2), EigenOptions(rank=11))
    images = torch.zeros(12, 10, 4, 4, 3)
    images[0, 0, 0, 0] = torch.inf
    with pytest.raises(ShapeError, match="got inf at light 0, view 0"):
        fit(Btf(images=images, lights=LIGHTS, views=VIEWS))
