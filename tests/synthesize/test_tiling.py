import pytest
import torch

from torchmeso.data.tile_set import of_texels
from torchmeso.errors import ConfigError
from torchmeso.synthesize.tiling import alphabet, cells, hashed, plane, scanlines
from torchmeso.synthesize.wang import plan


def tiles(kind, colours=2):
    """Tiles of one texel each, with the colours of a set."""
    wanted = plan(kind, colours).colours
    marks = "corners" if kind == "corners" else "edges"
    return of_texels(torch.arange(len(wanted))[:, None, None], (10, 10), torch.tensor(wanted), marks)


def matches(found, laid, wraps):
    colours = found.colours.long()[laid]
    below, right = colours.roll(-1, 0), colours.roll(-1, 1)
    last = slice(None) if wraps else slice(-1)
    if found.marks == "corners":
        vertical = (colours[..., 3] == below[..., 0]) & (colours[..., 2] == below[..., 1])
        across = (colours[..., 1] == right[..., 0]) & (colours[..., 2] == right[..., 3])
    else:
        vertical, across = colours[..., 2] == below[..., 0], colours[..., 1] == right[..., 3]
    return bool(vertical[last].all()) and bool(across[:, last].all())


@pytest.mark.parametrize(("kind", "colours"), [("edges", 2), ("edges", 3), ("corners", 2), ("any", 2)])
def test_neighbours_match(kind, colours, rng):
    found = tiles(kind, colours)
    assert matches(found, scanlines(found, 20, 30, rng=rng), wraps=False)
    assert matches(found, plane(found, 20, 30, seed=4), wraps=True)
    assert matches(found, plane(found, 20, 30, seed=4, repeats=False), wraps=False)


@pytest.mark.parametrize("kind", ["edges", "corners", "any"])
def test_a_cell_is_found_without_its_neighbours(kind, rng):
    found = tiles(kind)
    whole = plane(found, 12, 9, seed=3, repeats=False)
    row, column = torch.randint(0, 12, (50,), generator=rng), torch.randint(0, 9, (50,), generator=rng)
    assert cells(found, row, column, seed=3).equal(whole[row, column])
    far = torch.tensor([-7, 1 << 40])
    assert cells(found, far, far).shape == (2,)


def test_all_tiles_are_used_about_as_often(rng):
    found = tiles("edges")
    for laid in (plane(found, 128, 128), scanlines(found, 100, 100, rng=rng)):
        share = laid.flatten().bincount(minlength=16) / laid.numel()
        assert float(share.min()) > 0.04 and float(share.max()) < 0.09
    assert len(scanlines(tiles("any"), 60, 60, rng=rng).unique()) == 96


def test_a_set_for_any_topology_has_one_class_across_and_one_down():
    assert alphabet(tiles("any")) == ([0, 1], [2, 3])
    assert alphabet(tiles("edges", 3)) == ([0, 1, 2], [0, 1, 2])


def test_hashes_are_those_of_32_bits():
    """Against the same steps in Python's whole numbers."""

    def mixed(h):
        h = (h ^ h >> 16) * 0x85EBCA6B & 0xFFFFFFFF
        h = (h ^ h >> 13) * 0xC2B2AE35 & 0xFFFFFFFF
        return h ^ h >> 16

    for row, column, which, seed in ((0, 0, 0, 0), (5, -3, 1, 77), (2**31 - 1, 12345, 0, 2**32 + 9)):
        word = mixed(seed & 0xFFFFFFFF ^ 0x9E3779B9 * (which + 1) & 0xFFFFFFFF)
        expected = mixed(mixed(word ^ row & 0xFFFFFFFF) ^ column & 0xFFFFFFFF)
        assert int(hashed(torch.tensor(row), torch.tensor(column), which, seed)) == expected
    bits = hashed(*torch.meshgrid(torch.arange(64), torch.arange(64), indexing="ij"), 0, 1)
    assert len(bits.unique()) == 64 * 64
    for k in range(32):
        assert abs(float((bits >> k & 1).double().mean()) - 0.5) < 0.05


@pytest.mark.errors
def test_bad_tilings_are_named(rng):
    found = tiles("edges")
    with pytest.raises(ConfigError, match=r"tiling\.rows: expected a value from 1"):
        plane(found, 0, 3)
    with pytest.raises(ConfigError, match=r"tiling\.columns: expected a value from 1"):
        scanlines(found, 2, 1 << 30, rng=rng)
    lacking = of_texels(found.shown()[:7], (10, 10), found.colours[:7])
    with pytest.raises(ConfigError, match="expected a tile of every combination"):
        plane(of_texels(found.shown()[:-1], (10, 10), found.colours[:-1]), 3, 3)
    with pytest.raises(ConfigError, match="expected a tile that matches its neighbours"):
        scanlines(lacking, 40, 40, rng=rng)
