import math

import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.errors import ConfigError, ShapeError
from torchmeso.geometry.directions import from_angles, normalize
from torchmeso.transport.materials import Palette, Reflectance, evaluate, fresnel, ndf, pdf, sample


def material(n, albedo=0.8, alpha=0.3, f0=0.04):
    kind = {"dtype": torch.float64}
    return Reflectance(
        torch.full((n, 3), albedo, **kind), torch.full((n,), alpha, **kind), torch.full((n, 3), f0, **kind)
    )


def sphere_grid(n=400):
    theta = (torch.arange(n, dtype=torch.float64) + 0.5) / n * (math.pi / 2)
    phi = (torch.arange(2 * n, dtype=torch.float64) + 0.5) / n * math.pi
    t, p = torch.meshgrid(theta, phi, indexing="ij")
    weight = t.sin() * (math.pi / 2 / n) * (math.pi / n)
    return from_angles(t, p).reshape(-1, 3), weight.flatten()


def upper(n, rng):
    w = normalize(torch.randn(n, 3, dtype=torch.float64, generator=rng))
    return torch.where(w[:, 2:] < 0, -w, w)


def directional_albedo(m, wo):
    wi, weight = sphere_grid()
    many = Reflectance(*(x.expand(len(wi), *x.shape[1:]) for x in m))
    f = evaluate(many, wi, wo.expand(len(wi), 3))
    return (f * (wi[:, 2] * weight).unsqueeze(-1)).sum(0)


def test_without_a_coat_it_is_lambert(rng):
    f = evaluate(material(50, f0=0.0), upper(50, rng), upper(50, rng))
    torch.testing.assert_close(f, torch.full((50, 3), 0.8 / math.pi, dtype=torch.float64), **FLOAT64)


def test_ndf_projects_to_one():
    w, weight = sphere_grid(1500)
    for alpha in (0.05, 0.3, 1.0):
        area = (ndf(w[:, 2], torch.tensor(alpha, dtype=torch.float64)) * w[:, 2] * weight).sum()
        assert float(area) == pytest.approx(1, abs=2e-3)


def test_reciprocity(rng):
    m = material(200, alpha=0.2, f0=0.3)
    wi, wo = upper(200, rng), upper(200, rng)
    torch.testing.assert_close(evaluate(m, wi, wo), evaluate(m, wo, wi), **FLOAT64)


@pytest.mark.parametrize("f0", [0.0, 0.02, 0.04, 0.3, 1.0])
@pytest.mark.parametrize("alpha", [0.1, 0.4, 1.0])
@pytest.mark.parametrize("theta", [0.0, 0.8, 1.4, 1.53])
def test_never_sends_out_more_than_it_receives(f0, alpha, theta):
    wo = from_angles(torch.tensor(theta, dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64))
    assert directional_albedo(material(1, albedo=1.0, alpha=alpha, f0=f0), wo).max() <= 1 + 3e-3  # the grid's own error


def test_smooth_mirror_keeps_its_energy():
    """A narrow lobe with f0 = 1 reflects nearly everything at normal incidence."""
    wo = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert directional_albedo(material(1, albedo=0.0, alpha=0.1, f0=1.0), wo)[0] == pytest.approx(
        1, abs=2e-2
    )  # single scattering loses 1.2e-2


@pytest.mark.parametrize(("alpha", "f0"), [(0.1, 0.04), (0.5, 0.5), (1.0, 1.0)])
def test_density_integrates_to_at_most_one(alpha, f0):
    wi, weight = sphere_grid(800)
    wo = from_angles(torch.tensor(0.7, dtype=torch.float64), torch.tensor(0.4, dtype=torch.float64)).expand(len(wi), 3)
    total = (pdf(material(len(wi), alpha=alpha, f0=f0), wi, wo) * weight).sum()
    assert 0.55 < float(total) <= 1 + 1e-3  # the rest is drawn below the surface


