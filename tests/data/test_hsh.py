import math
import struct

import numpy as np
import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.data import hsh, image
from torchmeso.data.address import texel_centres
from torchmeso.data.hsh import Hsh
from torchmeso.errors import FormatError, ShapeError
from torchmeso.geometry.directions import from_angles


def file_bytes(codes, scale, bias, newline="\n", head="#HSH1.2"):
    """A file written number by number."""
    height, width, _, terms = codes.shape
    out = f"{head}{newline}3{newline}{width} {height} 3{newline}{terms} 2 1{newline}".encode()
    for number in (*scale, *bias):
        out += struct.pack("<f", number)
    for y in range(height):
        for x in range(width):
            for channel in range(3):
                out += bytes(codes[y, x, channel].tolist())
    return out


def some(terms, rng):
    codes = torch.randint(0, 256, (3, 2, 3, terms), generator=rng, dtype=torch.uint8)
    return codes, [0.5 + 0.1 * k for k in range(terms)], [-0.25 * k for k in range(terms)]


@pytest.mark.parametrize("terms", [4, 9, 16])
@pytest.mark.parametrize("newline", ["\n", "\r\n"])
def test_files_by_others_and_our_own(tmp_path, terms, newline, rng):
    codes, scale, bias = some(terms, rng)
    (tmp_path / "a.rti").write_bytes(file_bytes(codes, scale, bias, newline, f"#HSH1.2{newline}# a comment"))
    for path in (tmp_path / "a.rti", tmp_path / "b.rti"):
        found = hsh.read(path)
        assert torch.equal(found.codes, codes)
        torch.testing.assert_close(found.scale, torch.tensor(scale), rtol=0, atol=0)
        torch.testing.assert_close(found.bias, torch.tensor(bias), rtol=0, atol=0)
        hsh.write(found, tmp_path / "b.rti")


def test_the_basis_is_orthonormal_on_the_hemisphere():
    nodes, weights = np.polynomial.legendre.leggauss(12)
    c = torch.from_numpy(nodes / 2 + 0.5)
    phi = torch.arange(16, dtype=torch.float64) * (2 * math.pi / 16)
    w = from_angles(c.acos()[:, None].expand(12, 16), phi.expand(12, 16))
    Y = hsh.basis(w, 16)
    solid = torch.from_numpy(weights / 2)[:, None].expand(12, 16) * 2 * math.pi / 16
    gram = torch.einsum("ijk,ijl,ij->kl", Y, Y, solid)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), **FLOAT64)


def test_terms_stand_in_the_order_of_the_format():
    """As formulas in theta and phi, term by term."""
    theta, phi = torch.tensor(0.7, dtype=torch.float64), torch.tensor(0.4, dtype=torch.float64)
    c, root = math.cos(0.7), math.sqrt(math.cos(0.7) - math.cos(0.7) ** 2)
    expected = [
        1 / math.sqrt(2 * math.pi),
        math.sqrt(6 / math.pi) * math.cos(0.4) * root,
        math.sqrt(3 / (2 * math.pi)) * (2 * c - 1),
        math.sqrt(6 / math.pi) * root * math.sin(0.4),
        math.sqrt(30 / math.pi) * math.cos(0.8) * (c * c - c),
        math.sqrt(30 / math.pi) * math.cos(0.4) * (2 * c - 1) * root,
        math.sqrt(5 / (2 * math.pi)) * (1 - 6 * c + 6 * c * c),
        math.sqrt(30 / math.pi) * (2 * c - 1) * root * math.sin(0.4),
        math.sqrt(30 / math.pi) * (c * c - c) * math.sin(0.8),
        2 * math.sqrt(35 / math.pi) * math.cos(1.2) * root**3,
        math.sqrt(210 / math.pi) * math.cos(0.8) * (2 * c - 1) * (c * c - c),
        2 * math.sqrt(21 / math.pi) * math.cos(0.4) * root * (1 - 5 * c + 5 * c * c),
        math.sqrt(7 / (2 * math.pi)) * (-1 + 12 * c - 30 * c**2 + 20 * c**3),
        2 * math.sqrt(21 / math.pi) * root * (1 - 5 * c + 5 * c * c) * math.sin(0.4),
        math.sqrt(210 / math.pi) * (2 * c - 1) * (c * c - c) * math.sin(0.8),
        2 * math.sqrt(35 / math.pi) * root**3 * math.sin(1.2),
    ]
    found = hsh.basis(from_angles(theta, phi), 16)
    torch.testing.assert_close(found, torch.tensor(expected, dtype=torch.float64), **FLOAT64)


