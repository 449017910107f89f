from dataclasses import replace

import pytest
import torch

from tests.synthesize import looks
from torchmeso.errors import ConfigError
from torchmeso.synthesize.patch_error import Exemplar, exemplar
from torchmeso.synthesize.quilting import QuiltingOptions, grow


def seeded(seed=3):
    return torch.Generator().manual_seed(seed)


def across(picture, quilting):
    """Mean squared difference of neighbours across seams."""
    shown = quilting.apply(picture)
    right, below = quilting.seams()
    over = [(shown.roll(-1, axis) - shown).square().sum(-1)[which] for axis, which in ((1, right), (0, below))]
    return float(torch.cat(over).mean())


@pytest.mark.parametrize("rule", ["rms", "best"])
@pytest.mark.parametrize("tileable", [False, True])
@pytest.mark.parametrize("size", [(40, 50), (33, 16)])
def test_seams_are_far_smoother_than_those_of_any_patches(rule, tileable, size, rng):
    picture = looks.noise(32, 32, rng)
    options = QuiltingOptions(patch=8, overlap=3, rule=rule, tileable=tileable, toroidal=True)
    careful, careless = (
        grow(exemplar(picture), size, replace(options, tolerance=c), rng=seeded()).map for c in (0.1, 1e5)
    )
    assert careful.texels == size and careful.tileable == tileable
    if rule == "rms":
        assert across(picture, careful) < 0.6 * across(picture, careless)
    seams = [float(torch.stack(quilting.seams()).float().mean()) for quilting in (careful, careless)]
    assert 0.02 < seams[0] < seams[1]


def test_a_texture_that_tiles_continues_over_its_border(rng):
    picture = looks.noise(24, 24, rng)
    found = {}
    for tileable in (False, True):
        options = QuiltingOptions(patch=12, overlap=5, tileable=tileable)
        shown = grow(exemplar(picture), (38, 38), options, rng=seeded()).map.apply(picture)
        border = torch.cat([shown[0] - shown[-1], shown[:, 0] - shown[:, -1]])
        found[tileable] = float(border.square().mean())
    assert found[True] < 0.5 * found[False]


def test_patches_that_continue_exactly_are_taken_at_tolerance_0(rng):
    """An exemplar that tiles, quilted with itself at no tolerance, goes on for ever."""
    picture = torch.rand(8, 8, 3, generator=rng)
    options = QuiltingOptions(patch=6, overlap=2, tolerance=0, toroidal=True, verbatim=True)
    quilt = grow(exemplar(picture), (20, 23), options, rng=seeded())
    right, below = quilt.map.seams()
    assert quilt.within == 1 and not right.any() and not below.any()
    broken = grow(exemplar(picture), (20, 23), replace(options, verbatim=None), rng=seeded())
    assert broken.within == 0 and float(torch.stack(broken.map.seams()).float().mean()) > 0.2


def test_a_high_tolerance_draws_from_all_placements(rng):
    ex = exemplar(looks.noise(16, 16, rng))
    options = QuiltingOptions(patch=4, overlap=1, tolerance=1e6)
    quilt = grow(ex, (64, 64), options, rng=seeded())
    assert quilt.within == 1 and len(quilt.map.index.unique()) > 200


def test_tolerance_is_relative_to_what_is_there():
    """Eq. (3): a patch off by 1 where 10 is passes at c = 0.1 and not below."""
    flat = torch.full((2, 2, 1), 10).repeat_interleave(4, 1)
    flat[:, 4:] = 11  # patches of 10, of 11, and one of both
    ex = Exemplar(codes=flat, power=flat[..., 0] ** 2, step=1.0, kept=1.0)
    jumps = {}
    for c in (0.09, 0.11):
        index = grow(ex, (2, 60), QuiltingOptions(patch=2, overlap=1, tolerance=c), rng=seeded()).map.index
        jumps[c] = bool((flat.flatten()[index.long()].diff(dim=1) < 0).any())
    assert jumps == {0.09: False, 0.11: True}  # from 10 to 11 there is a patch that fits


@pytest.mark.parametrize("kind", [looks.eigen, looks.sh_pca, looks.double_sh])
def test_models_are_quilted_like_pictures(kind, rng):
    ex = exemplar(kind(rng, size=(10, 12)))
    quilt = grow(ex, (17, 30), QuiltingOptions(patch=6, overlap=2), rng=seeded())
    assert quilt.map.source == (10, 12) and quilt.map.texels == (17, 30)


def test_same_seed_same_bits_on_any_threads_and_both_backends(rng, device):
    model, before, found = looks.eigen(rng, size=(20, 20), rank=5), torch.get_num_threads(), []
    for threads, backend in ((1, "torch"), (2, "torch"), (1, "opencl"), (2, "opencl")):
        torch.set_num_threads(threads)
        options = QuiltingOptions(patch=8, overlap=3, tolerance=0.3, tileable=True)
        found.append(grow(exemplar(model), (40, 40), options, rng=seeded(), backend=backend).map.index)
    torch.set_num_threads(before)
    assert all(index.equal(found[0]) for index in found[1:])
    other = grow(exemplar(model), (40, 40), options, rng=seeded(4)).map.index
    assert not other.equal(found[0])


def test_one_colour_and_a_single_texel():
    ex = exemplar(torch.full((5, 6, 3), 0.5))
    quilt = grow(ex, (9, 9), QuiltingOptions(patch=4, overlap=2), rng=seeded())
    assert quilt.within == 1
    assert grow(ex, (1, 1), rng=seeded()).map.texels == (1, 1)


def test_progress_ends_at_one(rng):
    told = []
    grow(exemplar(looks.noise(9, 9, rng)), (20, 20), rng=seeded(), progress=told.append)
    assert told == sorted(told) and told[-1] == 1


@pytest.mark.errors
def test_bad_dials_are_named(rng):
    ex = exemplar(looks.noise(8, 9, rng))
    with pytest.raises(ConfigError, match="expected at most the exemplar's shorter side, 8 texels, got 9"):
        grow(ex, (20, 20), QuiltingOptions(patch=9), rng=seeded())
    with pytest.raises(ConfigError, match="expected at most half a patch of 6 texels, got 4"):
        grow(ex, (20, 20), QuiltingOptions(patch=6, overlap=4), rng=seeded())
    with pytest.raises(ConfigError, match="has to be as large as a patch of 6 texels, got 20 x 5"):
        grow(ex, (5, 20), QuiltingOptions(patch=6, tileable=True), rng=seeded())
    with pytest.raises(ConfigError, match=r"quilting.size: expected 1 to"):
        grow(ex, (0, 20), rng=seeded())
    with pytest.raises(ConfigError, match=r"quilting.rule: expected 'rms' or 'best', got 'x'"):
        QuiltingOptions(rule="x")
    with pytest.raises(ConfigError, match=r"quilting.tolerance"):
        QuiltingOptions(tolerance=-1)
    with pytest.raises(ConfigError, match=r"quilting.patch"):
        QuiltingOptions(patch=1)
    with pytest.raises(ConfigError, match=r"quilting.overlap"):
        QuiltingOptions(overlap=0)
