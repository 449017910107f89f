import io
import zlib

import numpy as np
import pytest
import torch
from PIL import Image

from torchmeso.data import image
from torchmeso.errors import FormatError, StorageError


def test_png_round_trip_is_within_half_a_code(tmp_path, rng):
    rgb = torch.rand(9, 7, 3, generator=rng)
    image.write_png(tmp_path / "a.png", rgb)
    back = image.read(tmp_path / "a.png")
    assert (image.to_srgb(back) - image.to_srgb(rgb)).abs().max() <= 0.5 / 255 + 1e-6


def test_gamma_is_applied_once(tmp_path):
    image.write_png(tmp_path / "a.png", torch.full((1, 1, 3), 0.2140))
    assert np.asarray(Image.open(tmp_path / "a.png"))[0, 0].tolist() == [127, 127, 127]


def test_srgb_inverts(rng):
    x = torch.rand(1000, dtype=torch.float64, generator=rng)
    torch.testing.assert_close(image.to_linear(image.to_srgb(x)), x, rtol=0, atol=1e-7)


def test_exr_round_trip_of_a_strided_picture(tmp_path, rng):
    rgb = (torch.rand(3, 6, 8, generator=rng) * 100).permute(1, 2, 0).flip(1)
    depth = torch.rand(8, 6, generator=rng).T
    image.write_exr(tmp_path / "a.exr", rgb, Z=depth)
    assert torch.equal(image.read(tmp_path / "a.exr"), rgb)


def test_height_pictures_are_not_touched_by_gamma(tmp_path):
    Image.fromarray(np.array([[0, 32768, 65535]], dtype=np.uint16)).save(tmp_path / "h.png")
    assert torch.allclose(image.read_data(tmp_path / "h.png"), torch.tensor([[0.0, 0.500008, 1.0]]), atol=1e-6)
    Image.fromarray(np.array([[0, 51, 255]], dtype=np.uint8)).save(tmp_path / "h8.png")
    assert torch.allclose(image.read_data(tmp_path / "h8.png"), torch.tensor([[0.0, 0.2, 1.0]]))


def test_nan_and_overflow_become_black_and_white():
    rgb = torch.tensor([[[torch.nan, torch.inf, -1.0]]])
    assert image.to_bytes(rgb).tolist() == [[[0, 255, 0]]]


@pytest.mark.errors
def test_missing_and_damaged_pictures_say_so(tmp_path):
    for reader in (image.read, image.read_data):
        for name in ("no.png", "no.exr"):
            with pytest.raises(FormatError, match="expected a picture, found none"):
                reader(tmp_path / name)
    (tmp_path / "bad.png").write_bytes(b"\x89PNG\r\n\x1a\n1234")
    with pytest.raises(FormatError, match="expected a PNG, JPEG or EXR"):
        image.read(tmp_path / "bad.png")
    (tmp_path / "bad.exr").write_bytes(b"1234")
    with pytest.raises(FormatError, match="expected an OpenEXR"):
        image.read(tmp_path / "bad.exr")


@pytest.mark.errors
def test_an_exr_that_cannot_be_written(tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("File too large.")

    monkeypatch.setattr("OpenEXR.File.write", fail)
    with pytest.raises(StorageError, match=r"a\.exr: could not be written \(File too large\.\)"):
        image.write_exr(tmp_path / "a.exr", torch.zeros(2, 2, 3))
    assert not list(tmp_path.iterdir())


def test_codes_decode_and_encode_to_themselves(tmp_path):
    codes = torch.arange(256, dtype=torch.uint8).reshape(16, 16, 1).repeat(1, 1, 3)
    assert torch.equal(image.encode_codes(image.decode_codes(codes)), codes)
    torch.testing.assert_close(image.decode_codes(codes), image.to_linear(codes.float() / 255))
    Image.fromarray(codes.numpy()).save(tmp_path / "a.png")
    assert torch.equal(image.read_codes((tmp_path / "a.png").read_bytes(), "a"), codes)


@pytest.mark.errors
def test_codes_of_a_damaged_picture_are_refused():
    with pytest.raises(FormatError, match="a: cannot be read"):
        image.read_codes(b"\xff\xd8\xff\xe0 not much", "a")
    header = b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", (9000).to_bytes(4, "big") * 2 + b"\x08\x02\0\0\0")
    with pytest.raises(FormatError, match="a: announces 9000 x 9000 pixels, too many for 45 bytes"):
        image.read_codes(header + png_chunk(b"IDAT", b""), "a")


def png_chunk(kind, content):
    return len(content).to_bytes(4, "big") + kind + content + zlib.crc32(kind + content).to_bytes(4, "big")


@pytest.mark.errors
@pytest.mark.parametrize("n", [300, pytest.param(20_000, marks=pytest.mark.slow)])
def test_nothing_but_our_errors_leaves_damaged_codes(n):
    codes = np.random.default_rng(0).integers(0, 256, (9, 17, 3)).astype(np.uint8)
    files = []
    for kind in ("PNG", "JPEG"):
        Image.fromarray(codes).save(file := io.BytesIO(), format=kind)
        files.append(file.getvalue())
    random = np.random.default_rng(1)
    for k in range(n):
        whole = files[k % 2]
        data = bytearray(whole[: random.integers(1, len(whole))] if k % 3 == 0 else whole)
        for place in random.integers(0, len(data), 3):
            data[place] = random.integers(256)
        try:
            image.read_codes(bytes(data), "a")
        except FormatError:
            continue
