import pytest
import torch

from torchmeso.data.textile import Textile, Yarn
from torchmeso.data.yarn_section import Ellipse
from torchmeso.errors import GeometryError
from torchmeso.meso.textile_period import copies, goes_on, tile_of


def yarn(repeats, end=(1.0, 0.0, 0.0)):
    nodes = torch.tensor([[0.0, 0.0, 0.0], end], dtype=torch.float64)
    return Yarn(
        nodes=nodes,
        tangents=torch.zeros_like(nodes),
        ups=torch.tensor([[0.0, 0.0, 1.0]] * 2).double(),
        sections=(Ellipse(width=0.1, height=0.1),),
        repeats=torch.tensor(repeats, dtype=torch.float64).reshape(-1, 3),
    )


def textile(*yarns, box=None):
    return Textile(yarns=yarns, domain=None if box is None else torch.tensor(box, dtype=torch.float64))


SQUARE = [[1, 0, 0], [0, 1, 0]]


def shifts(yarn, tile):
    return sorted([round(float(x), 4) % 1 for x in shift] for shift in copies(yarn, tile))


def test_the_domain_tells_the_tile_where_yarns_repeat_by_it():
    tile = tile_of(textile(yarn(SQUARE), box=[[-1, 2], [1, 4]]))
    assert tile.sides.tolist() == [2, 2]
    assert tile.low.tolist() == [-1, 2]
    assert tile_of(textile(yarn(SQUARE), box=[[0, 0], [1.5, 1.5]])).sides.tolist() == [1, 1]  # cut by its domain
    assert tile_of(textile(yarn([]), box=[[0, 0], [3, 3]])).sides.tolist() == [3, 3]


def test_yarns_of_several_periods_share_a_tile_and_fill_it():
    short, long = yarn([[0.5, 0, 0], [0, 1, 0]], end=(0.5, 0, 0)), yarn([[0.75, 0, 0], [0, 1.5, 0]], end=(0.75, 0, 0))
    tile = tile_of(textile(short, long))
    assert tile.sides.tolist() == [3, 3]  # 1.5 x 3, twice along x
    assert len(copies(short, tile)) == 6 * 3
    assert len(copies(long, tile)) == 4 * 2
    assert tile.anisotropy == 1


def test_slanted_repeats_fill_the_tile():
    diagonal = yarn([[1, 1, 0], [1, -1, 0]], end=(2, 0, 0))
    tile = tile_of(textile(diagonal))
    assert tile.sides.tolist() == [2, 2]
    assert shifts(diagonal, tile) == [[0, 0, 0], [0.5, 0.5, 0]]
    assert goes_on(diagonal, tile)


def test_a_slant_comes_back_after_some_periods():
    slanted, square = yarn([[1, 0, 0], [0.5, 1, 0]]), yarn(SQUARE)
    tile = tile_of(textile(slanted, square, box=[[0, 0], [1, 1]]))
    assert tile.sides.tolist() == [2, 2]
    assert shifts(slanted, tile) == [[0, 0, 0], [0.25, 0.5, 0], [0.5, 0, 0], [0.75, 0.5, 0]]


def test_the_tile_stands_in_for_missing_repeats():
    bare, one = yarn([]), yarn([[0, 0.5, 0]])
    tile = tile_of(textile(bare, one, box=[[0, 0], [1, 1]]))
    assert shifts(bare, tile) == [[0, 0, 0]]
    assert shifts(one, tile) == [[0, 0, 0], [0, 0.5, 0]]
    assert goes_on(bare, tile)
    assert not goes_on(yarn([], end=(0.7, 0, 0)), tile)
    assert not goes_on(yarn([], end=(1, 0, 0.2)), tile)


def test_layers_above_each_other_are_one():
    layered = yarn([*SQUARE, [0, 0, 0.3]])
    assert len(copies(layered, tile_of(textile(layered)))) == 1


def test_oblong_periods_are_taken_several_times():
    assert tile_of(textile(yarn([[1, 0, 0], [0, 3, 0]]))).sides.tolist() == [3, 3]
    assert tile_of(textile(yarn([[1, 0, 0], [0, 1.5, 0]]))).sides.tolist() == [3, 3]
    tile = tile_of(textile(yarn([[1, 0, 0], [0, 2.07, 0]])))
    assert tile.sides.tolist() == [2, 2.07]
    assert tile.anisotropy == pytest.approx(1.035)
    assert float(tile.unit[2]) == pytest.approx((2 * 2.07) ** 0.5)


@pytest.mark.parametrize(
    ("yarns", "box", "text"),
    [
        ([yarn([])], None, "expected yarns that repeat, or a domain"),
        ([yarn([[1, 0, 0]])], None, "expected yarns that repeat, or a domain"),
        ([yarn(SQUARE), yarn([[2**0.5, 0, 0], [0, 1, 0]])], None, r"common period along x, got \[1.0, 1.41"),
        ([yarn([[1, 0, 0.1], [0, 1, 0]])], None, "at most two repeats of a yarn, across each other and level"),
        ([yarn([[1, 0, 0], [0, 1, 0], [1, 1, 0]])], None, "at most two repeats of a yarn"),
        ([yarn([[1, 0, 0], [2, 0, 0]])], None, "at most two repeats of a yarn"),
        ([yarn([[1, 0, 0], [0, 30, 0]])], None, "within 8 repetitions, got 1 x 30"),
        ([yarn([[1, 0, 0], [0.1, 1, 0]]), yarn(SQUARE)], [[0, 0], [1, 1]], "within 8 repetitions, got 1 x 10"),
        ([yarn([[1, 0, 0], [2**0.5, 1, 0]]), yarn(SQUARE)], None, "repeats fill the tile evenly, got 1 copies"),
        ([yarn([[0.001, 0, 0], [0, 0.001, 0]]), yarn(SQUARE)], None, "repeats fill the tile evenly, got 1e.06 copies"),
        ([yarn(SQUARE, end=(2, 0, 0))], None, "got one over 2: it would lie in its own copies"),
    ],
)
@pytest.mark.errors
def test_what_does_not_tile_is_refused(yarns, box, text):
    with pytest.raises(GeometryError, match=text):
        tile = tile_of(textile(*yarns, box=box))
        _ = [(copies(y, tile), goes_on(y, tile)) for y in yarns]
