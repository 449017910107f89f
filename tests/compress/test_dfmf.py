import numpy as np
import pytest
import torch

from torchmeso.compress import dfmf
from torchmeso.compress.dfmf import DfmfOptions
from torchmeso.data import btfdbb_colour
from torchmeso.data.btf import Btf
from torchmeso.data.btfdbb_colour import Colour
from torchmeso.errors import ConfigError, ShapeError
from torchmeso.geometry import hemisphere

LIGHTS, VIEWS = hemisphere.grid(4, 2, 80), hemisphere.grid(3, 2, 75)


def random_table(rng, size=(7, 5)):
    images = torch.exp(6 * torch.rand(len(LIGHTS), len(VIEWS), *size, 3, generator=rng) - 3)
    return Btf(images=images, lights=LIGHTS, views=VIEWS)


@pytest.mark.parametrize("model", [0, 11])
def test_each_channel_is_cut_best(rng, model, monkeypatch):
    table, colour = random_table(rng), Colour(model)
    monkeypatch.setattr(dfmf, "BLOCK_BYTES", 48 * 5 * 12 * 3)  # bands of three rows, the last of one
    shares = []
    factors = dfmf.fit(table, DfmfOptions(rank=6, colour=colour), progress=shares.append)
    x = btfdbb_colour.from_rgb(colour, table.images.double())
    for c, (by_pair, by_texel) in enumerate(factors):
        # pair = light + lights * view; texels from the bottom row up
        B = x[..., c].flip(2).permute(1, 0, 2, 3).reshape(48, 35).numpy()
        error = np.linalg.norm(B - (by_pair.double() @ by_texel.double().mT).numpy())
        assert (
            error <= np.linalg.norm(np.linalg.svd(B)[1][6:]) * 1.01
        )  # noise has no leading components; measured 1.001
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1)


def test_the_rank_is_64_or_all_there_is(rng):
    assert [U.shape[1] for U, _ in dfmf.fit(random_table(rng))] == [35] * 3
    assert [U.shape[1] for U, _ in dfmf.fit(random_table(rng, (13, 9)))] == [48] * 3
    assert dfmf.DEFAULT_RANK == 64


@pytest.mark.errors
def test_refusals(rng):
    with pytest.raises(ConfigError, match=r"dfmf\.rank: expected a value from 1 to 35, got 36"):
        dfmf.fit(random_table(rng), DfmfOptions(rank=36))
    table = random_table(rng)
    table.images[0, 0, 0, 0] = -1
    with pytest.raises(ShapeError, match="expected values from 0 on"):
        dfmf.fit(table)
