import pytest
import torch

from tests.synthesize import looks
from torchmeso.bench import wang
from torchmeso.bench.suite import Context
from torchmeso.data import image, tile_set


def test_plain_repetition_is_one_and_chance_is_little(rng):
    tile = torch.rand(8, 8, 3, generator=rng)
    assert wang.repetition(tile.repeat(4, 4, 1), 8) == pytest.approx(1)
    assert wang.repetition(torch.rand(64, 64, 3, generator=rng), 8) < 0.1


def test_borders_are_measured_where_tiles_meet():
    picture = torch.arange(8.0).expand(8, 8)[..., None]  # steps of 1 across
    shown = torch.arange(64).reshape(8, 8)[None, :4, :4]
    tiles = tile_set.of_texels(shown, (8, 8), torch.zeros(1, 4, dtype=torch.long))
    laid = tiles.lay(torch.zeros(3, 3, dtype=torch.long), tileable=True)
    assert wang.border_ratio(picture, laid, 4, wraps=False) == pytest.approx(9)  # from 3 to 0


def test_made_up_coefficients_have_the_sizes_of_the_table():
    found = wang.made_up(16, 2)
    assert found.texels == (16, 16) and found.terms == (4, 4)


def test_rows_on_small_tiles(monkeypatch, rng, device, tmp_path):
    monkeypatch.setattr(wang, "TABLE", (("small", 16, 16, 2, 10, "a minute"), ("large", 100, 8, 2, 5, "two")))
    monkeypatch.setattr(wang, "SIDE", 16)
    monkeypatch.setattr(wang, "PLANE", 3)
    monkeypatch.setattr(wang, "data_dir", lambda: tmp_path)
    found = {row.id: row for row in wang.times(Context(quick=True))}
    assert found["tiles.time.small"].value > 0 and found["tiles.time.large"].why == "full run only"
    found = {row.id: row for row in wang.looks(Context(quick=True))}
    assert found["tiles.looks.borders"].value is None
    (tmp_path / "texture").mkdir()
    image.write_png(tmp_path / "texture" / "t1.png", looks.noise(20, 24, rng))
    found = {row.id: row for row in wang.looks(Context(quick=True))}
    assert found["tiles.looks.borders"].value > 0 and 0 < found["tiles.looks.repetition.two_colours"].value < 1
