import math
from dataclasses import replace

import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.algebra.spherical_harmonics import basis
from torchmeso.compress import sh_pca
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.data import bands, image, ubo2003
from torchmeso.data.btf import Btf
from torchmeso.errors import ConfigError, ShapeError
from torchmeso.geometry import cube_map, hemisphere
from torchmeso.geometry.directions import from_angles

LIGHTS, VIEWS = hemisphere.ubo81(), hemisphere.grid(10, 3, 80)


def table(rng, height=3, width=5, shapes=4, noise=0.0):
    """Return a BTF of a few leaning, coloured facets, all seen more or less in every view."""
    wi = LIGHTS.directions()
    lean = torch.nn.functional.normalize(torch.tensor([0.0, 0, 1]) + 0.3 * torch.randn(shapes, 3, generator=rng), dim=1)
    looks = (wi @ lean.T).clamp(min=0)[..., None] * torch.rand(shapes, 3, generator=rng)
    share = torch.rand(len(VIEWS), height, width, shapes, generator=rng)
    images = torch.einsum("lsc,vhws->lvhwc", looks, share)
    return Btf(images=images + noise * torch.randn(images.shape, generator=rng), lights=LIGHTS, views=VIEWS)


def shown(model, wi):
    """Return T of all views and texels at light directions above the last ring."""
    y = basis(wi, math.isqrt(model.terms) - 1)
    return torch.einsum("lm,kmc,vhwk->lvhwc", y, model.basis, model.decoded())


@pytest.mark.parametrize("domain", ["hemisphere_fit", "sphere_projection"])
def test_projection_gives_harmonics_of_the_light_back(domain):
    """Samples of white, of a cosine and of a quadratic; the sphere also sees what is missing below the horizon."""
    found = sh_pca.projection(LIGHTS, ShPcaOptions(light_terms=25, domain=domain, ridge=0))
    w = LIGHTS.directions(torch.float64)
    samples = torch.stack([w[:, 2], 0.3 + 0.2 * w[:, 0] * w[:, 2]], 1)
    c = found.coefficient @ found.vector @ samples
    if domain == "hemisphere_fit":
        torch.testing.assert_close(basis(w, 4) @ c, samples, rtol=0, atol=1e-11)
    else:
        z = torch.einsum("nk,k->n", basis(w, 4), c[:, 0])
        assert float(c[0, 0]) == pytest.approx(math.pi * 0.5 / math.sqrt(math.pi), rel=0.01)  # its integral times y_0
        assert (z - samples[:, 0]).abs().max() < 0.1


def test_the_cube_map_is_fine_enough(monkeypatch):
    options = ShPcaOptions(domain="sphere_projection")
    found = sh_pca.projection(LIGHTS, options).vector
    monkeypatch.setattr(sh_pca, "FACE", 128)
    finer = sh_pca.projection(LIGHTS, options).vector
    assert (found - finer).norm() < 1e-3 * finer.norm()


def test_the_cube_map_is_smooth_and_dark_below():
    cube = cube_map.texels(16)
    share = sh_pca._onto_cube(LIGHTS, cube)
    up = cube.directions[:, 2]
    assert not share[up <= 0].any()
    inside = up >= math.cos(math.radians(75))
    torch.testing.assert_close(share.sum(1)[inside], torch.ones(int(inside.sum()), dtype=torch.float64), **FLOAT64)
    between = (up > 0) & ~inside
    torch.testing.assert_close(share.sum(1)[between], up[between] / math.cos(math.radians(75)), **FLOAT64)


def test_enough_components_leave_the_light_fit_alone(rng):
    """With all components the model is the ridge solution of every texel."""
    btf = table(rng, noise=0.05)
    options = ShPcaOptions(rank=27, light_terms=9, storage="float32", ridge=1e-3)
    Y = basis(LIGHTS.directions(torch.float64), 2)
    normal = Y.mT @ Y + 1e-3 * 81 / (4 * math.pi) * torch.eye(9, dtype=torch.float64)
    c = torch.linalg.solve(normal, Y.mT @ btf.images.double().flatten(1))
    found = shown(sh_pca.fit(btf, options), LIGHTS.directions())
    torch.testing.assert_close(found.flatten(1).double(), Y @ c, rtol=0, atol=1e-5)


