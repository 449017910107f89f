import numpy as np
import pytest
import torch
from PIL import Image

from torchmeso.compress import rti
from torchmeso.data import hsh, image, ptm
from torchmeso.data.address import texel_centres
from torchmeso.data.rti import LightSet
from torchmeso.errors import ConfigError
from torchmeso.geometry import hemisphere


@pytest.fixture
def dome(tmp_path, rng):
    """A bumpy Lambertian patch under 43 lights, as PNG: the lights, and T of each picture."""
    w = hemisphere.grid(7, 6, 65).directions()
    w = torch.cat([w, torch.tensor([[0.0, 0.0, 1.0]])])
    n = torch.nn.functional.normalize(torch.tensor([0, 0, 2.0]) + torch.rand(6, 5, 3, generator=rng) - 0.5, dim=-1)
    albedo = 0.2 + 0.6 * torch.rand(6, 5, 3, generator=rng)
    T = albedo * (n @ w.T).clamp(min=0).permute(2, 0, 1)[..., None]
    for k, picture in enumerate(T):
        Image.fromarray(np.asarray(image.encode_codes(picture))).save(tmp_path / f"{k}.png")
    return LightSet(files=tuple(tmp_path / f"{k}.png" for k in range(len(T))), directions=w), T


def error(model, lights, T):
    """Root mean square error over all pictures, in sRGB codes."""
    uv = texel_centres(6, 5)
    found = torch.stack([model.evaluate(uv, w.expand(6, 5, 3)) for w in lights.directions])
    return float((image.to_srgb(found.clamp(max=1)) - image.to_srgb(T)).square().mean().sqrt()) * 255


def test_maps_are_near_the_pictures_and_nearer_with_more_terms(dome):
    lrgb, rgb = rti.fit_ptm(dome[0]), rti.fit_ptm(dome[0], per_channel=True)
    maps = [rti.fit_hsh(dome[0], terms) for terms in (4, 9, 16)]
    errors = [error(model, *dome) for model in (lrgb, rgb, *maps)]
    assert errors[0] < 6 and errors[1] < 6, errors  # measured 4.4: a quadratic against a cosine in sRGB
    assert errors[2] > errors[3] > errors[4], errors
    assert errors[4] < 2, errors


def test_what_a_map_can_hold_comes_back(tmp_path, rng):
    """Pictures made of a PTM, unclipped, give the same map back, but for the rounding of pictures to codes."""
    w = hemisphere.grid(7, 4, 65).directions()
    basis = ptm.basis(w)
    a = torch.rand(4, 4, 6, generator=rng) * 20 + torch.tensor([0, 0, 0, 20, 20, 110])
    L = torch.einsum("hwk,lk->lhw", a, basis)
    assert L.min() > 0 and L.max() < 255
    files = tuple(tmp_path / f"{k}.png" for k in range(len(w)))
    for file, picture in zip(files, L, strict=True):
        Image.fromarray(np.asarray(picture.round().to(torch.uint8))).convert("RGB").save(file)
    found = rti.fit_ptm(LightSet(files=files, directions=w), per_channel=True)
    coefficients = (found.codes - found.bias) * found.scale
    assert (coefficients - a[:, :, None]).abs().max() < 3  # measured 0.55: half a code in the pictures


def test_maps_survive_their_files(dome, tmp_path):
    for model, module, name in (
        (rti.fit_ptm(dome[0]), ptm, "a.ptm"),
        (rti.fit_ptm(dome[0], per_channel=True), ptm, "b.ptm"),
        (rti.fit_hsh(dome[0], 9), hsh, "c.rti"),
    ):
        module.write(model, tmp_path / name)
        assert error(module.read(tmp_path / name), *dome) == pytest.approx(error(model, *dome), rel=1e-4)


def test_black_and_constant_pictures(tmp_path):
    w = hemisphere.grid(5, 3, 60).directions()
    for value in (0, 200):
        files = tuple(tmp_path / f"{value}.{k}.png" for k in range(len(w)))
        for file in files:
            Image.new("RGB", (2, 2), (value,) * 3).save(file)
        lights = LightSet(files=files, directions=w)
        for model in (rti.fit_ptm(lights), rti.fit_ptm(lights, per_channel=True), rti.fit_hsh(lights)):
            T = model.evaluate(texel_centres(2, 2), w[4].expand(2, 2, 3))
            torch.testing.assert_close(image.to_srgb(T) * 255, torch.full((2, 2, 3), float(value)), rtol=0, atol=1.5)


@pytest.mark.errors
def test_too_few_lights_are_refused(dome):
    one_ring = LightSet(files=dome[0].files[:7], directions=dome[0].directions[:7])
    with pytest.raises(ConfigError, match="7 lights can tell 5 terms apart, not the six coefficients of a PTM"):
        rti.fit_ptm(one_ring)
    with pytest.raises(ConfigError, match="not the 4 terms of an HSH map; add lights at other heights"):
        rti.fit_hsh(one_ring, 4)
    with pytest.raises(ConfigError, match=r"rti\.terms: expected 4, 9 or 16, got 8"):
        rti.fit_hsh(dome[0], 8)
