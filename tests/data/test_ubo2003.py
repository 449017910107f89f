import re
import zipfile

import numpy as np
import pytest
import torch

from tests.data import bonn
from tests.data.bonn import LIGHTS, VIEWS
from torchmeso.data import image, picture_set, ubo2003
from torchmeso.errors import FormatError
from torchmeso.geometry import gaps, hemisphere


def zipped(folder, path):
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(folder.rglob("*.*")):
            archive.write(file, str(file.relative_to(folder)))
    return path


def test_a_folder_and_its_zip_hold_the_same(tmp_path):
    codes = bonn.codes()
    names = bonn.write(tmp_path / "set", codes)
    (tmp_path / "set" / "TOY" / "readme.txt").write_text("tl000 pl000 tv000 pv000")
    for path in (tmp_path / "set", zipped(tmp_path / "set", tmp_path / "set.zip")):
        found = ubo2003.survey(path)
        assert (found.lights, found.views, found.encoding) == (LIGHTS, VIEWS, "srgb")
        assert found.files == names
        assert found.missing_text() == "none"
        assert torch.equal(picture_set.read(found).images, codes)


def test_keys_are_read_wherever_they_stand():
    expected = ((15.0, 0.0), (30.0, 330.0))
    for name in (
        "NAME/tv030_pv330/00162 tl015 pl000 tv030 pv330.jpg",
        "WoolPKNT256_00084_tl015_pl360_tv030_pv330.JPG",
        "a\\b\\pv330 tv30 pl0 tl15.hdr",
    ):
        assert ubo2003._angles(name) == expected
    for name in (
        "tl015 pl000 tv030.jpg",
        "tl015 pl000 tv030 pv330.txt",
        "tl1 tl2 pl0 tv0 pv0.jpg",
        "stl1 pl0 tv0 pv0.jpg",
    ):
        assert ubo2003._angles(name) is None
    assert ubo2003._angles("tl000 pl090 tv023.5 pv007.png") == ((0.0, 0.0), (23.5, 7.0))


def test_directions_are_in_the_order_of_the_set(tmp_path):
    lights = hemisphere.ubo81()
    view = hemisphere.from_rings((30,), (1,), (60,))
    codes = bonn.codes(lights, view, 1, 1)
    bonn.write(tmp_path, codes, lights, view)
    found = ubo2003.survey(tmp_path)
    assert (found.lights, found.views) == (lights, view)
    table = picture_set.read(found)
    uv, wo = torch.zeros(81, 2), view.directions().expand(81, 3)
    T = table.evaluate(uv, lights.directions(), wo)
    torch.testing.assert_close(T, image.decode_codes(codes[:, 0, 0, 0]), rtol=1e-5, atol=1e-6)


def test_jpeg_codes_are_what_the_file_holds(tmp_path):
    smooth = torch.linspace(30, 220, 16).expand(7, 4, 16, 16)[..., None].expand(-1, -1, -1, -1, 3).to(torch.uint8)
    bonn.write(tmp_path, smooth, suffix=".jpg")
    table = picture_set.read(ubo2003.survey(tmp_path))
    assert (table.images.int() - smooth.int()).abs().max() <= 4


def radiance(codes, size):
    return f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n{size}\n".encode() + codes.tobytes()


@pytest.mark.parametrize("size", ["-Y 4 +X 4", "+X 4 -Y 4"])
def test_radiance_pictures_keep_highlights(tmp_path, size):
    codes = np.random.default_rng(0).integers(128, 256, (4, 4, 4)).astype(np.uint8)
    codes[..., 3] = 131  # values from 4 to 8
    stored = codes if size.startswith("-Y") else codes[::-1]  # ATRIUM: rows from the bottom
    name = "NAME/tv000_pv000/00000 tl000 pl000 tv000 pv000.hdr"
    (tmp_path / name).parent.mkdir(parents=True)
    (tmp_path / name).write_bytes(radiance(stored, size))
    found = ubo2003.survey(tmp_path)
    assert found.encoding == "linear"
    table = picture_set.read(found)
    assert torch.equal(table.images[0, 0], (torch.from_numpy(codes[..., :3]).float() + 0.5) / 32)


def test_real_set_has_49_of_81_lights(data_dir):
    found = ubo2003.survey(data_dir / "ubo2003")
    assert (found.lights, len(found.views)) == (hemisphere.ubo81(), 1)
    assert (len(found.files), found.n_missing) == (49, 32)
    assert found.missing_text(1) == "32 of 81 (tl030 pl000 tv000 pv000 and 31 more)"
    for (light, view), name in found.files.items():
        assert int(name.rpartition("/")[2][:5]) == 81 * light + view  # its own numbers: our order of the lights


