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
    with pytest.raises(FormatError, match="expected a PNG, JPEG, TIFF or EXR"):
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


@pytest.mark.parametrize("compression", ["raw", "tiff_lzw", "tiff_deflate", "packbits", "jpeg"])
def test_tiff_is_read_like_png(tmp_path, rng, compression):
    codes = torch.randint(0, 256, (8, 8, 3), generator=rng, dtype=torch.uint8)
    if compression == "jpeg":
        codes[:] = 90
    Image.fromarray(codes.numpy()).save(tmp_path / "a.tif", compression=compression)
    found = image.read_codes((tmp_path / "a.tif").read_bytes(), "a.tif")
    assert int((found.int() - codes.int()).abs().max()) <= (2 if compression == "jpeg" else 0)
    torch.testing.assert_close(image.read(tmp_path / "a.tif"), image.decode_codes(found))


@pytest.mark.parametrize("suffix", ["tif", "png"])
def test_sixteen_bits_are_rounded_to_eight(tmp_path, suffix):
    """One channel of 16 bits, which Pillow itself cuts off at 255."""
    values = np.array([[0, 257, 30000, 65535]], np.uint16)
    Image.fromarray(values).save(tmp_path / f"a.{suffix}")
    for found in (
        image.read_codes((tmp_path / f"a.{suffix}").read_bytes(), "a"),
        image.encode_codes(image.read(tmp_path / f"a.{suffix}")),
    ):
        assert found[0, :, 1].tolist() == [0, 1, 117, 255]


@pytest.mark.errors
def test_floats_in_tiff_are_refused_as_colour(tmp_path):
    values = np.array([[0.0, 0.5]], np.float32)
    Image.fromarray(values).save(tmp_path / "a.tif")
    with pytest.raises(FormatError, match="expected whole numbers of 8 or 16 bits, got floats"):
        image.read(tmp_path / "a.tif")
    torch.testing.assert_close(image.read_data(tmp_path / "a.tif"), torch.from_numpy(values))


@pytest.mark.errors
def test_a_picture_that_announces_too_much_is_refused_before_it_is_decoded(tmp_path):
    import io
    import struct
    import zlib

    stream = io.BytesIO()
    Image.new("RGB", (1, 1)).save(stream, "PNG")
    content = bytearray(stream.getvalue())
    content[16:24] = struct.pack(">II", 9000, 9000)
    content[29:33] = struct.pack(">I", zlib.crc32(content[12:29]))
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(FormatError, match="announces 9000 x 9000 pixels, too many for"):
        image.read(tmp_path / "a.png")