@pytest.mark.parametrize("domain", ["hemisphere_fit", "sphere_projection"])
def test_components_are_as_many_as_there_are_looks(domain, rng):
    btf = table(rng, shapes=3)
    options = ShPcaOptions(rank=3, light_terms=16, storage="float32", domain=domain)
    few, all_of_them = sh_pca.fit(btf, options), sh_pca.fit(btf, replace(options, rank=40))
    w = LIGHTS.directions()
    torch.testing.assert_close(shown(few, w), shown(all_of_them, w), rtol=0, atol=2e-5)


def test_no_components_of_that_number_have_a_smaller_error(rng):
    """Without a ridge the error at the lights is the least one: that of the fit, and of the SVD of what it leaves."""
    btf = table(rng, noise=0.1)
    model = sh_pca.fit(btf, ShPcaOptions(rank=4, light_terms=16, storage="float32", ridge=0))
    T = btf.images.double()
    U = torch.linalg.svd(basis(LIGHTS.directions(torch.float64), 3), full_matrices=False).U
    z = torch.einsum("ln,lvhwc->vhwnc", U, T)
    values = torch.linalg.svdvals(z.reshape(-1, 48))
    least = T.square().sum() - z.square().sum() + values[4:].square().sum()
    error = (shown(model, LIGHTS.directions()).double() - T).square().sum()
    assert float(error / least) == pytest.approx(1, abs=1e-5)


def test_a_sample_of_the_vectors_is_nearly_as_good(rng):
    btf = table(rng, 8, 8, noise=0.05)
    T, w = btf.images, LIGHTS.directions()
    exact = ShPcaOptions(rank=6, light_terms=16, storage="float32")
    errors = [
        float((shown(sh_pca.fit(btf, options, rng=torch.Generator().manual_seed(3)), w) - T).square().mean())
        for options in (exact, replace(exact, training=400), replace(exact, training=10))
    ]
    assert errors[0] <= errors[1] < 1.05 * errors[0]
    assert errors[1] < errors[2]
    whole = replace(exact, training=10**6)
    assert torch.equal(sh_pca.fit(btf, whole).maps, sh_pca.fit(btf, exact).maps)


@pytest.mark.parametrize("training", [None, 7])
def test_bands_give_the_same_bits(training, rng, monkeypatch):
    btf = table(rng, 5, 7, noise=0.1)
    options = ShPcaOptions(rank=4, light_terms=9, training=training)
    whole = sh_pca.fit(btf, options)
    monkeypatch.setattr(bands, "ROOM", 1)
    parts = sh_pca.fit(btf, options)
    assert torch.equal(whole.maps, parts.maps)
    assert torch.equal(whole.basis, parts.basis)
    assert torch.equal(whole.scale, parts.scale)


def test_training_reads_only_rows_that_have_a_sample(rng):
    btf = table(rng, 64, 3)
    asked = []

    class Watched:
        lights, views, texels = LIGHTS, VIEWS, btf.texels

        def rows(self, start, stop):
            asked.append((start, stop))
            return btf.rows(start, stop)

    trained = {row: torch.tensor([3, 5]) for row in (5, 6, 40)}
    layout, P = [slice(0, 32), slice(32, 39), slice(39, 64)], torch.ones(9, 81)
    found = list(sh_pca._grams(Watched(), P, trained, layout, torch.zeros(27, 27, dtype=torch.float64)))
    assert [rows for rows, _ in found] == [slice(0, 32), slice(39, 64)]
    assert asked == [(5, 7), (40, 41)]  # of each band, from the first to the last


def test_eight_bits_are_an_error_at_the_lights_and_not_of_coefficients(rng):
    btf = table(rng, noise=0.05)
    w = LIGHTS.directions()
    options = ShPcaOptions(rank=12, light_terms=36, ridge=0)
    stored, exact = (shown(sh_pca.fit(btf, replace(options, storage=s)), w) for s in ("uint8", "float32"))
    assert (stored - exact).square().mean().sqrt() < 0.01 * exact.square().mean().sqrt()


def test_the_model_shows_the_btf(rng):
    btf = table(rng)
    model = sh_pca.fit(btf, ShPcaOptions(rank=4, light_terms=36))
    l, v = torch.meshgrid(torch.arange(81), torch.arange(30), indexing="ij")
    uv = torch.tensor([1.5 / 5, 1 - 0.5 / 3]).expand(81, 30, 2)  # centre of the texel in row 0, column 1
    found = model.evaluate(uv, LIGHTS.directions()[l], VIEWS.directions()[v])
    expected = btf.images[:, :, 0, 1]
    assert (found - expected).square().mean().sqrt() < 0.03 * expected.square().mean().sqrt()


