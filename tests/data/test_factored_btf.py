from dataclasses import replace

import pytest
import torch

from torchmeso.data import factored_btf, store
from torchmeso.data.btfdbb_colour import Colour, to_rgb
from torchmeso.data.factored_btf import FactoredBtf
from torchmeso.errors import FormatError, MesoError, ShapeError
from torchmeso.geometry import hemisphere

LIGHTS, VIEWS = hemisphere.grid(4, 2, 80), hemisphere.grid(5, 2, 75)


@pytest.fixture
def model(rng):
    return FactoredBtf(
        by_pair=torch.rand(3, 8, 10, 4, generator=rng).half().float(),
        by_texel=torch.rand(3, 5, 6, 4, generator=rng).half().float(),
        colour=Colour(11), opened_rank=3, lights=LIGHTS, views=VIEWS,
    )  # fmt: skip


def test_rows_are_the_formula(model):
    T = model.rows(1, 4)
    l, v, h, w = 3, 7, 2, 4
    x = torch.stack([model.by_pair[c, l, v] @ model.by_texel[c, 1 + h, w] for c in range(3)])
    torch.testing.assert_close(T[l, v, h, w], to_rgb(Colour(11), x), rtol=1e-5, atol=1e-5)
    assert T.shape == (8, 10, 3, 6, 3)


def test_saved_and_loaded(model, tmp_path):
    factored_btf.save(model, tmp_path / "a.meso")
    back = factored_btf.load(tmp_path / "a.meso")
    assert torch.equal(back.by_pair, model.by_pair) and torch.equal(back.by_texel, model.by_texel)
    assert (back.colour, back.opened_rank, back.lights, back.views) == (Colour(11), 3, LIGHTS, VIEWS)


@pytest.mark.errors
def test_what_does_not_fit_is_refused(model, tmp_path):
    for change, text in (
        ({"by_pair": model.by_pair[:, 1:]}, r"factored\.by_pair: expected shape"),
        ({"by_texel": model.by_texel[:, :0]}, "at least one of each"),
        ({"opened_rank": 0}, "expected 1 to 10, got 0"),
        ({"opened_rank": 11}, "expected 1 to 10, got 11"),
        ({"by_pair": model.by_pair / 0}, "finite"),
    ):
        with pytest.raises(ShapeError, match=text):
            replace(model, **change)
    with pytest.raises(ShapeError, match="factored"):
        replace(model, by_texel=1e4 * model.by_texel).rows(0, 1)  # exp of it
    store.write_model(tmp_path / "b.meso", {"x": torch.zeros(1)}, {"kind": "eigen"})
    with pytest.raises(FormatError, match="expected a factored BTF, found x"):
        factored_btf.load(tmp_path / "b.meso")
    factored_btf.save(model, tmp_path / "a.meso")
    found = store.Model(tmp_path / "a.meso")
    tensors = {name: found.read(name) for name in found.names()}
    for about in ({"colour": 5}, {"opened_rank": "many"}, {"lights": "grid(4, 3, 80)"}):
        store.write_model(tmp_path / "c.meso", tensors, {"factored": {**found.meta["factored"], **about}})
        with pytest.raises(MesoError):
            factored_btf.load(tmp_path / "c.meso")
