from itertools import product

import pytest
import torch

from tests.synthesize import looks
from torchmeso.errors import ConfigError
from torchmeso.synthesize import patch_error
from torchmeso.synthesize.filling import seam_costs
from torchmeso.synthesize.wang import Feature, WangOptions, _corners, _cut_cost, grow, plan

SMALL = {"size": 16, "band": 8, "patch": 8, "refine": 2, "candidates": 3}


@pytest.fixture
def source(rng):
    return patch_error.exemplar(looks.noise(28, 26, rng))


def make(source, seed=0, **more):
    rng = torch.Generator().manual_seed(seed)
    call = {name: more.pop(name) for name in ("features", "corners", "backend") if name in more}
    return grow(source, WangOptions(**SMALL | more), rng=rng, **call)


@pytest.mark.parametrize(
    ("kind", "colours", "count"), [("edges", 2, 16), ("edges", 3, 81), ("corners", 2, 16), ("any", 2, 96)]
)
def test_sets_are_complete(kind, colours, count):
    found = plan(kind, colours)
    assert len(found.tiles) == len(set(found.colours)) == count


def test_any_two_of_four_sides_take_either_class():
    """What makes 96 tiles: six choices of two sides, and two colours for each side."""
    tiles = plan("any", 2).tiles
    ways = {tuple(side < 2 for side in tile) for tile in tiles}
    assert ways == {way for way in product((False, True), repeat=4) if sum(way) == 2} and len(ways) == 6
    # Whatever two neighbours ask for, some tile goes on.
    for north, west in product(range(4), repeat=2):
        assert any(tile[0] == north and tile[3] == west for tile in tiles)


@pytest.mark.parametrize("kind", ["edges", "corners", "any"])
def test_what_meets_across_a_border_is_the_same_for_every_pair_of_tiles(kind, source):
    """The texel on the other side of a border depends on the colour of the side alone, but at its ends."""
    made = make(source, kind=kind)
    tiles, wanted = made.set.shown(), plan(kind, 2)
    for own, other, one in ((0, 2, tiles[:, 0]), (3, 1, tiles[:, :, 0])):
        across = tiles[:, -1] if own == 0 else tiles[:, :, -1]
        for side in {sides[own] for sides in wanted.tiles}:
            mine = [k for k, sides in enumerate(wanted.tiles) if sides[own] == side]
            theirs = [k for k, sides in enumerate(wanted.tiles) if sides[other] == side]
            assert len({tuple(one[k, 1:-1].tolist()) for k in mine}) == 1
            assert len({tuple(across[k, 1:-1].tolist()) for k in theirs}) == 1


def test_tiles_of_coloured_corners_meet_at_corners_without_a_seam(source):
    """Four tiles around a corner show one corner sample."""
    made = make(source, kind="corners")
    tiles, corner = made.set.shown().long(), made.corners
    for k, colours in enumerate(plan("corners", 2).colours):
        for c, (y, x) in enumerate(((0, 0), (0, 15), (15, 15), (15, 0))):
            row, column = corner[colours[c]].tolist()
            expected = (row + 4 - (y > 0)) * 26 + column + 4 - (x > 0)
            assert int(tiles[k, y, x]) == expected


def test_the_same_seed_gives_the_same_bits_on_any_threads_and_both_backends(rng, device):
    model, before, found = looks.eigen(rng, size=(24, 22), rank=5), torch.get_num_threads(), []
    for threads, backend in ((1, "torch"), (2, "torch"), (1, "opencl"), (2, "opencl")):
        torch.set_num_threads(threads)
        found.append(make(patch_error.exemplar(model), backend=backend))
    torch.set_num_threads(before)
    for other in found[1:]:
        assert found[0].set.shown().equal(other.set.shown()) and found[0].errors.equal(other.errors)
        assert found[0].corners.equal(other.corners)
    assert not found[0].set.shown().equal(make(patch_error.exemplar(model), seed=1).set.shown())


