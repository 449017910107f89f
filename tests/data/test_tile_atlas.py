import pytest
import torch

from tests.synthesize import looks
from tests.synthesize.test_tiling import tiles
from torchmeso.data import address, tile_atlas
from torchmeso.data.tile_atlas import build, neighbours
from torchmeso.synthesize import patch_error, wang
from torchmeso.synthesize.wang import WangOptions


@pytest.fixture(scope="module")
def grown():
    rng = torch.Generator().manual_seed(2)
    source = patch_error.exemplar(looks.noise(24, 28, rng))
    options = WangOptions(size=16, band=8, patch=8, refine=1, candidates=2, kind="any")
    return wang.grow(source, options, rng=rng).set


@pytest.mark.parametrize("kind", ["edges", "any", "corners"])
def test_margins_show_tiles_that_match(kind):
    set_ = tiles(kind)
    found = set_.colours[neighbours(set_)]
    above, below, left, right = found[:, :-1], found[:, 1:], found[:, :, :-1], found[:, :, 1:]
    if kind == "corners":
        assert above[..., 3].equal(below[..., 0]) and above[..., 2].equal(below[..., 1])
        assert left[..., 1].equal(right[..., 0]) and left[..., 2].equal(right[..., 3])
    else:
        assert above[..., 2].equal(below[..., 0]) and left[..., 1].equal(right[..., 3])


def test_every_texel_of_every_tile_is_found_at_its_place(grown):
    atlas = build(grown)
    tile = torch.arange(len(grown.index))[:, None, None].expand(-1, 16, 16)
    place = address.texel_centres(16, 16, torch.float64).expand(len(grown.index), -1, -1, -1)
    taps = address.bilinear(atlas.coordinates(tile, place), 24, 28, atlas.map)
    most = taps.weight.argmax(-1, keepdim=True)
    assert float(taps.weight.amax(-1).min()) > 1 - 1e-9
    assert taps.texel.gather(-1, most)[..., 0].equal(grown.shown().long())


def test_the_first_texels_beyond_a_border_are_those_of_any_neighbour(grown):
    """All but those beyond corners: which of the two edges shows there is cut tile by tile."""
    atlas = build(grown)
    shown, colours = grown.shown(), grown.colours
    one = torch.arange(len(colours))
    above, right = torch.zeros(96, 14, 2, dtype=torch.float64), torch.zeros(96, 14, 2, dtype=torch.float64)
    middle = (torch.arange(1, 15) + 0.5) / 16
    above[..., 0], above[..., 1] = middle, 1 + 0.5 / 16
    right[..., 1], right[..., 0] = middle, 1 + 0.5 / 16
    for place, own, other, texels in ((above, 0, 2, shown[:, -1, 1:15]), (right, 1, 3, shown[:, 1:15, 0].flip(1))):
        taps = address.bilinear(atlas.coordinates(one[:, None].expand(-1, 14), place), 24, 28, atlas.map)
        read = taps.texel.gather(-1, taps.weight.argmax(-1, keepdim=True))[..., 0]
        for k in range(96):
            beyond = texels[colours[:, other] == colours[k, own]].long()
            assert bool((beyond == read[k]).all())


def test_coordinates_stay_small_whatever_the_set(grown):
    for set_ in (grown, tiles("edges", 3)):
        atlas = build(set_)
        tile = torch.arange(len(set_.index))
        uv = atlas.coordinates(tile, torch.full((len(tile), 2), 0.5))
        assert float((uv.abs() / torch.tensor(atlas.map.periods)).max()) <= 0.5 + 1e-6
    assert tile_atlas.build(tiles("corners")).scale == (0.1, 0.1)
