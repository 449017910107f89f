import numpy as np
import pytest
import torch

from torchmeso.compress import dfmf
from torchmeso.compress.dfmf import DfmfOptions
from torchmeso.data import bands, btfdbb_colour, journal
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
    monkeypatch.setattr(bands, "ROOM", 48 * 5 * 12 * 3)  # bands of three rows, the last of one
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


def test_bands_give_the_same_bits(rng, monkeypatch):
    table = random_table(rng)
    whole = dfmf.fit(table, DfmfOptions(rank=6))
    monkeypatch.setattr(bands, "ROOM", 1)
    for (U, SV), (U_rows, SV_rows) in zip(whole, dfmf.fit(table, DfmfOptions(rank=6)), strict=True):
        assert torch.equal(U, U_rows)
        assert torch.equal(SV, SV_rows)


@pytest.mark.parametrize("accurate", [False, True])
@pytest.mark.parametrize("passes", [1, 4])
def test_a_fit_that_was_killed_goes_on(accurate, passes, rng, tmp_path):
    table, options = random_table(rng), DfmfOptions(rank=6, accurate=accurate)
    whole = dfmf.fit(table, options)

    def dies(share):
        if share > (passes + 0.5) / 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), journal.beside(tmp_path / "a.btf", "k") as kept:
        dfmf.fit(table, options, kept=kept, progress=dies)
    told = []
    with journal.beside(tmp_path / "a.btf", "k") as kept:
        again = dfmf.fit(table, options, kept=kept, progress=told.append)
    assert len(told) == (6 - passes) * 7
    assert told[-1] == pytest.approx(1)
    for (U, SV), (U_again, SV_again) in zip(whole, again, strict=True):
        assert torch.equal(U, U_again)
        assert torch.equal(SV, SV_again)


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
