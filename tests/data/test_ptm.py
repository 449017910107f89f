import numpy as np
import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.data import image, ptm
from torchmeso.data.address import texel_centres
from torchmeso.data.ptm import Ptm
from torchmeso.errors import FormatError, ShapeError
from torchmeso.geometry.directions import normalize

SCALE, BIAS = (2.0, 2.0, 1.5, 2.0, 2.0, 0.5), (160, 160, 160, 127, 127, -20)


def file_bytes(kind, codes, colour=None, newline=b"\n", size=b"4\n3"):
    """A file written from the format's description; codes (H, W, plane, 6) and colour (H, W, 3), row 0 on top."""
    scale, bias = (" ".join(map(str, x)).encode() for x in (SCALE, BIAS))
    out = b"PTM_1.2" + newline + kind + newline + size + newline + scale + b" " + newline + bias + b" " + newline
    height, width, planes, _ = codes.shape
    for plane in range(planes):
        for y in reversed(range(height)):
            for x in range(width):
                out += bytes(codes[y, x, plane].tolist())
    if colour is not None:
        for y in reversed(range(height)):
            for x in range(width):
                out += bytes(colour[y, x].tolist())
    return out


def some(planes, rng):
    codes = torch.randint(0, 256, (3, 4, planes, 6), generator=rng, dtype=torch.uint8)
    colour = torch.randint(0, 256, (3, 4, 3), generator=rng, dtype=torch.uint8) if planes == 1 else None
    return codes, colour


@pytest.mark.parametrize("kind", ["LRGB", "RGB"])
def test_files_by_others_and_our_own(tmp_path, kind, rng):
    codes, colour = some(1 if kind == "LRGB" else 3, rng)
    for newline, size in ((b"\n", b"4\n3"), (b"\n", b"4 3"), (b"\r\n", b"4 3")):
        (tmp_path / "a.ptm").write_bytes(file_bytes(f"PTM_FORMAT_{kind}".encode(), codes, colour, newline, size))
        for path in (tmp_path / "a.ptm", tmp_path / "b.ptm"):
            found = ptm.read(path)
            assert torch.equal(found.codes, codes)
            assert (found.colour is None) == (colour is None)
            assert colour is None or torch.equal(found.colour, colour)
            assert (tuple(found.scale.tolist()), tuple(found.bias.tolist())) == (SCALE, BIAS)
            ptm.write(found, tmp_path / "b.ptm")


@pytest.mark.parametrize("planes", [1, 3])
def test_value_at_texels_is_the_polynomial(planes, rng):
    codes, colour = some(planes, rng)
    table = Ptm(codes=codes, scale=torch.tensor(SCALE), bias=torch.tensor(BIAS).float(), colour=colour)
    x, y, z = 0.3, -0.4, (1 - 0.25) ** 0.5
    wi = torch.tensor([x, y, z], dtype=torch.float64).expand(3, 4, 3)
    T = table.evaluate(texel_centres(3, 4, torch.float64), wi)
    for row in range(3):
        for column in range(4):
            a = [
                [(c - b) * s for c, b, s in zip(codes[row, column, p].tolist(), BIAS, SCALE, strict=True)]
                for p in range(planes)
            ]
            L = [p[0] * x * x + p[1] * y * y + p[2] * x * y + p[3] * x + p[4] * y + p[5] for p in a]
            if colour is not None:
                L = [L[0] * c / 255 for c in colour[row, column].tolist()]
            expected = image.to_linear(torch.tensor(L, dtype=torch.float64).clamp(min=0) / 255)
            torch.testing.assert_close(T[row, column], expected, **FLOAT64)


def test_dark_below_the_horizon_and_differentiable(rng):
    codes, colour = some(1, rng)
    table = Ptm(codes=codes, scale=torch.ones(6) / 9, bias=torch.zeros(6), colour=colour)
    uv = torch.rand(5, 2, dtype=torch.float64, generator=rng).requires_grad_()
    wi = normalize(torch.rand(5, 3, dtype=torch.float64, generator=rng) + 0.1)
    assert not table.evaluate(uv, wi * torch.tensor([1, 1, -1])).any()
    assert torch.autograd.gradcheck(table.evaluate, (uv, wi.clone().requires_grad_()))


@pytest.mark.errors
def test_damage_is_named(tmp_path, rng):
    path = tmp_path / "a.ptm"
    with pytest.raises(FormatError, match="expected a polynomial texture map"):
        ptm.read(path)
    codes, colour = some(1, rng)
    whole = file_bytes(b"PTM_FORMAT_LRGB", codes, colour)
    path.write_bytes(whole[:-1])
    with pytest.raises(FormatError, match="expected 108 bytes for 4 x 3 texels, got 107; the copy may be incomplete"):
        ptm.read(path)
    path.write_bytes(whole.replace(b"LRGB", b"JPEG_LRGB"))
    with pytest.raises(FormatError, match="PTM_FORMAT_JPEG_LRGB cannot be read; write it anew as PTM_FORMAT_LRGB"):
        ptm.read(path)
    path.write_bytes(whole.replace(b"PTM_1.2", b"PTM_1.1"))
    with pytest.raises(FormatError, match=r"expected the header of a PTM_1\.2 file"):
        ptm.read(path)
    with pytest.raises(ShapeError, match=r"ptm\.codes: expected shape \(any, any, 3, 6\)"):
        Ptm(codes=codes, scale=torch.ones(6), bias=torch.zeros(6))


@pytest.mark.errors
@pytest.mark.parametrize("n", [1000, pytest.param(20_000, marks=pytest.mark.slow)])
def test_nothing_but_our_errors_leaves(n, tmp_path, rng):
    codes, colour = some(1, rng)
    whole = file_bytes(b"PTM_FORMAT_LRGB", codes, colour)
    random = np.random.default_rng(0)
    for k in range(n):
        data = bytearray(whole[: random.integers(len(whole))] if k % 3 == 0 else whole)
        for place in random.integers(0, min(max(len(data), 1), 80), 2):
            if len(data) > place:
                data[place] = random.integers(256)
        (tmp_path / "a.ptm").write_bytes(data)
        try:
            ptm.read(tmp_path / "a.ptm")
        except (FormatError, ShapeError):
            continue
