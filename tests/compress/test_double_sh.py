import math

import pytest
import torch

from torchmeso.algebra import secular
from torchmeso.algebra.spherical_harmonics import basis
from torchmeso.compress import double_sh
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.data import bands, image
from torchmeso.data.btf import Btf
from torchmeso.errors import ConfigError, ShapeError
from torchmeso.geometry import hemisphere

SETS = hemisphere.ubo81(), hemisphere.grid(10, 5, 80)


def sides(options):
    lights, views = SETS
    return (
        double_sh.side("light", lights, options.light_terms, options),
        double_sh.side("view", views, options.view_terms, options),
    )


def table(rng, height=3, width=5):
    """Return a BTF that is smooth in both directions: a lobe around the mirrored light."""
    lights, views = SETS
    wi, wo = lights.directions(), views.directions()
    mirrored = wi * torch.tensor([-1.0, -1, 1])
    lobe = (mirrored @ wo.T).clamp(min=0) ** 2 * wi[:, 2:]
    colour = torch.rand(height, width, 3, generator=rng)
    return Btf(images=(0.2 + lobe)[:, :, None, None, None] * colour, lights=lights, views=views)


def test_least_squares_is_the_product_of_two_inverses(rng):
    light, view = sides(DoubleShOptions(light_terms=16, view_terms=9, energy=None))
    samples = torch.rand(81, 50, 7, dtype=torch.float64, generator=rng)
    expected = torch.einsum("il,jv,lvx->ijx", light.factors.matrix.pinverse(), view.factors.matrix.pinverse(), samples)
    torch.testing.assert_close(double_sh.project(samples, light, view), expected, rtol=0, atol=1e-10)


def test_both_stages_keep_their_bound(rng):
    light, view = sides(DoubleShOptions(light_terms=25, view_terms=9))
    samples = torch.rand(81, 50, 40, dtype=torch.float64, generator=rng)
    first = double_sh._stage(samples, light)
    bound = torch.einsum("l,lvx->vx", hemisphere.solid_angles(SETS[0]), samples.square())
    assert (first.square().sum(0) <= bound * (1 + 1e-9)).all()
    second = double_sh._stage(first.movedim(1, 0), view)
    bound = torch.einsum("v,kvx->kx", hemisphere.solid_angles(SETS[1]), first.square())
    assert (second.square().sum(0) <= bound * (1 + 1e-9)).all()
    assert torch.equal(double_sh.project(samples, light, view), second.movedim(1, 0))


@pytest.mark.parametrize("energy", [None, 0.3, 1.0])
@pytest.mark.parametrize("terms", [(25, 9), (36, 16)])
@pytest.mark.parametrize("columns", [1, 16, 70])
def test_opencl_is_the_formula(energy, terms, columns, rng, device):
    light, view = sides(DoubleShOptions(light_terms=terms[0], view_terms=terms[1], energy=energy))
    samples = torch.rand(81, 50, columns, generator=rng) ** 4
    samples[..., 0] = 0
    exact = double_sh.project(samples.double(), light, view)
    found = double_sh.project(samples, light, view, backend="opencl")
    limit = 1e-4 if energy else 1e-2  # without a bound the condition (1e5 at 36) is all there is
    assert ((found - exact).norm(dim=(0, 1)) <= limit * exact.norm(dim=(0, 1))).all()


def test_opencl_reads_bytes_and_views_of_tensors(rng, device):
    light, view = sides(DoubleShOptions(light_terms=9, view_terms=9))
    codes = torch.randint(0, 256, (81, 50, 50), dtype=torch.uint8, generator=rng)
    exact = double_sh.project(codes, light, view, unit=1 / 255)
    for found in (
        double_sh.project(codes, light, view, unit=1 / 255, backend="opencl"),
        double_sh.project((codes / 255.0).movedim(2, 0).clone().movedim(0, 2), light, view, backend="opencl"),
    ):
        torch.testing.assert_close(found, exact, rtol=0, atol=1e-5)


@pytest.mark.parametrize("backend", ["torch", "opencl"])
def test_bands_give_the_same_bits(backend, rng, device, monkeypatch):
    btf = table(rng, 5, 7)
    whole = double_sh.fit(btf, backend=backend)
    monkeypatch.setattr(bands, "ROOM", 1)
    if backend == "opencl":
        monkeypatch.setattr(double_sh, "COLUMNS", 16)
    parts = double_sh.fit(btf, backend=backend)
    assert torch.equal(whole.maps, parts.maps)
    assert torch.equal(whole.scale, parts.scale)


def test_codes_go_to_the_kernel_as_they_are(rng, device):
    lights, views = SETS
    codes = torch.randint(0, 256, (81, 50, 4, 6, 3), dtype=torch.uint8, generator=rng)
    raw = Btf(images=codes, lights=lights, views=views, encoding="srgb")
    linear = Btf(images=raw.pictures(), lights=lights, views=views)
    options = DoubleShOptions(light_terms=9, view_terms=9, storage="float32")
    found, exact = double_sh.fit(raw, options, backend="opencl"), double_sh.fit(linear, options)
    torch.testing.assert_close(found.decoded(), exact.decoded(), rtol=0, atol=1e-3)  # steps of float16
    assert (found.decoded() - exact.decoded()).abs().mean() < 1e-5