def test_corner_samples_are_chosen_so_that_cuts_are_cheap(source, rng):
    chosen = _corners(patch_error.Search(source), 8, 4, rng, "torch")
    cost = _cut_cost(source, chosen, 8, "torch")
    others = [
        _cut_cost(source, torch.stack([torch.randint(0, n, (4,), generator=rng) for n in (21, 19)], 1), 8, "torch")
        for _ in range(12)
    ]
    assert cost < sorted(others)[2]
    assert len({tuple(x) for x in chosen.tolist()}) == 4


def test_corner_samples_can_be_given(source):
    corners = torch.tensor([[0, 0], [3, 9], [12, 4], [20, 18]])
    assert make(source, corners=corners).corners.equal(corners)


def test_features_stay_where_they_are_put(source):
    mask = torch.tensor([[True, True, False], [True, True, True]])
    y, x = mask.nonzero().unbind(1)
    features = (
        Feature(on="horizontal", number=1, at=(3, 6), taken=(10, 4), mask=mask),
        Feature(on="tile", number=5, at=(7, 7), taken=(2, 20), mask=mask),
    )
    made = make(source, features=features)
    tiles = made.set.shown().long()
    assert tiles[5, 7 + y, 7 + x].equal((2 + y) * 26 + 20 + x)
    for k, (north, _, south, _) in enumerate(plan("edges", 2).tiles):
        if south == 1:  # the feature lies across the border: its upper row above, its lower row below
            assert tiles[k, 15, 6:8].tolist() == [10 * 26 + 4, 10 * 26 + 5]
        if north == 1:
            assert tiles[k, 0, 6:9].tolist() == [11 * 26 + 4, 11 * 26 + 5, 11 * 26 + 6]


def test_one_colour_and_one_grey_cost_nothing():
    source = patch_error.exemplar(torch.full((20, 20, 3), 0.5))
    made = make(source, colours=1)
    assert len(made.set.index) == 1 and not made.errors.any()


def test_seams_show_less_than_those_of_tiles_cut_at_random(source, rng):
    made = make(source, refine=12)
    random = torch.randint(0, 28 * 26, (16, 16, 16), generator=rng)
    noise = seam_costs(source, random[:, :-1], random[:, 1:], 0, toroidal=False).double().mean()
    assert made.errors.double().mean() < 0.2 * 2 * noise  # across and down


@pytest.mark.errors
def test_bad_dials_are_named(source, rng):
    for more, text in (
        ({"kind": "hexagons"}, "wang.kind: expected 'edges', 'corners' or 'any'"),
        ({"kind": "any", "colours": 3}, "wang.colours: expected 2 for a set of kind 'any', got 3"),
        ({"band": 7}, "wang.band: expected an even number of texels, got 7"),
        ({"band": 10}, "wang.band: expected at most half a tile of 16 texels, got 10"),
        ({"patch": 27}, "expected corner samples and patches of at most the exemplar's shorter side, 26 texels"),
        ({"corners": torch.zeros(2, 2, dtype=torch.long)}, "wang.corners: expected 4 places"),
    ):
        with pytest.raises(ConfigError, match=text):
            make(source, **more)
    mask = torch.ones(3, 3, dtype=torch.bool)
    for feature, text in (
        (Feature(on="tile", number=0, at=(0, 5), taken=(0, 0), mask=mask), "expected to find room on tile 0"),
        (Feature(on="vertical", number=0, at=(7, 6), taken=(0, 0), mask=mask), "expected to find room on vertical 0"),
        (Feature(on="tile", number=0, at=(6, 6), taken=(26, 0), mask=mask), "expected texels of the exemplar, 26 x 28"),
        (Feature(on="tile", number=16, at=(6, 6), taken=(0, 0), mask=mask), "got 9 on tile 16"),
    ):
        with pytest.raises(ConfigError, match=text):
            make(source, features=(feature,))
