import struct

import numpy as np
import pytest

from tests.data import btf_bytes
from tests.data.btf_bytes import HEIGHT, PAIRS, TEXELS, WIDTH
from torchmeso.data import btfdbb, btfdbb_bdi
from torchmeso.errors import FormatError, SizeError

VALUES = btf_bytes.random_values()
HALVES = VALUES.astype(np.float16).astype(np.float32)
MASK = np.arange(TEXELS) % 4 > 0


def survey(path, raw):
    (path / "a.btf").write_bytes(raw)
    return btfdbb.survey(path / "a.btf")


@pytest.mark.parametrize("rows", [1, 2, 3, 99])
@pytest.mark.parametrize("compression", [0, 1, 2])
def test_halves_come_back_bit_for_bit(tmp_path, compression, rows):
    file = survey(tmp_path, btf_bytes.bdi(VALUES, compression=compression, rows=rows, mask=MASK))
    expected = HALVES * MASK[:, None] if compression == 2 else HALVES
    for pairs, texels in ((slice(0, PAIRS), slice(0, TEXELS)), (slice(7, 8), slice(4, 11))):
        np.testing.assert_array_equal(file.body.values(pairs, texels), expected[pairs, texels])
    assert file.body.facts()["texels measured"] == "73%"
    assert file.header.rotations.shape == (1, 3, 3)


def bzip(raw):
    """A file of one bzip chunk with these bytes."""
    body = struct.pack("<IB", HEIGHT, 1) + b"\1" * TEXELS + struct.pack("<I", 0)
    return btf_bytes.header("!BDIF06R2!") + body + struct.pack("<I", len(raw)) + raw


@pytest.mark.errors
def test_damaged_chunks(tmp_path):
    whole = btf_bytes.bz2.compress(btf_bytes.numbers(VALUES, 2))
    longer = btf_bytes.bz2.compress(bytes(10_000_000))
    for raw, text in (
        (b"BZh9 not so", "chunk 0 cannot be decompressed"),
        (whole[:-20], "chunk 0: expected 2160 bytes, got 0"),
        (longer, "chunk 0: expected 2160 bytes, got more"),
    ):
        with pytest.raises(FormatError, match=text):
            survey(tmp_path, bzip(raw)).body.values(slice(0, 1), slice(0, 1))


@pytest.mark.errors
@pytest.mark.parametrize(
    ("raw", "text"),
    [
        (btf_bytes.bdi(VALUES, compression=3), "compression 0 to 2 and 3 channels, got 2, 3 and 3"),
        (btf_bytes.bdi(VALUES, channels=("y",)), "got 2, 0 and 1"),
        (btf_bytes.bdi(VALUES, rows=2).replace(struct.pack("<I", 1440), struct.pack("<I", 1439)), "header says 1439"),
        (btf_bytes.bdi(VALUES)[:-1], "bytes of a chunk at byte"),
        (btf_bytes.header("!BDIF06R2!") + struct.pack("<IB", 0, 0), "got 0, 0 and 3"),
    ],
)
def test_sizes_that_do_not_agree(tmp_path, raw, text):
    with pytest.raises(FormatError, match=text):
        survey(tmp_path, raw)


@pytest.mark.errors
def test_chunks_beyond_the_limit(tmp_path, monkeypatch):
    """A chunk of which nothing is stored is no reason to take memory."""
    monkeypatch.setattr(btfdbb_bdi, "MEMORY_LIMIT", 1000)
    file = survey(tmp_path, btf_bytes.bdi(VALUES, compression=2, mask=np.zeros(TEXELS, bool)))
    with pytest.raises(SizeError, match=r"chunk 0: needs 1\.4 KiB of memory"):
        file.body.values(slice(0, 1), slice(0, WIDTH))
