import pytest
import torch

from torchmeso.data import quilting_map, store
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.errors import FormatError, ShapeError


def make(rng, size=(5, 7), source=(3, 4), **more):
    index = torch.randint(0, source[0] * source[1], size, generator=rng, dtype=torch.int32)
    return QuiltingMap(index=index, source=source, **more)


def test_apply_puts_the_exemplars_texels_where_the_map_says(rng):
    quilting = make(rng)
    x = torch.rand(2, 3, 4, 6, generator=rng)
    found = quilting.apply(x, 1)
    assert found.shape == (2, 5, 7, 6)
    for row, column in [(0, 0), (4, 6), (2, 3)]:
        at = int(quilting.index[row, column])
        assert found[:, row, column].equal(x[:, at // 4, at % 4])


def test_texture_coordinates_stay_those_of_the_exemplar(rng):
    assert make(rng).periods == (7 / 4, 5 / 3)


def test_seams_are_where_neighbours_are_not(rng):
    index = torch.arange(12, dtype=torch.int32).reshape(3, 4)
    right, below = QuiltingMap(index=index, source=(3, 4), tileable=True).seams()
    assert not right.any() and not below.any()
    moved = QuiltingMap(index=torch.cat([index[:, :2], index[:, :2]], 1).contiguous(), source=(3, 4))
    right, below = moved.seams()
    assert right.nonzero().tolist() == [[0, 1], [1, 1], [2, 1]] and not below.any()
    right, _ = QuiltingMap(index=moved.index, source=(3, 4), tileable=True).seams()
    assert right[:, 3].all()


@pytest.mark.parametrize(("source", "n_bytes"), [((3, 4), 2), ((200, 300), 4)])
def test_files_keep_the_map_in_at_most_four_bytes_a_texel(source, n_bytes, rng, tmp_path):
    quilting = make(rng, size=(64, 64), source=source, tileable=True)
    path = tmp_path / "a.quilt"
    quilting_map.save(quilting, path, seed=3)
    found = quilting_map.load(path)
    assert found.index.equal(quilting.index) and found.source == source and found.tileable
    assert path.stat().st_size < n_bytes * 64 * 64 + 500
    about = quilting_map.describe(path)
    assert about["texels"] == "64 x 64" and about["seed"] == 3


@pytest.mark.errors
def test_bad_maps_are_named(rng, tmp_path):
    index = torch.zeros(2, 2, dtype=torch.int32)
    with pytest.raises(ShapeError, match="expected texels from 0 to 11, got 12"):
        QuiltingMap(index=index + 12, source=(3, 4))
    with pytest.raises(ShapeError, match="expected texels from 0 to 11, got -1"):
        QuiltingMap(index=index - 1, source=(3, 4))
    with pytest.raises(ShapeError, match="expected int32"):
        QuiltingMap(index=index.long(), source=(3, 4))
    with pytest.raises(ShapeError, match="expected at least one texel from an exemplar of at most 32768"):
        QuiltingMap(index=index, source=(1, 40000))
    with pytest.raises(ShapeError, match="expected the exemplar's 4 x 3 texels, got 3 x 4"):
        make(rng).apply(torch.zeros(4, 3))
    with pytest.raises(FormatError, match="none; make one with torchmeso synthesize"):
        quilting_map.load(tmp_path / "b.quilt")
    store.write_model(tmp_path / "c.quilt", {"x": index}, {"kind": "eigen"})
    with pytest.raises(FormatError, match="expected a quilting map, got a file of kind 'eigen'"):
        quilting_map.load(tmp_path / "c.quilt")
    store.write_model(tmp_path / "d.quilt", {"quilting.index": index + 9}, {"quilting": {"source": [1, 2]}})
    with pytest.raises(FormatError, match="tileable"):
        quilting_map.load(tmp_path / "d.quilt")
