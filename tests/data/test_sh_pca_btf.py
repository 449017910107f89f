import math
from dataclasses import replace

import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.algebra.spherical_harmonics import basis
from torchmeso.data import sh_pca_btf, store
from torchmeso.data.pyramid import footprint
from torchmeso.data.sh_pca_btf import ShPcaBtf
from torchmeso.errors import ConfigError, FormatError, ShapeError
from torchmeso.geometry import hemisphere
from torchmeso.geometry.directions import from_angles


def model(rng, rank=5, terms=9, size=(4, 6), dtype=torch.float64, views="grid(5, 3, 75)"):
    views = hemisphere.parse(views)
    maps = torch.rand(len(views), *size, rank, dtype=torch.float64, generator=rng)
    maps = (maps * 255).round().to(torch.uint8) if dtype == torch.uint8 else maps.to(dtype)
    scale, offset = torch.rand(2, rank, dtype=torch.float64, generator=rng)
    return ShPcaBtf(
        maps=maps,
        scale=scale / 255 if dtype == torch.uint8 else scale,
        offset=offset - 0.5,
        basis=torch.rand(rank, terms, 3, dtype=torch.float64, generator=rng) - 0.3,
        lights=hemisphere.grid(8, 4, 80),
        views=views,
    )


def upper(n, rng, least=0.0):
    """Return directions at least `least` degrees above the horizon."""
    z = math.sin(math.radians(least))
    cosine = z + (1 - z) * torch.rand(n, dtype=torch.float64, generator=rng)
    return from_angles(cosine.acos(), torch.rand(n, dtype=torch.float64, generator=rng) * 2 * math.pi)


@pytest.mark.parametrize("dtype", [torch.float64, torch.uint8])
def test_nodes_of_views_and_texels_are_the_sum_of_components(dtype, rng):
    m = model(rng, dtype=dtype)
    W, views = m.decoded(), m.views.directions(torch.float64)
    wi = upper(7, rng, 15)
    for view in (0, 7, 14):
        uv = torch.tensor([2.5 / 6, 1 - 1.5 / 4], dtype=torch.float64).expand(7, 2)  # row 1, column 2
        expected = torch.einsum("k,kmc,nm->nc", W[view, 1, 2], m.basis, basis(wi, 2))
        torch.testing.assert_close(m.evaluate(uv, wi, views[view].expand(7, 3)), expected, rtol=1e-9, atol=1e-9)


def test_below_the_last_ring_light_falls_off_and_ends_at_the_horizon(rng):
    m = model(rng)
    uv, wo = torch.rand(40, 2, dtype=torch.float64, generator=rng), upper(40, rng)
    phi = torch.rand(40, dtype=torch.float64, generator=rng) * 2 * math.pi
    theta = torch.linspace(80, 100, 40, dtype=torch.float64).deg2rad()
    at_ring = m.evaluate(uv, from_angles(torch.full_like(phi, math.radians(80)), phi), wo)
    share = (theta.cos() / math.cos(math.radians(80))).clamp(min=0)
    torch.testing.assert_close(m.evaluate(uv, from_angles(theta, phi), wo), at_ring * share[:, None], **FLOAT64)


@pytest.mark.parametrize("which", ["light", "view"])
@pytest.mark.parametrize("tilt", [0.0, 1e-3, 0.5])
def test_sweeps_through_pole_and_horizon_do_not_jump(which, tilt, rng):
    m = model(rng, size=(1, 1))
    fixed = upper(1, rng)
    sizes = []
    for n in (3000, 6000):
        t = torch.linspace(-1.9, 1.9, n, dtype=torch.float64)
        sweep = torch.stack([t.sin(), t.cos() * math.sin(tilt), t.cos() * math.cos(tilt)], -1)
        uv, other = torch.zeros(n, 2, dtype=torch.float64), fixed.expand(n, 3)
        T = m.evaluate(uv, sweep, other) if which == "light" else m.evaluate(uv, other, sweep)
        sizes.append(float(T.diff(dim=0).abs().max()))
    assert sizes[1] <= 0.8 * sizes[0]


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


