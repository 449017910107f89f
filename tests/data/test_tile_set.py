import pytest
import torch

from torchmeso.data import store, tile_set
from torchmeso.data.tile_set import of_texels
from torchmeso.errors import ConfigError, FormatError, ShapeError


def make(rng, tiles=4, side=5, source=(6, 7), **more):
    shown = torch.randint(3, 30, (tiles, side, side), generator=rng)
    colours = torch.tensor([[k & 1, 0, k >> 1, 1] for k in range(tiles)])
    return of_texels(shown, source, colours, **more), shown


def test_each_referenced_texel_is_kept_once(rng):
    tiles, shown = make(rng)
    assert tiles.shown().equal(shown.int())
    assert sorted(tiles.texels.tolist()) == sorted(set(shown.flatten().tolist()))
    assert tiles.share == len(tiles.texels) / 42 and tiles.side == 5


def test_tiles_are_found_by_their_colours(rng):
    tiles, _ = make(rng)
    assert tiles.find(tiles.colours.flip(0)[None]).tolist() == [[3, 2, 1, 0]]


def test_an_arrangement_is_a_map_of_the_exemplars_texels(rng):
    tiles, shown = make(rng)
    found = tiles.lay(torch.tensor([[0, 3, 1], [2, 2, 0]]), tileable=True)
    assert found.texels == (10, 15) and found.source == (6, 7) and found.tileable
    assert found.index[:5, 5:10].equal(shown[3].int()) and found.index[5:, :5].equal(shown[2].int())


@pytest.mark.parametrize("marks", ["edges", "corners"])
def test_a_file_holds_the_set(marks, rng, tmp_path):
    tiles, _ = make(rng, marks=marks)
    tile_set.save(tiles, tmp_path / "a.tiles", seed=3)
    found = tile_set.load(tmp_path / "a.tiles")
    assert found.index.equal(tiles.index) and found.texels.equal(tiles.texels)
    assert found.colours.equal(tiles.colours) and (found.source, found.marks) == (tiles.source, marks)
    about = tile_set.describe(tmp_path / "a.tiles")
    assert about["tiles"] == f"4 of 5 x 5 texels, coloured {marks}" and about["seed"] == 3


@pytest.mark.errors
def test_bad_tiles_are_named(rng, tmp_path):
    tiles, shown = make(rng)
    with pytest.raises(ConfigError, match=r"got none of colours \[1, 1, 1, 1\]"):
        tiles.find(torch.ones(1, 4, dtype=torch.long))
    with pytest.raises(ShapeError, match=r"tiles\.index: expected squares"):
        of_texels(shown[:, :4], (6, 7), tiles.colours)
    with pytest.raises(ShapeError, match=r"tiles\.texels: expected int32 from 0 to 24"):
        of_texels(shown, (5, 5), tiles.colours)
    with pytest.raises(ShapeError, match=r"tiles\.colours: expected shape"):
        of_texels(shown, (6, 7), tiles.colours[:2])
    with pytest.raises(FormatError, match="found none; make one with"):
        tile_set.load(tmp_path / "none.tiles")
    store.write_model(tmp_path / "other.tiles", {"x": torch.zeros(1)}, {"kind": "quilting"})
    with pytest.raises(FormatError, match=r"expected a set of tiles \(\.tiles\), got a file of kind 'quilting'"):
        tile_set.load(tmp_path / "other.tiles")
