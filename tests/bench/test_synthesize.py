import numpy as np
import pytest
import torch

from tests.synthesize import looks
from torchmeso.bench import synthesize
from torchmeso.bench.suite import Context
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.synthesize import patch_error


def test_brute_force_is_what_is_measured_against(rng):
    source = patch_error.exemplar(looks.noise(12, 11, rng))
    mask = torch.rand(4, 5, generator=rng) < 0.5
    target = source.codes[2:6, 3:8]
    found = synthesize.by_hand(source, target, mask)
    np.testing.assert_array_equal(found, patch_error.Search(source).errors(target, mask).numpy())
    assert found[2, 3] == 0


def test_a_seam_between_equal_stripes_shows_what_it_jumps():
    picture = torch.arange(8.0).expand(4, 8)[..., None]  # steps of 1
    index = torch.arange(32, dtype=torch.int32).reshape(4, 8)
    quilting = QuiltingMap(index=torch.cat([index[:, :3], index[:, 5:]], 1).contiguous(), source=(4, 8))
    assert synthesize.seam_ratio(picture, quilting, wraps=False) == pytest.approx(9)  # from 2 to 5
    whole = QuiltingMap(index=index, source=(4, 8))
    assert synthesize.seam_ratio(picture, whole, wraps=False) == 0


def test_rows_on_small_models(monkeypatch, rng, device, tmp_path):
    small = looks.eigen(rng, size=(32, 32))
    monkeypatch.setattr(synthesize, "model", lambda kind, context: small)
    monkeypatch.setattr(synthesize, "LARGE", (40, 40))
    monkeypatch.setattr(synthesize, "PAIRS", 2)
    monkeypatch.setattr(synthesize.wang, "SIDE", 16)
    monkeypatch.setattr(synthesize.wang, "PLANE", 3)
    monkeypatch.setattr(synthesize, "data_dir", lambda: tmp_path)
    context = Context(quick=True)
    found = {}
    for measure in (
        synthesize.times,
        synthesize.search,
        synthesize.seams_by_dp,
        synthesize.seam_energy,
        synthesize.tile_seams,
    ):
        found |= {row.id.removeprefix("synthesize."): row for row in measure(context)}
    assert found["tiles.relit.borders.brick"].value > 0 and found["tiles.relit.seams.weave"].value > 0
    assert found["search.error"].value == 0 and found["search.error"].met
    assert found["seams.pictures"].value is None and "TORCHMESO_DATA" in found["seams.pictures"].why
    assert found["seams.brick"].value > 0 and found["seam_dp.64"].value > 0


def test_names_are_no_beginnings_of_one_another():
    names = [m.name for m in synthesize.MEASUREMENTS]
    assert not [(a, b) for a in names for b in names if a != b and b.startswith(f"{a}.")]