@pytest.mark.parametrize("views", ["ubo81", "grid(5, 3, 75)"])
def test_a_pixel_that_sees_all_sees_the_mean(views, rng):
    m = model(rng, size=(4, 4), views=views)
    uv = torch.rand(3, 2, dtype=torch.float64, generator=rng)
    wi, wo = upper(3, rng), upper(3, rng, 10)
    seen = footprint(wo, torch.full((3,), 8.0, dtype=torch.float64))
    mean = replace(m, maps=m.maps.mean((1, 2), keepdim=True))
    torch.testing.assert_close(m.evaluate(uv, wi, wo, seen), mean.evaluate(uv, wi, wo), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(m.ambient(uv, wo, seen), mean.ambient(uv, wo), rtol=1e-9, atol=1e-9)


def test_fewer_components_and_no_points(rng):
    m = model(rng)
    assert m.truncated(2).rank == 2
    uv, wi, wo = torch.rand(5, 2, dtype=torch.float64, generator=rng), upper(5, rng), upper(5, rng)
    rest = replace(m, maps=m.maps[..., 2:], scale=m.scale[2:], offset=m.offset[2:], basis=m.basis[2:])
    both = m.truncated(2).evaluate(uv, wi, wo) + rest.evaluate(uv, wi, wo)
    torch.testing.assert_close(m.evaluate(uv, wi, wo), both, **FLOAT64)
    assert m.evaluate(uv[:0], wi[:0], wo[:0]).shape == (0, 3)


def test_directions_and_places_are_differentiable(rng):
    m = model(rng)
    uv = torch.rand(3, 2, dtype=torch.float64, generator=rng).requires_grad_()
    wi, wo = upper(3, rng, 15).requires_grad_(), upper(3, rng, 20).requires_grad_()
    assert torch.autograd.gradcheck(m.evaluate, (uv, wi, wo))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16])
def test_round_trip_and_fewer_components(dtype, rng, tmp_path):
    m = replace(model(rng, dtype=dtype), domain="sphere_projection")
    sh_pca_btf.save(m, tmp_path / "a.meso")
    whole, low = sh_pca_btf.load(tmp_path / "a.meso"), sh_pca_btf.load(tmp_path / "a.meso", rank=2)
    for name in ("maps", "scale", "offset", "basis"):
        assert torch.equal(getattr(whole, name), getattr(m, name))
        assert torch.equal(getattr(low, name), getattr(m.truncated(2), name))
    assert (whole.lights, whole.views, whole.domain) == (m.lights, m.views, "sphere_projection")


@pytest.mark.errors
def test_what_does_not_fit_is_refused(rng, tmp_path):
    m = model(rng)
    for name, wrong, message in (
        ("scale", m.scale[:1], r"sh_pca\.scale"),
        ("offset", m.offset / 0, r"sh_pca\.offset.*finite"),
        ("basis", m.basis[:, :8], "expected a square number of coefficients"),
        ("maps", m.maps.int(), "expected uint8 or a float type"),
        ("maps", m.maps[:, :0], "at least one component and texel"),
        ("maps", m.maps / 0, r"sh_pca\.maps.*finite"),
        ("maps", m.maps[1:], r"sh_pca\.maps"),
    ):
        with pytest.raises((ShapeError, ConfigError), match=message):
            replace(m, **{name: wrong})
    sh_pca_btf.save(m, tmp_path / "a.meso")
    with pytest.raises(FormatError, match="expected at least one component, got 0"):
        sh_pca_btf.load(tmp_path / "a.meso", rank=0)
    store.write_model(tmp_path / "b.meso", {"x": torch.zeros(1)}, {"kind": "eigen"})
    with pytest.raises(FormatError, match=r"expected an SH \+ PCA BTF, found x"):
        sh_pca_btf.load(tmp_path / "b.meso")


@pytest.mark.errors
def test_damaged_metadata_is_one_sentence(rng, tmp_path):
    m = model(rng)
    about = {"lights": m.lights.name, "views": m.views.name, "rank": 5, "terms": 9, "domain": "sphere"}
    for change, message in (
        ({}, "expected the domain hemisphere_fit or sphere_projection, got 'sphere'"),
        ({"rank": 6, "domain": "hemisphere_fit"}, "expected a tensor 'sh_pca.map.5', found none"),
        ({"rank": "x"}, "cannot be read"),
        ({"domain": "hemisphere_fit", "views": "ubo81"}, "sh_pca.maps"),
    ):
        tensors = {f"sh_pca.map.{k}": m.maps[..., k] for k in range(5)}
        tensors |= {"sh_pca.scale": m.scale, "sh_pca.offset": m.offset, "sh_pca.basis": m.basis}
        store.write_model(tmp_path / "c.meso", tensors, {"sh_pca": {**about, **change}})
        with pytest.raises((FormatError, ShapeError), match=message):
            sh_pca_btf.load(tmp_path / "c.meso")
