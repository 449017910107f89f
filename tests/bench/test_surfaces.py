import pytest
import torch

from tests.geometry.test_quads import BOX
from tests.synthesize import looks
from tests.synthesize.test_tiling import tiles
from torchmeso.bench.surfaces import borders, relit
from torchmeso.geometry import quads
from torchmeso.synthesize import patch_error, quad_tiling, wang
from torchmeso.synthesize.wang import WangOptions


@pytest.fixture(scope="module")
def box():
    return quad_tiling.arrange(quads.patches(quads.split(BOX, 3).mesh), tiles("any"))


def test_each_edge_is_looked_at_once_in_the_frame_beyond_it(box):
    shown = [torch.full((10, 10, 1), float(k)) for k in range(4)]
    found = borders(box, tiles("any"), shown)
    assert len(found.plain) == 108 - len(box.jumps) and len(found.turned) == len(box.jumps)
    assert not bool(found.plain.any())
    quarter = box.jumps[:, 2]
    # One side's frame is the other's turned back: which one an edge is seen from is not said.
    assert bool((found.turned.sort().values <= torch.maximum(quarter, 4 - quarter).square().sort().values).all())


def test_texels_meet_where_tiles_do(box, rng):
    """Outermost texels that are the side's colour, the same all along, meet their like."""
    options = WangOptions(size=16, band=8, patch=8, refine=0, candidates=1, kind="any")
    source = looks.noise(24, 28, rng)
    set_ = wang.grow(patch_error.exemplar(source), options, rng=rng).set
    found = borders(box, set_, [source] * 4)
    assert len(found.plain) == 16 * (108 - len(box.jumps))
    assert float(found.plain.mean()) < 0.5 * float(found.turned.mean())  # only the former were made to meet


def test_a_turned_btf_is_itself_after_four_turns(rng):
    look = looks.eigen(rng)
    shown = next(relit(look))
    assert len(shown) == 4 and not shown[0].equal(shown[1])
