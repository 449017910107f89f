import math
from dataclasses import replace

import pytest
import torch

from torchmeso.algebra.spherical_harmonics import basis, hemisphere_matrix
from torchmeso.data import sh_btf, store
from torchmeso.data.pyramid import footprint
from torchmeso.data.sh_btf import ShBtf
from torchmeso.errors import FormatError, ShapeError
from torchmeso.geometry import hemisphere
from torchmeso.geometry.directions import from_angles


def model(rng, terms=(9, 4), size=(4, 6), dtype=torch.float64):
    maps = torch.rand(*terms, *size, 3, dtype=torch.float64, generator=rng)
    maps = (maps * 255).round().to(torch.uint8) if dtype == torch.uint8 else maps.to(dtype)
    scale = torch.rand(*terms, 3, dtype=torch.float64, generator=rng)
    offset = torch.rand(*terms, 3, dtype=torch.float64, generator=rng) - 0.5
    if dtype == torch.uint8:
        scale, offset = (scale / 255).float(), offset.float()
    return ShBtf(
        maps=maps, scale=scale, offset=offset, lights=hemisphere.ubo81(), views=hemisphere.grid(6, 3, 80)
    )  # fmt: skip


def upper(n, rng, last_deg=75.0):
    theta = torch.rand(n, dtype=torch.float64, generator=rng) * math.radians(last_deg)
    return from_angles(theta, 7 * torch.rand(n, dtype=torch.float64, generator=rng))


def test_evaluation_is_the_double_sum_at_texel_centres(rng):
    m = model(rng)
    wi, wo = upper(24, rng), upper(24, rng)
    row, column = torch.meshgrid(torch.arange(4), torch.arange(6), indexing="ij")
    uv = torch.stack([(column.flatten().double() + 0.5) / 6, 1 - (row.flatten().double() + 0.5) / 4], -1)
    C = m.decoded().flatten(2, 3)
    expected = torch.einsum("ijpc,pi,pj->pc", C, basis(wi, 2), basis(wo, 1))
    torch.testing.assert_close(m.evaluate(uv, wi, wo), expected, rtol=1e-10, atol=1e-10)


def test_codes_decode(rng):
    m = model(rng, dtype=torch.uint8)
    exact = replace(m, maps=m.maps.double(), scale=m.scale.double(), offset=m.offset.double())
    uv = torch.rand(30, 2, dtype=torch.float64, generator=rng)
    wi, wo = upper(30, rng), upper(30, rng)
    found = m.evaluate(uv.float(), wi.float(), wo.float())
    torch.testing.assert_close(found.double(), exact.evaluate(uv, wi, wo), rtol=1e-4, atol=1e-4)


