import torch

from torchmeso.compress.quantize import quantize


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