def test_value_at_texels_and_below_the_horizon(rng):
    codes, scale, bias = some(9, rng)
    table = Hsh(codes=codes, scale=torch.tensor(scale), bias=torch.tensor(bias))
    wi = from_angles(torch.tensor(0.5, dtype=torch.float64), torch.tensor(2.0, dtype=torch.float64)).expand(3, 2, 3)
    uv = texel_centres(3, 2, torch.float64)
    coefficients = codes.double() / 255 * table.scale + table.bias
    srgb = (coefficients * hsh.basis(wi, 9)[:, :, None]).sum(-1)
    torch.testing.assert_close(table.evaluate(uv, wi), image.to_linear(srgb.clamp(min=0)), **FLOAT64)
    assert not table.evaluate(uv, wi * torch.tensor([1, 1, -1])).any()


def test_gradient_is_finite_at_the_pole_and_right_elsewhere(rng):
    w = from_angles(torch.tensor([0.3, 1.2], dtype=torch.float64), torch.tensor([1.0, 4.0], dtype=torch.float64))
    assert torch.autograd.gradcheck(lambda w: hsh.basis(w, 16), w.requires_grad_())
    pole = torch.tensor([0.0, 0.0, 1.0], requires_grad=True)
    hsh.basis(pole, 16).sum().backward()
    assert pole.grad is not None
    assert bool(pole.grad.isfinite().all())


@pytest.mark.errors
def test_damage_is_named(tmp_path, rng):
    path = tmp_path / "a.rti"
    with pytest.raises(FormatError, match="expected a hemispherical harmonics map"):
        hsh.read(path)
    codes, scale, bias = some(9, rng)
    whole = file_bytes(codes, scale, bias)
    path.write_bytes(whole[:-1])
    with pytest.raises(FormatError, match="expected 234 bytes for 2 x 3 texels, got 233; the copy may be incomplete"):
        hsh.read(path)
    path.write_bytes(whole.replace(b"9 2 1", b"9 1 1"))
    with pytest.raises(FormatError, match=r"got \(3\), 3 channels, 9 terms of kind 1 in 1 bytes"):
        hsh.read(path)
    path.write_bytes(b"PTM_1.2\n")
    with pytest.raises(FormatError, match="expected the header of an RTI file"):
        hsh.read(path)
    with pytest.raises(ShapeError, match="expected 4, 9 or 16 terms, got 5"):
        Hsh(codes=codes[..., :5], scale=torch.ones(5), bias=torch.ones(5))


@pytest.mark.errors
@pytest.mark.parametrize("n", [1000, pytest.param(20_000, marks=pytest.mark.slow)])
def test_nothing_but_our_errors_leaves(n, tmp_path, rng):
    whole = file_bytes(*some(4, rng))
    random = np.random.default_rng(0)
    for k in range(n):
        data = bytearray(whole[: random.integers(len(whole))] if k % 3 == 0 else whole)
        for place in random.integers(0, min(max(len(data), 1), 60), 2):
            if len(data) > place:
                data[place] = random.integers(256)
        (tmp_path / "a.rti").write_bytes(data)
        try:
            hsh.read(tmp_path / "a.rti")
        except (FormatError, ShapeError):
            continue
