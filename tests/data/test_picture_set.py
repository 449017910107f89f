import re
from dataclasses import replace

import pytest
import torch

from tests.data import bonn
from tests.data.bonn import LIGHTS, VIEWS
from torchmeso.data import btf, image, picture_set, store, ubo2003
from torchmeso.errors import FormatError, SizeError
from torchmeso.geometry import hemisphere


@pytest.fixture
def pictures(tmp_path):
    bonn.write(tmp_path / "set", bonn.codes())
    return ubo2003.survey(tmp_path / "set")


def without(pictures, *pairs):
    return replace(pictures, files={pair: name for pair, name in pictures.files.items() if pair not in pairs})


def test_codes_stay_codes_on_disk(tmp_path, pictures):
    picture_set.to_table(pictures, tmp_path / "a.btf.zarr", source="toy")
    table = btf.load(tmp_path / "a.btf.zarr")
    assert (table.encoding, str(table.images.dtype), table.images.shape) == ("srgb", "uint8", (7, 4, 5, 4, 3))
    assert torch.equal(table.pictures(), image.decode_codes(bonn.codes()))
    assert torch.equal(table.rows(1, 3), image.decode_codes(bonn.codes()[:, :, 1:3]))
    assert (table.lights, table.views) == (LIGHTS, VIEWS)


def test_a_stopped_run_goes_on_where_it_was(tmp_path, pictures):
    path = tmp_path / "a.btf.zarr"
    read = []

    class Stop(Exception):
        pass

    def stop(share):
        if share > 0.4:
            raise Stop

    with pytest.raises(Stop):
        picture_set.to_table(pictures, path, progress=stop)
    assert not path.exists()

    with pictures.opened() as reader:

        def watched(name):
            read.append(name)
            return reader(name)

        class Opened:
            def __enter__(self):
                return watched

            def __exit__(self, *_):
                return None

        picture_set.to_table(replace(pictures, opened=Opened), path)
    assert len(set(read)) == 2 * 7 + 1  # two of the four views, and the one picture that tells the size
    assert torch.equal(btf.load(path).pictures(), image.decode_codes(bonn.codes()))


def test_missing_pictures_are_filled_and_told(tmp_path):
    lights, views = hemisphere.ubo81(), VIEWS
    cosine = lights.directions(torch.float64)[:, 2]
    T = (0.7 * cosine)[:, None, None, None, None].expand(81, 4, 2, 3, 3)
    codes = image.encode_codes(T)
    bonn.write(tmp_path, codes, lights, views)
    lost = [(0, 0), (40, 0), (41, 0), *((l, 1) for l in range(57, 81)), *((l, 3) for l in range(81))]
    pictures = without(ubo2003.survey(tmp_path), *lost)
    assert pictures.missing_text() == (
        "108 of 324 (tl000 pl000 tv000 pv000, tl060 pl054 tv000 pv000, tl060 pl072 tv000 pv000 and 105 more)"
    )
    picture_set.to_table(pictures, tmp_path / "a.btf.zarr", allow_missing=True)
    table = btf.load(tmp_path / "a.btf.zarr")
    stored = torch.from_numpy(table.images[:])
    assert (stored.int() - codes.int()).abs().max() <= 1  # a Lambertian is filled exactly, but for rounding to codes
    assert torch.equal(picture_set.read(pictures, allow_missing=True).images, stored)
    assert store.open_table(tmp_path / "a.btf.zarr", "btf").attrs["filled"].startswith("108 of 324 (tl000")


def test_linear_pictures_stay_floats(tmp_path, pictures):
    linear = image.decode_codes(bonn.codes()) * 40

    class Opened:
        def __enter__(self):
            return lambda name: linear[next(k for k, n in pictures.files.items() if n == name)]

        def __exit__(self, *_):
            return None

    hdr = without(replace(pictures, encoding="linear", opened=Opened), *((l, 2) for l in range(7)))
    picture_set.to_table(hdr, tmp_path / "a.btf.zarr", allow_missing=True)
    table = btf.load(tmp_path / "a.btf.zarr")
    assert (table.encoding, str(table.images.dtype)) == ("linear", "float32")
    assert torch.equal(table.pictures()[:, [0, 1, 3]], linear[:, [0, 1, 3]])
    assert bool((table.pictures()[:, 2] > 0).any())


@pytest.mark.errors
def test_missing_pictures_are_refused_unless_allowed(tmp_path, pictures):
    some = without(pictures, (2, 1))
    message = "pictures are missing: 1 of 28 (tl040 pl060 tv050 pv020); find them, or let them be interpolated"
    for job in (picture_set.read, lambda p: picture_set.to_table(p, tmp_path / "a.btf.zarr")):
        with pytest.raises(FormatError, match=re.escape(message)):
            job(some)
    assert not list(tmp_path.glob("a.*"))


@pytest.mark.errors
def test_pictures_of_another_size_are_refused(tmp_path, pictures):
    from PIL import Image

    Image.new("RGB", (9, 8)).save(tmp_path / "set" / pictures.files[4, 2])
    with pytest.raises(FormatError, match="expected pictures of 4 x 5 as the first one, got 9 x 8: TOY/tv050_pv140/"):
        picture_set.read(pictures)


@pytest.mark.errors
def test_sets_beyond_memory_are_refused(pictures, monkeypatch):
    monkeypatch.setattr(picture_set, "LIMIT", 1000)
    with pytest.raises(SizeError, match=r"needs 1\.6 KiB of memory"):
        picture_set.read(pictures)
