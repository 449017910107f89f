import struct

import numpy as np
import pytest
import torch

from torchmeso.data import image, rgbe
from torchmeso.errors import FormatError


def values(codes):
    """(..., 4) bytes decoded one number at a time, from the format's description."""
    flat = [
        [0.0 if e == 0 else (m + 0.5) * 2.0 ** (e - 136) for m in (r, g, b)]
        for r, g, b, e in codes.reshape(-1, 4).tolist()
    ]
    return np.array(flat, np.float32).reshape(*codes.shape[:-1], 3)


def some_codes(height=6, width=9):
    codes = np.random.default_rng(0).integers(128, 256, (height, width, 4)).astype(np.uint8)
    codes[..., 3] = np.random.default_rng(1).integers(120, 140, (height, width))
    codes[2, :5] = codes[2, 0]  # a run
    codes[1, 3] = 0  # black
    return codes


def header(size, more=""):
    return f"#?RADIANCE\n# made by hand\nFORMAT=32-bit_rle_rgbe\n{more}\n{size}\n".encode()


def packed(codes, runs):
    """Scan lines with channels apart: as runs of equal bytes, or as plain counts."""
    out = b""
    for line in codes:
        out += struct.pack(">BBH", 2, 2, len(line))
        for channel in line.T.tolist():
            while channel:
                n = 1
                while n < min(len(channel), 127) and channel[n] == channel[0]:
                    n += 1
                out += bytes((128 + n, channel[0])) if runs else bytes((n, *channel[:n]))
                channel = channel[n:]
    return out


def test_flat_and_packed_pixels():
    codes = some_codes()
    for body in (codes.tobytes(), packed(codes, runs=True), packed(codes, runs=False)):
        assert np.array_equal(rgbe.decode(header("-Y 6 +X 9") + body, "a"), values(codes))


@pytest.mark.parametrize("height, width", [(1, 1), (3, 7), (2, 8), (2, 300), (1, 40000)])
def test_any_width(height, width):
    codes = some_codes(max(height, 3), max(width, 5))[:height, :width]
    flat = width < 8 or width > 32767
    body = codes.tobytes() if flat else packed(codes, runs=True)
    assert np.array_equal(rgbe.decode(header(f"-Y {height} +X {width}") + body, "a"), values(codes))


@pytest.mark.parametrize("y", ["-Y", "+Y"])
@pytest.mark.parametrize("x", ["-X", "+X"])
@pytest.mark.parametrize("columns", [False, True])
def test_every_order_of_pixels_gives_the_same_picture(y, x, columns):
    codes = some_codes(9, 10)
    stored = codes[:: -1 if y == "+Y" else 1, :: -1 if x == "-X" else 1]
    size = f"{y} 9 {x} 10"
    if columns:
        stored, size = stored.transpose(1, 0, 2), f"{x} 10 {y} 9"
    assert np.array_equal(rgbe.decode(header(size) + packed(stored, runs=True), "a"), values(codes))


def test_exposures_are_divided_out(tmp_path):
    codes = some_codes()
    path = tmp_path / "a.hdr"
    path.write_bytes(header("-Y 6 +X 9", "EXPOSURE=2\nEXPOSURE= 4.0\n") + codes.tobytes())
    assert torch.equal(image.read(path), torch.from_numpy(values(codes) / 8))


def test_real_probe(data_dir):
    rgb = image.read(data_dir / "hdr" / "grace.hdr")
    assert rgb.shape == (128, 256, 3)
    grey = rgb.mean(-1)
    assert float(grey.max() / grey.mean()) == pytest.approx(5163, rel=0.02)  # as documented with it; measured 5103


@pytest.mark.errors
def test_damage_is_named(tmp_path):
    codes = some_codes()
    whole = header("-Y 6 +X 9") + packed(codes, runs=True)
    with pytest.raises(FormatError, match="expected a picture, found none"):
        rgbe.read(tmp_path / "none.hdr")
    with pytest.raises(FormatError, match=r"a: expected a Radiance picture \('#\?RADIANCE'\)"):
        rgbe.decode(b"P6 1 1 255\n\n\n", "a")
    with pytest.raises(FormatError, match="a: expected the format 32-bit_rle_rgbe, got 32-bit_rle_xyze"):
        rgbe.decode(whole.replace(b"rgbe", b"xyze"), "a")
    for size in ("-Y 6 -Y 9", "-Y 6", "-Y 0 +X 9"):
        with pytest.raises(FormatError, match=r"a: expected a size such as '-Y 256 \+X 256', got "):
            rgbe.decode(header(size) + codes.tobytes(), "a")
    with pytest.raises(FormatError, match="expected a positive exposure, got 0"):
        rgbe.decode(header("-Y 6 +X 9", "EXPOSURE=0\n") + codes.tobytes(), "a")
    with pytest.raises(FormatError, match="expected at least 3999996000000 bytes of pixels, got 216"):
        rgbe.decode(header("-Y 999999 +X 1000000") + codes.tobytes(), "a")
    codes[4, 4] = (1, 1, 1, 7)
    with pytest.raises(FormatError, match=r"has runs of the kind before Radiance 2\.0"):
        rgbe.decode(header("-Y 6 +X 9") + codes.tobytes(), "a")
    second = whole.index(b"\x02\x02\x00\x09", whole.index(b"\x02\x02\x00\x09") + 4)
    with pytest.raises(FormatError, match="expected scan line 1 at byte"):
        rgbe.decode(whole[:second] + b"\x03" + whole[second + 1 :], "a")


@pytest.mark.errors
@pytest.mark.parametrize("n", [1000, pytest.param(20_000, marks=pytest.mark.slow)])
def test_nothing_but_our_errors_leaves(n):
    whole = header("-Y 6 +X 9") + packed(some_codes(), runs=True)
    random = np.random.default_rng(3)
    for k in range(n):
        data = bytearray(whole[: random.integers(len(whole))] if k % 2 else whole)
        for place in random.integers(0, max(len(data), 1), 3):
            if len(data):
                data[place] = random.integers(256)
        try:
            rgbe.decode(bytes(data), "a")
        except FormatError:
            continue
