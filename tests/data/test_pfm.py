import numpy as np
import pytest

from torchmeso.data import image, pfm
from torchmeso.errors import FormatError

VALUES = np.arange(24, dtype=np.float32).reshape(2, 4, 3) - 3.5


def content(values, order="<", kind=b"PF"):
    height, width = values.shape[:2]
    scale = b"-1.0" if order == "<" else b"1.0"
    return kind + f"\n{width} {height}\n".encode() + scale + b"\n" + values[::-1].astype(order + "f4").tobytes()


@pytest.mark.parametrize("order", ["<", ">"])
def test_rows_stand_from_the_bottom_up_in_either_byte_order(order):
    assert np.array_equal(pfm.decode(content(VALUES, order), "a"), VALUES)


def test_one_channel_becomes_three():
    assert np.array_equal(pfm.decode(content(VALUES[..., :1], kind=b"Pf"), "a"), np.repeat(VALUES[..., :1], 3, -1))


def test_is_read_wherever_pictures_are(tmp_path):
    (tmp_path / "a.pfm").write_bytes(content(VALUES))
    assert np.array_equal(image.read(tmp_path / "a.pfm").numpy(), VALUES)


@pytest.mark.errors
@pytest.mark.parametrize(
    "data, text",
    [
        (b"P6\n1 1\n255\n", "expected a portable float map"),
        (b"PF\n1 1\n0\n", "expected a portable float map"),
        (content(VALUES)[:-1], "expected 96 bytes for 4 x 2 pixels, got 95"),
        (b"PF\n0 3\n-1\n", "expected 0 bytes"),
    ],
)
def test_what_is_damaged_is_refused(data, text):
    with pytest.raises(FormatError, match=text):
        pfm.decode(data, "a")


@pytest.mark.errors
def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(FormatError, match="found none"):
        pfm.read(tmp_path / "a.pfm")
