from dataclasses import replace

import pytest
import torch

from torchmeso.algebra.spherical_harmonics import basis, degree_of
from torchmeso.compress import double_sh, eigen
from torchmeso.compress.budget import psnr_of
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.quantize import one_by_one, quantize, spread, steps
from torchmeso.data import eigen_btf, sh_btf
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions


def decode(q):
    return q.offset + q.scale * q.codes.float()


def test_uint8_is_within_half_a_step(rng):
    x = torch.randn(50, 4, 3, generator=rng) * torch.logspace(-3, 3, 12).reshape(4, 3)
    q = quantize(x, "uint8")
    assert ((decode(q) - x).abs() <= q.scale * 0.5001).all()


def test_float16_keeps_eleven_bits_at_any_size(rng):
    x = torch.randn(50, 4, 3, generator=rng) * 1e6
    assert ((decode(quantize(x, "float16")) - x).abs().amax(0) / x.abs().amax(0)).max() < 2**-11


def test_float32_is_exact(rng):
    x = torch.randn(50, 4, 3, generator=rng)
    assert torch.equal(decode(quantize(x, "float32")), x)


def test_constant_and_zero_maps():
    for value in (0.0, 3.5, -2.0):
        x = torch.full((10, 2, 3), value)
        for storage in ("uint8", "float16", "float32"):
            torch.testing.assert_close(decode(quantize(x, storage)), x, rtol=1e-3, atol=1e-6)


def test_adaptive_steps_give_every_component_the_same_error_of_t(rng):
    """Spreads of 1 to 1000 and gains of 1 to 16: uniform noise of one T for all but what is below it."""
    size, gain = torch.tensor([1000.0, 100, 10, 1]), torch.tensor([1.0, 4, 16, 1])
    x = size[:, None] * torch.randn(20000, 4, 3, generator=rng)
    step = steps([spread(x[:, k]) for k in range(4)], gain, 1e4)
    error, eight_bits = (
        gain[:, None] * (decode(quantize(x, storage, step)) - x).square().mean(0) for storage in ("adaptive", "uint8")
    )
    total = 1e4 + float(eight_bits.sum(0).mean())
    assert 1e4 + error.sum(0).mean() == pytest.approx(1.02 * total, rel=2e-3)
    assert (error[:2] / error[0, 0] - 1).abs().max() < 0.1
    assert torch.allclose(error[3].sqrt(), torch.ones(3), rtol=0.05)  # below the noise of the others: its mean


def test_adaptive_is_as_exact_as_eight_bits_where_nothing_else_is_lost(rng):
    x = torch.randn(5000, 3, 3, generator=rng) * torch.tensor([100.0, 10, 1])[:, None]
    step = steps([spread(x[:, k]) for k in range(3)], torch.ones(3), 0.0)
    ours, eight = (
        (decode(quantize(x, storage, step)) - x).square().mean((0, 2)).sum() for storage in ("adaptive", "uint8")
    )
    assert ours <= 1.03 * eight


def test_adaptive_codes_are_few_and_spread_over_the_byte(rng):
    x = torch.randn(1000, 2, 3, generator=rng)
    codes = quantize(x, "adaptive", torch.tensor([[1.0], [20.0]]).expand(2, 3)).codes
    assert 5 <= len(codes[:, 0].unique()) <= 9 and codes[:, 0].max() > 127
    assert not codes[:, 1].any()  # all within a step


def test_one_by_one_is_as_all_at_once(rng):
    x = torch.randn(300, 4, 3, generator=rng)
    step = steps([spread(x[:, k]) for k in range(4)], torch.ones(4), 0.1)
    for storage in ("uint8", "float16", "float32", "adaptive"):
        alone, together = one_by_one(x, storage, step), quantize(x, storage, step)
        torch.testing.assert_close(decode(alone), decode(together))


def test_adaptive_steps_of_constant_maps():
    x = torch.full((10, 2, 3), 3.5)
    step = steps([spread(x[:, k]) for k in range(2)], torch.ones(2), 0.0)
    torch.testing.assert_close(decode(quantize(x, "adaptive", step)), x)


@pytest.fixture(scope="module")
def brick():
    options = BtfOptions(texels=24, lights="grid(8, 4, 80)", views="grid(8, 4, 80)", samples=1, bounces=0)
    return bake_btf.in_memory(generators.brick(), options)


def shown(model):
    if isinstance(model, eigen_btf.EigenBtf):
        return torch.einsum("lhwkc,vk->lvhwc", model.decoded(), model.weights)
    y = [
        basis(side.directions(), degree_of(n)) for side, n in zip((model.lights, model.views), model.terms, strict=True)
    ]
    return torch.einsum("li,vj,ijhwc->lvhwc", *y, model.decoded())


@pytest.mark.parametrize(
    ("options", "factor"),
    [
        (EigenOptions(rank=4), 7),
        (EigenOptions(rank=16), 4.5),  # measured 6.0
        (DoubleShOptions(light_terms=9, view_terms=9), 5.5),  # measured 7.4
        (DoubleShOptions(light_terms=16, view_terms=16, energy=10), 2.5),  # measured 3.3
    ],
    ids=["eigen4", "eigen16", "double-sh9", "double-sh16"],
)
def test_the_file_is_smaller_at_the_same_error(options, factor, brick, tmp_path):
    fit, kind = (eigen, eigen_btf) if isinstance(options, EigenOptions) else (double_sh, sh_btf)
    error, size = {}, {}
    for storage in ("uint8", "adaptive"):
        model = fit.fit(brick, replace(options, storage=storage))
        kind.save(model, tmp_path / "a.meso", coded=storage == "adaptive")
        error[storage] = psnr_of(brick.pictures().float(), shown(kind.load(tmp_path / "a.meso")))
        size[storage] = (tmp_path / "a.meso").stat().st_size
    assert error["adaptive"] > error["uint8"] - 0.1
    assert size["uint8"] > factor * size["adaptive"]
