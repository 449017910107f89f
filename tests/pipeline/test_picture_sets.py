import os

import pytest
import torch

from tests.data import bonn
from torchmeso.data import image
from torchmeso.errors import FormatError
from torchmeso.pipeline import describe, picture_sets


def test_a_table_is_made_once_and_again_when_a_file_changes(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHMESO_CACHE", str(tmp_path / "cache"))
    names = bonn.write(tmp_path / "set", bonn.codes())
    table = picture_sets.as_table(tmp_path / "set")
    for path in (table, tmp_path / "set"):
        assert torch.equal(picture_sets.open_btf(path).pictures(), image.decode_codes(bonn.codes()))
    written = os.stat(table).st_mtime_ns
    assert picture_sets.as_table(tmp_path / "set") == table
    assert os.stat(table).st_mtime_ns == written
    os.utime(tmp_path / "set" / names[0, 0], (1, 1))
    assert picture_sets.as_table(tmp_path / "set") != table


def test_info_tells_what_is_missing(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHMESO_CACHE", str(tmp_path / "cache"))
    names = bonn.write(tmp_path / "set", bonn.codes())
    (tmp_path / "set" / names[2, 1]).unlink()
    about = describe.file(tmp_path / "set")
    assert (about["lights"], about["views"]) == ("7, rings(0: 1, 40: 6)", "4, rings(0: 1, 50: 3 @ 20)")
    assert (about["texels"], about["values"], about["pictures"]) == ("4 x 5", "sRGB codes", 27)
    assert about["missing"] == "1 of 28 (tl040 pl060 tv050 pv020)"
    table = picture_sets.as_table(tmp_path / "set", allow_missing=True)
    assert describe.file(table)["filled in"] == "1 of 28 (tl040 pl060 tv050 pv020)"


@pytest.mark.errors
def test_what_was_filled_in_once_is_refused_where_that_is_not_allowed(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHMESO_CACHE", str(tmp_path / "cache"))
    names = bonn.write(tmp_path / "set", bonn.codes())
    (tmp_path / "set" / names[2, 1]).unlink()
    picture_sets.as_table(tmp_path / "set", allow_missing=True)
    with pytest.raises(FormatError, match="pictures are missing: 1 of 28"):
        picture_sets.as_table(tmp_path / "set")