def test_below_the_rings_the_light_falls_off_and_the_view_is_held(rng):
    m = model(rng)
    uv = torch.rand(3, 2, dtype=torch.float64, generator=rng)
    phi = torch.tensor([0.3, 1.9, 4.0], dtype=torch.float64)
    wo = upper(3, rng)

    def lit(theta_deg):
        return m.evaluate(uv, from_angles(torch.full_like(phi, math.radians(theta_deg)), phi), wo)

    falloff = math.cos(math.radians(85)) / math.cos(math.radians(75))
    torch.testing.assert_close(lit(85), lit(75) * falloff, rtol=1e-9, atol=1e-12)
    assert not lit(90.001).any()
    wi = upper(3, rng)
    low = from_angles(torch.full_like(phi, math.radians(88)), phi)
    ring = from_angles(torch.full_like(phi, math.radians(80)), phi)
    torch.testing.assert_close(m.evaluate(uv, wi, low), m.evaluate(uv, wi, ring), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("which", ["light", "view"])
@pytest.mark.parametrize("azimuth", [0.0, 1.234])
def test_no_jumps_over_pole_and_horizon(which, azimuth, rng):
    m = model(rng)
    sizes = []
    for n in (2000, 4000):
        angle = torch.linspace(-1.7, 1.7, n, dtype=torch.float64)
        sweep = torch.stack([angle.sin() * math.cos(azimuth), angle.sin() * math.sin(azimuth), angle.cos()], -1)
        fixed = upper(1, rng).expand(n, 3)
        uv = torch.full((n, 2), 0.3, dtype=torch.float64)
        T = m.evaluate(uv, sweep, fixed) if which == "light" else m.evaluate(uv, fixed, sweep)
        sizes.append(T.diff(dim=0).abs().max())
        fixed = fixed.clone()
    assert sizes[0] < 0.05
    assert sizes[1] < 0.02 + 0.7 * sizes[0]


def test_ambient_is_the_integral(rng):
    m = model(rng)
    uv, wo = torch.rand(2, 2, dtype=torch.float64, generator=rng), upper(2, rng)
    n = 120
    z = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    phi = (torch.arange(n, dtype=torch.float64) + 0.5) * (2 * math.pi / n)
    wi = from_angles(z.acos()[:, None].expand(n, n), phi.expand(n, n)).reshape(-1, 3)
    for k in range(2):
        T = m.evaluate(uv[k].expand(n * n, 2), wi, wo[k].expand(n * n, 3))
        torch.testing.assert_close(m.ambient(uv, wo)[k], T.mean(0) * 2, rtol=1e-3, atol=5e-4)


def test_white_is_one(rng):
    """T = cos(theta_i) for a white diffuser: one coefficient per band l <= 4 is not exact, and close."""
    c = torch.zeros(25, 1, 1, 1, 3, dtype=torch.float64)
    w, weight = sh_btf._hemisphere_points(hemisphere.ubo81().last, 6)
    A = hemisphere_matrix(4)
    c[:, 0, 0, 0, :] = torch.linalg.solve(A, basis(w, 4).T @ (weight * w[:, 2]))[:, None] / basis(w[:1], 0)[0, 0]
    one = torch.ones(25, 1, 3, dtype=torch.float64)
    m = ShBtf(maps=c, scale=one, offset=one * 0, lights=hemisphere.ubo81(), views=hemisphere.ubo81())
    found = m.ambient(torch.zeros(1, 2, dtype=torch.float64), upper(1, rng))
    assert found.flatten().tolist() == pytest.approx([1, 1, 1], abs=0.01)


def test_a_pixel_that_sees_all_sees_the_mean(rng):
    m = model(rng, size=(4, 4))
    uv = torch.rand(3, 2, dtype=torch.float64, generator=rng)
    wi, wo = upper(3, rng), upper(3, rng, 10)
    found = m.evaluate(uv, wi, wo, footprint(wo, torch.full((3,), 8.0, dtype=torch.float64)))
    mean = replace(m, maps=m.maps.mean((2, 3), keepdim=True))
    torch.testing.assert_close(found, mean.evaluate(uv, wi, wo), rtol=1e-9, atol=1e-9)


def test_round_trip_and_fewer_bands(rng, tmp_path):
    m = model(rng, dtype=torch.uint8)
    sh_btf.save(m, tmp_path / "a.meso")
    whole, low = sh_btf.load(tmp_path / "a.meso"), sh_btf.load(tmp_path / "a.meso", degree=1)
    assert torch.equal(whole.maps, m.maps)
    assert torch.equal(whole.scale, m.scale)
    assert (whole.lights, whole.views) == (m.lights, m.views)
    assert low.terms == (4, 4)
    assert torch.equal(low.maps, m.truncated(4, 4).maps)
    assert store.Model(tmp_path / "a.meso").meta["sh"]["domain"] == "hemisphere_fit"


def test_streams_come_back_and_fewer_bands_load_alone(rng, tmp_path):
    m = model(rng, dtype=torch.uint8)
    m.maps[1, 1:4] = 0
    m.maps[0, 0] = 0
    sh_btf.save(m, tmp_path / "a.meso", coded=True)
    names = store.Model(tmp_path / "a.meso").names()
    assert "sh.code.1.1" not in names and "sh.code.0.0" in names  # zeros, but the first
    assert torch.equal(sh_btf.load(tmp_path / "a.meso").maps, m.maps)
    assert torch.equal(sh_btf.load(tmp_path / "a.meso", degree=1).maps, m.truncated(4, 4).maps)


@pytest.mark.errors
def test_what_does_not_fit_is_refused(rng, tmp_path):
    m = model(rng)
    with pytest.raises(ShapeError, match=r"sh\.scale"):
        replace(m, scale=m.scale[:1])
    with pytest.raises(ShapeError, match="expected uint8 or a float type"):
        replace(m, maps=m.maps.int())
    with pytest.raises(ShapeError, match="at least one texel"):
        replace(m, maps=m.maps[:, :, :0])
    with pytest.raises(ShapeError, match="finite"):
        replace(m, maps=m.maps / 0)
    store.write_model(tmp_path / "b.meso", {"x": torch.zeros(1)}, {"kind": "eigen"})
    with pytest.raises(FormatError, match="expected a double-SH BTF, found x"):
        sh_btf.load(tmp_path / "b.meso")
