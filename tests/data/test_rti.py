import re

import numpy as np
import pytest
import torch
from PIL import Image

from torchmeso.data import rti
from torchmeso.data.rti import LightSet
from torchmeso.errors import FormatError, ShapeError


def picture(path, value=7, size=(3, 2)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (value, 0, 0)).save(path)


def test_files_are_found_by_their_names(tmp_path):
    names = ["a 1.png", "b.png", "jpegs/c.png", "d  2.png"]
    for k, name in enumerate(names):
        picture(tmp_path / "dome" / name, k)
    (tmp_path / "dome" / "set.lp").write_bytes(
        b"\xef\xbb\xbf4\r\n"
        b"C:\\Users\\rti lab\\a 1.png 0 0 2\r\n"
        b"../dome/b.png -0.6 0 0.8\r\n"
        b"jpegs\\c.png\t1e-1\t0\t1\r\n"
        b'"d  2.png" 0 1 0\r\n\r\n'
    )
    lights = rti.read(tmp_path / "dome" / "set.lp")
    assert [int(p[0, 0, 0]) for p in lights.pictures()] == [0, 1, 2, 3]
    torch.testing.assert_close(lights.directions[:2], torch.tensor([[0, 0, 1], [-0.6, 0, 0.8]]))
    torch.testing.assert_close(lights.directions.norm(dim=1), torch.ones(4))


def test_round_trip(tmp_path, rng):
    for k in range(3):
        picture(tmp_path / "pictures" / f"p {k}.png", k)
    files = tuple(tmp_path / "pictures" / f"p {k}.png" for k in range(3))
    lights = LightSet(files=files, directions=torch.nn.functional.normalize(torch.rand(3, 3, generator=rng), dim=1))
    for folder in (tmp_path, tmp_path / "elsewhere"):
        rti.write(lights, folder / "set.lp")
        back = rti.read(folder / "set.lp")
        assert [f.resolve() for f in back.files] == list(files)
        torch.testing.assert_close(back.directions, lights.directions, rtol=0, atol=1e-7)


@pytest.mark.errors
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected the number of lights in the first line"),
        ("2\na.png 0 0 1\n", "got '2' and 1 lines; the copy may be incomplete"),
        ("a.png 0 0 1\n", "expected the number of lights in the first line"),
        ("1\na.png 0 x 1\n", "cannot be read (ValueError: could not convert string to float: 'x')"),
        ("1\na.png 0 0 0\n", "got one without a length"),
        ("1\na.png 0 nan 0\n", "got one without a length"),
        ("1\nx\\none.png 0 0 1\n", "expected the picture 'x\\none.png' of the .lp file, found none"),
        ("1\n0 0 1\n", "cannot be read"),
    ],
)
def test_damaged_files_are_named(tmp_path, text, message):
    picture(tmp_path / "a.png")
    (tmp_path / "a.lp").write_text(text)
    with pytest.raises(FormatError, match=re.escape(message)):
        rti.read(tmp_path / "a.lp")


@pytest.mark.errors
def test_missing_and_uneven_sets_are_refused(tmp_path):
    with pytest.raises(FormatError, match="expected a file of light positions"):
        rti.read(tmp_path / "none.lp")
    with pytest.raises(ShapeError, match="expected at least one picture"):
        LightSet(files=(), directions=torch.zeros(0, 3))
    picture(tmp_path / "a.png")
    picture(tmp_path / "b.png", size=(4, 2))
    lights = LightSet(files=(tmp_path / "a.png", tmp_path / "b.png"), directions=torch.eye(3)[:2])
    with pytest.raises(FormatError, match=r"b\.png: expected 3 x 2 pixels as in the first picture, got 4 x 2"):
        list(lights.pictures())


@pytest.mark.errors
@pytest.mark.parametrize("n", [500, pytest.param(20_000, marks=pytest.mark.slow)])
def test_nothing_but_our_errors_leaves(n, tmp_path):
    picture(tmp_path / "a.png")
    whole = b"3\na.png 0 0 1\na.png 0.1 0 1\na.png 0 -0.5 1\n"
    random = np.random.default_rng(0)
    for _ in range(n):
        data = bytearray(whole)
        for place in random.integers(0, len(data), 2):
            data[place] = random.integers(256)
        (tmp_path / "b.lp").write_bytes(data)
        try:
            rti.read(tmp_path / "b.lp")
        except FormatError:
            continue