def test_every_code_is_decoded_by_the_kernel_as_by_the_table(device):
    one = double_sh.Side(factors=secular.factorise(torch.ones(1, 1), "one"), share=None)
    codes = torch.arange(256, dtype=torch.uint8)[None, None]
    found = double_sh.project(codes, one, one, srgb=True, backend="opencl")[0, 0]
    torch.testing.assert_close(found, image.srgb_table(), rtol=1e-5, atol=5e-7)  # measured 4.2e-7
    torch.testing.assert_close(double_sh.project(codes, one, one, srgb=True)[0, 0], image.srgb_table())


@pytest.mark.parametrize("masked", [0.0, 0.5, 1.0])
def test_black_texels_are_not_fitted(masked, rng, device, monkeypatch):
    lights, views = SETS
    codes = torch.randint(0, 256, (81, 50, 4, 12, 3), dtype=torch.uint8, generator=rng)
    codes[:, :, :, : round(masked * 12)] = 0
    codes[:, 0, 0, 5] = 0  # dark from one view is not black
    btf = Btf(images=codes, lights=lights, views=views, encoding="srgb")
    options = DoubleShOptions(light_terms=4, view_terms=4)
    fitted = []
    project = double_sh.project
    monkeypatch.setattr(double_sh, "project", lambda x, *a, **k: fitted.append(x.shape[2]) or project(x, *a, **k))
    skipping = double_sh.fit(btf, options, backend="opencl")
    assert sum(fitted) == round((1 - masked) * 144)
    monkeypatch.setattr(double_sh, "LIT_SHARE", -1.0)
    whole = double_sh.fit(btf, options, backend="opencl")
    assert torch.equal(skipping.maps, whole.maps)


def test_the_model_shows_the_btf(rng):
    btf = table(rng)
    model = double_sh.fit(btf, DoubleShOptions(light_terms=36, view_terms=16, storage="float32", energy=10))
    l, v = torch.meshgrid(torch.arange(81), torch.arange(50), indexing="ij")
    wi, wo = SETS[0].directions()[l], SETS[1].directions()[v]
    uv = torch.tensor([1.5 / 5, 1 - 0.5 / 3]).expand(81, 50, 2)  # centre of the texel in row 0, column 1
    error = (model.evaluate(uv, wi, wo) - btf.images[:, :, 0, 1]).square().mean().sqrt()
    assert error < 0.02 * btf.images[:, :, 0, 1].square().mean().sqrt()


def test_a_bound_keeps_noise_small(rng):
    """What leung2007tileable, 3.1 uses it for: coefficients that live through eight bits."""
    btf = table(rng)
    errors = []
    for energy in (None, 1.0):
        options = DoubleShOptions(light_terms=36, view_terms=9, energy=energy)
        stored = double_sh.fit(btf, options).decoded()
        exact = double_sh.project(btf.images.flatten(2).double(), *sides(options)).unflatten(2, (3, 5, 3))
        y = basis(SETS[0].directions(), 5)
        errors.append(torch.einsum("li,ijhwc->ljhwc", y, (stored - exact).float()).square().mean())
    assert 10 * math.log10(errors[0] / errors[1]) > 10


def test_too_many_coefficients_are_refused(rng):
    with pytest.raises(ConfigError, match=r"compress: light \(ubo81\): expected directions that tell 49 coefficients"):
        double_sh.fit(table(rng), DoubleShOptions(light_terms=49))
    model = double_sh.fit(table(rng), DoubleShOptions(light_terms=49, view_terms=4, regularise=True))
    assert torch.isfinite(model.decoded()).all()


def test_options_are_checked(rng):
    with pytest.raises(ConfigError, match="expected a square number of coefficients"):
        DoubleShOptions(light_terms=24)
    with pytest.raises(ConfigError, match=r"compress\.energy"):
        DoubleShOptions(energy=-1.0)
    bright = table(rng)
    with pytest.raises(ShapeError, match=r"expected coefficients up to 65,504, got .* in rows 0 to 2"):
        double_sh.fit(Btf(images=bright.images * 1e6, lights=bright.lights, views=bright.views))


def test_no_energy_and_no_light(rng):
    btf = table(rng)
    assert not double_sh.fit(btf, DoubleShOptions(energy=0.0)).decoded().any()
    dark = Btf(images=torch.zeros_like(btf.images), lights=btf.lights, views=btf.views)
    assert not double_sh.fit(dark).decoded().any()


def test_progress_is_told(rng):
    told = []
    double_sh.fit(table(rng), DoubleShOptions(light_terms=4, view_terms=4), progress=told.append)
    assert told[-1] == 1
    assert told == sorted(told)