def test_a_ridge_keeps_what_lies_between_the_lights_small(rng):
    """36 coefficients on six rings: noise at the lights is amplified between them."""
    btf = table(rng, noise=0.05)
    clean = table(torch.Generator().manual_seed(0))
    between = from_angles(torch.full((40,), math.radians(67.5)), torch.linspace(0, 2 * math.pi, 41)[:-1])
    off = []
    for ridge in (0.0, 1e-4):
        options = ShPcaOptions(rank=8, light_terms=36, storage="float32", ridge=ridge)
        noisy, smooth = (shown(sh_pca.fit(x, options), between) for x in (btf, clean))
        off.append(float((noisy - smooth).square().mean().sqrt()))
    assert off[1] < 0.5 * off[0]


@pytest.mark.parametrize("terms", [9, 16, 25])
def test_least_squares_are_closer_than_the_cube_map(terms, rng):
    btf = table(rng, noise=0.02)
    fitted, projected = errors(btf, LIGHTS, terms)
    assert fitted < 0.8 * projected


def test_least_squares_are_closer_than_the_cube_map_on_a_real_material(data_dir):
    """The lights of a real set that form whole rings: 1, 6, 18 and 24 of them."""
    found = ubo2003.survey(data_dir / "ubo2003")
    rings = hemisphere.from_rings([0, 15, 45, 75], [1, 6, 18, 24], [0, 0, 0, 0])
    with found.opened() as read:
        pictures = [image.decode_codes(read(found.files[l, 0]))[::4, ::4] for l in sorted(l for l, _ in found.files)]
    btf = Btf(images=torch.stack(pictures)[:, None], lights=rings, views=hemisphere.from_rings([0], [1], [0]))
    fitted, projected = errors(btf, rings, 16)
    assert fitted < 0.75 * projected  # measured 0.52


def errors(btf, lights, terms):
    """Return the squared errors at the lights of both domains."""
    options = [ShPcaOptions(rank=16, light_terms=terms, domain=d) for d in ("hemisphere_fit", "sphere_projection")]
    w = lights.directions()
    return [float((shown(sh_pca.fit(btf, o), w) - btf.images).square().mean()) for o in options]


def test_too_many_coefficients_are_refused(rng):
    with pytest.raises(ConfigError, match=r"compress: light \(ubo81\): expected directions that tell 49 coefficients"):
        sh_pca.fit(table(rng), ShPcaOptions(light_terms=49))
    model = sh_pca.fit(table(rng), ShPcaOptions(light_terms=49, regularise=True))
    assert model.basis.abs().max() < 100


def test_options_and_values_are_checked(rng):
    with pytest.raises(ConfigError, match="expected a square number of coefficients"):
        ShPcaOptions(light_terms=24)
    with pytest.raises(ConfigError, match=r"compress\.rank: expected 1 to 12 \(three channels of 4"):
        ShPcaOptions(rank=13, light_terms=4)
    with pytest.raises(ConfigError, match=r"compress\.training"):
        ShPcaOptions(rank=8, training=7)
    with pytest.raises(ConfigError, match=r"compress\.ridge"):
        ShPcaOptions(ridge=-1.0)
    btf = table(rng)
    btf.images[3, 2, 1, 0, 0] = math.nan
    with pytest.raises(ShapeError, match="expected finite values"):
        sh_pca.fit(btf)


@pytest.mark.parametrize("domain", ["hemisphere_fit", "sphere_projection"])
def test_no_light_and_one_light(domain, rng):
    btf = table(rng)
    dark = Btf(images=torch.zeros_like(btf.images), lights=LIGHTS, views=VIEWS)
    assert not shown(sh_pca.fit(dark, ShPcaOptions(domain=domain)), LIGHTS.directions()).any()
    alone = Btf(images=btf.images[:1], lights=hemisphere.from_rings([0], [1], [0]), views=VIEWS)
    model = sh_pca.fit(alone, ShPcaOptions(rank=2, light_terms=1, domain=domain))
    assert torch.isfinite(model.decoded()).all()


def test_progress_is_told(rng):
    told = []
    sh_pca.fit(table(rng), ShPcaOptions(rank=2, light_terms=4), progress=told.append)
    assert told[-1] == 1
    assert told == sorted(told)
