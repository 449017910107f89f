import struct

import numpy as np
import pytest
import torch
from PIL import Image

from torchmeso.data import height_field
from torchmeso.data.height_field import HeightField, from_pictures, from_tmd, make_tileable, read_tmd
from torchmeso.errors import ConfigError, FormatError


def write_tmd(path, z, size=18.0):
    """An independent writer of the format, byte by byte."""
    header = b"Binary TrueMap Data File v2.0\r\n\0" + b"Created by a test\r\n\0"
    height, width = z.shape
    header += struct.pack("<2i4f", width, height, size, size, 0.0, 0.0)
    path.write_bytes(header + z.astype("<f4").tobytes())


def test_picture_heights_and_colours(tmp_path):
    grey = np.linspace(0, 255, 64).reshape(8, 8).astype(np.uint8)
    Image.fromarray(grey).save(tmp_path / "h.png")
    Image.fromarray(np.full((16, 16, 3), 188, np.uint8)).save(tmp_path / "c.png")
    field = from_pictures(tmp_path / "h.png", tmp_path / "c.png", h=0.2)
    torch.testing.assert_close(field.height, torch.from_numpy(grey / 255 - 1).float() * 0.2, rtol=0, atol=1e-6)
    assert float(field.albedo.mean()) == pytest.approx(0.5029, abs=1e-3)  # sRGB 188


def test_pictures_are_averaged_down_not_up(tmp_path):
    Image.fromarray(np.tile(np.array([[0, 255]], np.uint8), (8, 4))).save(tmp_path / "h.png")
    field = from_pictures(tmp_path / "h.png", None, h=1.0, texels=4)
    assert field.height.shape == (4, 4)
    assert torch.allclose(field.height, torch.zeros(4, 4), atol=1e-6)  # all means equal, moved to the top
    assert from_pictures(tmp_path / "h.png", None, h=1.0, texels=99).height.shape == (8, 8)


def test_tmd_round_trip(tmp_path):
    z = np.random.default_rng(0).random((6, 9)).astype(np.float32)
    write_tmd(tmp_path / "a.tmd", z)
    back, size = read_tmd(tmp_path / "a.tmd")
    assert size == 18
    assert np.array_equal(back.numpy(), z)


def test_tmd_keeps_its_proportion_or_takes_a_relief(tmp_path):
    z = np.zeros((64, 64), np.float32)
    z[20:40, 20:40] = 0.9
    write_tmd(tmp_path / "a.tmd", z)
    assert from_tmd(tmp_path / "a.tmd").h == pytest.approx(0.05)
    assert from_tmd(tmp_path / "a.tmd", relief=0.2).h == pytest.approx(0.2)


def test_tileable_relief_has_no_jump(rng):
    z = torch.cumsum(torch.rand(40, 40, generator=rng), 0) + torch.linspace(0, 5, 40)
    tiled = make_tileable(z, 0.2)
    for dim in (0, 1):
        inner = tiled.diff(dim=dim).abs().max()
        border = (tiled.select(dim, 0) - tiled.select(dim, 39)).abs().max()
        assert border <= 1.1 * inner
    assert torch.equal(tiled[8:32, 8:32], z[8:32, 8:32])


def test_real_scan(data_dir):
    heights, size = read_tmd(data_dir / "height" / "tmd-1.tmd")
    assert heights.shape == (300, 300)
    assert size == pytest.approx(18.957, abs=1e-3)
    assert float(heights.max() - heights.min()) == pytest.approx(0.351, abs=1e-3)


@pytest.mark.errors
def test_bad_scans_say_so(tmp_path):
    with pytest.raises(FormatError, match=r"expected a \.tmd scan, found none"):
        read_tmd(tmp_path / "no.tmd")
    (tmp_path / "other.tmd").write_bytes(b"PNG")
    with pytest.raises(FormatError, match="expected a Binary TrueMap"):
        read_tmd(tmp_path / "other.tmd")
    write_tmd(tmp_path / "a.tmd", np.ones((8, 8), np.float32))
    raw = (tmp_path / "a.tmd").read_bytes()
    (tmp_path / "short.tmd").write_bytes(raw[:-10])
    with pytest.raises(FormatError, match=r"header says 8 x 8 heights \(.* bytes\), the file has"):
        read_tmd(tmp_path / "short.tmd")
    (tmp_path / "head.tmd").write_bytes(raw[:60])
    with pytest.raises(FormatError, match="header ends after 60 bytes"):
        read_tmd(tmp_path / "head.tmd")
    with pytest.raises(FormatError, match="expected a relief, got a flat surface"):
        from_tmd(tmp_path / "a.tmd")
    with pytest.raises(ConfigError, match=r"height_field\.height"):
        HeightField(height=torch.tensor([[0.1, 0.0]]), albedo=None, h=0.2)
    assert height_field.read_tmd is read_tmd
