import math

import pytest
import torch

from tests.tolerances import FLOAT32, FLOAT64
from torchmeso.data import mdf as mdf_module
from torchmeso.data import store
from torchmeso.data.address import texel_centres
from torchmeso.data.mdf import MIN_COS, Mdf
from torchmeso.errors import ConfigError, FormatError, ShapeError
from torchmeso.geometry import hemisphere
from torchmeso.geometry.directions import from_angles, normalize

VIEWS = hemisphere.grid(5, 4, 87.5)


def make(rng, dtype=torch.float64, with_holes=False):
    delta = torch.rand(len(VIEWS), 6, 5, dtype=torch.float64, generator=rng)
    no_hit = torch.rand(delta.shape, generator=rng) < 0.2 if with_holes else None
    if no_hit is not None:
        delta[no_hit] = 0
    table = (delta * 255).round().to(torch.uint8) if dtype == torch.uint8 else delta.to(dtype)
    return Mdf(delta=table, no_hit=no_hit, directions=VIEWS, h=0.2)


def upper(n, rng):
    w = normalize(torch.randn(n, 3, dtype=torch.float64, generator=rng))
    return torch.where(w[:, 2:] < 0, -w, w)


def test_flat_sheet_is_h_over_cosine(rng):
    sheet = Mdf(delta=torch.full((20, 2, 2), 1.0), no_hit=None, directions=VIEWS, h=0.2)
    wo = upper(100, rng).float()
    expected = 0.2 / wo[:, 2].clamp(min=MIN_COS)
    torch.testing.assert_close(sheet.evaluate(torch.rand(100, 2, generator=rng), wo), expected, **FLOAT32)


def test_exact_at_the_samples(rng):
    mdf = make(rng)
    uv = texel_centres(6, 5, torch.float64)
    for v, wo in enumerate(VIEWS.directions(torch.float64)):
        drop, _ = mdf.drop(uv, wo.expand(6, 5, 3))
        torch.testing.assert_close(drop, mdf.delta[v], **FLOAT64)


def test_uint8_is_within_half_a_code(rng):
    exact = make(torch.Generator().manual_seed(3))
    coded = make(torch.Generator().manual_seed(3), torch.uint8)
    uv, wo = torch.rand(500, 2, dtype=torch.float64, generator=rng), upper(500, rng)
    assert (exact.drop(uv, wo)[0] - coded.drop(uv, wo)[0]).abs().max() <= 1.001 / 255


def test_distance_is_bounded_at_and_below_the_horizon(rng):
    mdf = make(rng)
    phi = torch.linspace(0, 6, 50, dtype=torch.float64)
    for theta in (89.4, 89.9, 90.0, 95.0, 170.0):
        wo = from_angles(torch.full_like(phi, math.radians(theta)), phi)
        D = mdf.evaluate(torch.rand(50, 2, dtype=torch.float64, generator=rng), wo)
        assert torch.isfinite(D).all()
        assert D.max() <= mdf.delta_max * mdf.h / MIN_COS * (1 + 1e-12)


def test_no_hit_is_infinite_and_the_rest_is_not_diluted():
    """Half of the texture is a hole; near the hole's edge the drop is that of the material alone."""
    delta = torch.zeros(20, 4, 4)
    delta[..., :2] = 0.5
    no_hit = torch.zeros(20, 4, 4, dtype=torch.bool)
    no_hit[..., 2:] = True
    mdf = Mdf(delta=delta, no_hit=no_hit, directions=VIEWS, h=0.1)
    u = torch.tensor([0.25, 0.45, 0.49, 0.51, 0.6, 0.75])
    D = mdf.evaluate(torch.stack([u, torch.full_like(u, 0.5)], -1), torch.tensor([0.0, 0.0, 1.0]).expand(6, 3))
    torch.testing.assert_close(D[:3], torch.full((3,), 0.05))
    assert D[3:].isinf().all()


def test_gradient(rng):
    mdf = make(rng)
    uv = torch.rand(5, 2, dtype=torch.float64, generator=rng).requires_grad_()
    wo = from_angles(
        torch.tensor([0.2, 0.5, 0.9, 1.2, 1.45], dtype=torch.float64), 0.3 + torch.arange(5, dtype=torch.float64)
    ).requires_grad_()
    assert torch.autograd.gradcheck(mdf.evaluate, (uv, wo))


@pytest.mark.parametrize("with_holes", [False, True])
def test_table_and_model_round_trip(tmp_path, rng, with_holes):
    mdf = make(rng, torch.uint8, with_holes)
    mdf_module.save(mdf, tmp_path / "a.mdf.zarr")
    tensors, about = mdf_module.to_tensors(mdf)
    store.write_model(tmp_path / "a.meso", tensors, {"mdf": about})
    for back in (mdf_module.load(tmp_path / "a.mdf.zarr"), mdf_module.from_model(store.Model(tmp_path / "a.meso"))):
        assert torch.equal(back.delta, mdf.delta)
        assert (back.no_hit is None) == (not with_holes)
        assert back.no_hit is None or torch.equal(back.no_hit, mdf.no_hit)
        assert back.directions == VIEWS
        assert back.h == 0.2


def test_model_without_mdf_has_none(tmp_path):
    store.write_model(tmp_path / "a.meso", {}, {})
    assert mdf_module.from_model(store.Model(tmp_path / "a.meso")) is None


@pytest.mark.errors
def test_mismatched_parts_are_refused(tmp_path, rng):
    with pytest.raises(ShapeError, match=r"mdf\.delta: expected shape \(20, any, any\), got \(3, 2, 2\)"):
        Mdf(delta=torch.zeros(3, 2, 2), no_hit=None, directions=VIEWS, h=0.1)
    with pytest.raises(ShapeError, match="expected uint8, float16"):
        Mdf(delta=torch.zeros(20, 2, 2, dtype=torch.int32), no_hit=None, directions=VIEWS, h=0.1)
    with pytest.raises(ShapeError, match=r"mdf\.no_hit"):
        Mdf(delta=torch.zeros(20, 2, 2), no_hit=torch.zeros(20, 2, 3).bool(), directions=VIEWS, h=0.1)
    with pytest.raises(ConfigError, match=r"mdf\.h: expected a value"):
        Mdf(delta=torch.zeros(20, 2, 2), no_hit=None, directions=VIEWS, h=0)
    mdf_module.save(make(rng), tmp_path / "a.mdf.zarr")
    meta = tmp_path / "a.mdf.zarr" / "zarr.json"
    meta.write_text(meta.read_text().replace('"directions"', '"was_directions"'))
    with pytest.raises(FormatError, match="expected 'directions' in the file"):
        mdf_module.load(tmp_path / "a.mdf.zarr")
    with pytest.raises(ShapeError, match="expected at least one texel, got 0 x 2"):
        Mdf(delta=torch.zeros(20, 2, 0), no_hit=None, directions=VIEWS, h=0.1)
    with pytest.raises(ShapeError, match=r"mdf\.delta: expected finite values from 0 to 1, got 2"):
        Mdf(delta=torch.full((20, 2, 2), 2.0), no_hit=None, directions=VIEWS, h=0.1)