@pytest.mark.parametrize(
    ("alpha", "f0", "theta"), [(0.4, 0.04, 0.3), (0.3, 0.6, 0.9), (1.0, 1.0, 0.1), (0.5, 0.0, 1.2)]
)
def test_samples_follow_the_density(alpha, f0, theta, rng):
    """Chi-square over 8 x 16 cells of the hemisphere, plus one cell for what falls below it."""
    n = 200_000
    m = material(n, alpha=alpha, f0=f0)
    wo = from_angles(torch.tensor(theta, dtype=torch.float64), torch.tensor(0.4, dtype=torch.float64)).expand(n, 3)
    drawn = sample(m, wo, rng)
    up = drawn.wi[:, 2] > 0
    z_cell = (drawn.wi[:, 2] * 8).long().clamp(0, 7)
    phi_cell = ((torch.atan2(drawn.wi[:, 1], drawn.wi[:, 0]) / (2 * math.pi) * 16) % 16).long().clamp(0, 15)
    seen = torch.bincount((z_cell * 16 + phi_cell)[up], minlength=128).double()

    fine = 24  # midpoints per cell and axis
    z = (torch.arange(8 * fine, dtype=torch.float64) + 0.5) / (8 * fine)
    phi = (torch.arange(16 * fine, dtype=torch.float64) + 0.5) / (16 * fine) * 2 * math.pi
    zz, pp = torch.meshgrid(z, phi, indexing="ij")
    wi = torch.stack([(1 - zz**2).sqrt() * pp.cos(), (1 - zz**2).sqrt() * pp.sin(), zz], -1).reshape(-1, 3)
    many = material(len(wi), alpha=alpha, f0=f0)
    density = pdf(many, wi, wo[:1].expand(len(wi), 3)).reshape(8, fine, 16, fine).mean((1, 3)) * (2 * math.pi / 128)
    expected = density.flatten() * n
    big = expected > 20
    chi2 = ((seen - expected).square() / expected)[big].sum()
    freedom = int(big.sum()) - 1
    assert float(chi2) < freedom + 4.5 * math.sqrt(2 * freedom)
    assert float(up.double().mean()) == pytest.approx(float(density.sum()), abs=6e-3)


def test_weights_estimate_the_albedo(rng):
    n = 100_000
    m = material(n, alpha=0.4, f0=0.2)
    wo = from_angles(torch.tensor(0.6, dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64)).expand(n, 3)
    estimate = sample(m, wo, rng).weight.mean(0)
    torch.testing.assert_close(estimate, directional_albedo(material(1, alpha=0.4, f0=0.2), wo[0]), rtol=1e-2, atol=0)


def test_nothing_at_or_below_the_horizon():
    w = torch.tensor([[1.0, 0.0, 0.0], [0.6, 0.0, -0.8]], dtype=torch.float64)
    z = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(2, 3)
    assert (evaluate(material(2), w, z) == 0).all()
    assert (evaluate(material(2), z, w) == 0).all()


def test_grazing_angles_stay_finite_in_float32(rng):
    theta = torch.tensor([1.5707, 1.570796, 1.5])
    w = from_angles(theta, torch.zeros(3))
    m = Reflectance(torch.ones(3, 3), torch.full((3,), 0.02), torch.full((3, 3), 0.9))
    assert torch.isfinite(evaluate(m, w, w)).all()
    assert torch.isfinite(sample(m, w.abs(), rng).weight).all()


def test_fresnel_of_no_coat_is_zero():
    cosine = torch.linspace(0, 1, 5).unsqueeze(-1)
    assert (fresnel(torch.zeros(5, 3), cosine) == 0).all()
    assert (fresnel(torch.full((5, 3), 0.04), cosine)[0] == 1).all()


@pytest.mark.errors
def test_unphysical_palettes_are_refused():
    with pytest.raises(ConfigError, match=r"palette\.albedo: expected values from 0 to 1"):
        Palette(albedo=torch.full((1, 3), 1.2), alpha=torch.ones(1), f0=torch.zeros(1, 3))
    with pytest.raises(ConfigError, match=r"palette\.alpha: expected values from 0\.02"):
        Palette(albedo=torch.ones(1, 3), alpha=torch.zeros(1), f0=torch.zeros(1, 3))
    with pytest.raises(ShapeError, match=r"palette\.alpha"):
        Palette(albedo=torch.ones(1, 3), alpha=torch.ones(2), f0=torch.zeros(1, 3))