def test_azimuth_of_a_real_set_runs_from_right_to_up(data_dir):
    """Normals found from the lights are those of a surface (no curl) only under the right turn and mirroring."""
    found = ubo2003.survey(data_dir / "ubo2003")
    used = [l for (l, _) in found.files if gaps.angles_deg(found.lights)[l][0] <= 45]
    with found.opened() as read:
        T = torch.stack([image.decode_codes(read(found.files[l, 0])).mean(-1) for l in used])
    n = torch.linalg.lstsq(found.lights.directions()[used], T.flatten(1)).solution.reshape(3, 256, 256)
    right, up = -n[0] / n[2], -n[1] / n[2]

    def curl(x, y):
        """Share of the slopes' energy, at 3 to 40 periods, that no height field has."""
        X, Y = (torch.fft.fft2(s - s.mean()) for s in (x, y))
        kx, ky = torch.fft.fftfreq(256)[None], -torch.fft.fftfreq(256)[:, None]
        k = torch.hypot(kx, ky)
        band = (k > 0.01) & (k < 0.15)
        rotation, slope = ((f / k)[band].abs().square().sum() for f in (X * ky - Y * kx, X * kx + Y * ky))
        return float(rotation / (rotation + slope))

    ours, others = curl(right, up), [curl(right, -up), curl(-up, right), curl(up, right)]
    assert ours < 0.6 * min(others)  # measured 0.147; mirrored 0.30, turned 0.85, both 0.70


@pytest.mark.errors
def test_what_is_no_set_is_named(tmp_path):
    with pytest.raises(FormatError, match="expected a folder or a zip of pictures, found none"):
        ubo2003.survey(tmp_path / "none.zip")
    with pytest.raises(FormatError, match=r"expected pictures named like '00008 tl000 pl000 tv030 pv030\.jpg', found"):
        ubo2003.survey(tmp_path)
    (tmp_path / "a.zip").write_bytes(b"PK\x03\x04 no more")
    with pytest.raises(FormatError, match=r"a\.zip: cannot be read"):
        ubo2003.survey(tmp_path / "a.zip")
    for name in ("tl000 pl000 tv000 pv000.jpg", "tl015 pl000 tv000 pv000.hdr"):
        (tmp_path / name).touch()
    with pytest.raises(FormatError, match="keep one kind"):
        ubo2003.survey(tmp_path)
    (tmp_path / "tl015 pl000 tv000 pv000.hdr").unlink()
    (tmp_path / "1 tl000 pl030 tv000 pv000.jpg").touch()
    with pytest.raises(FormatError, match=r"two pictures show the same directions: '1 tl.*' and 'tl000 pl000"):
        ubo2003.survey(tmp_path)
    with pytest.raises(FormatError, match=r"the view of '1 tl000 .*' is none of rings\(50: 3\)"):
        ubo2003.survey(tmp_path, views=hemisphere.from_rings((50,), (3,), (0,)))


@pytest.mark.errors
def test_damaged_pictures_are_named(tmp_path):
    names = bonn.write(tmp_path / "set", bonn.codes())
    path = tmp_path / "set" / names[3, 1]
    whole = path.read_bytes()
    path.write_bytes(whole[:40])
    with pytest.raises(FormatError, match=rf"{re.escape(names[3, 1])}: cannot be read"):
        picture_set.read(ubo2003.survey(tmp_path / "set"))
    path.write_bytes(whole[:16] + b"\x00\x00\x30\x00\x00\x00\x30\x00" + whole[24:29] + whole[29:])
    with pytest.raises(FormatError, match=r"announces 12288 x 12288 pixels|cannot be read"):
        picture_set.read(ubo2003.survey(tmp_path / "set"))


@pytest.mark.errors
def test_a_zip_that_announces_too_much_is_refused(tmp_path):
    bonn.write(tmp_path / "set", bonn.codes())
    found = ubo2003.survey(zipped(tmp_path / "set", tmp_path / "a.zip"))
    data = bytearray((tmp_path / "a.zip").read_bytes())
    entry = data.index(b"PK\x01\x02")  # the directory's first entry: sizes at 20 and 24
    data[entry + 24 : entry + 28] = (2_000_000_000).to_bytes(4, "little")
    (tmp_path / "a.zip").write_bytes(data)
    with pytest.raises(FormatError, match="announces 2000000000 bytes in"):
        picture_set.read(found)


@pytest.mark.errors
@pytest.mark.parametrize("n", [200, pytest.param(5_000, marks=pytest.mark.slow)])
def test_nothing_but_our_errors_leaves_a_damaged_zip(n, tmp_path):
    bonn.write(tmp_path / "set", bonn.codes())
    whole = zipped(tmp_path / "set", tmp_path / "a.zip").read_bytes()
    random = np.random.default_rng(0)
    for k in range(n):
        data = bytearray(whole[: random.integers(len(whole))] if k % 4 == 0 else whole)
        for place in random.integers(0, max(len(data), 1), 20):
            if len(data):
                data[place] = random.integers(256)
        (tmp_path / "b.zip").write_bytes(data)
        try:
            picture_set.read(ubo2003.survey(tmp_path / "b.zip"), allow_missing=True)
        except FormatError:
            continue
