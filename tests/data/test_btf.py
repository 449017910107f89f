import math

import pytest
import torch

from tests.tolerances import FLOAT32, FLOAT64
from torchmeso.data import btf as btf_module
from torchmeso.data import image
from torchmeso.data.address import texel_centres
from torchmeso.data.btf import Btf
from torchmeso.errors import FormatError, ShapeError
from torchmeso.geometry import hemisphere
from torchmeso.geometry.directions import from_angles, normalize

LIGHTS, VIEWS = hemisphere.grid(4, 3, 80), hemisphere.grid(3, 2, 75)


def random_btf(rng, size=5, dtype=torch.float64):
    images = torch.rand(len(LIGHTS), len(VIEWS), size, size + 1, 3, dtype=torch.float64, generator=rng)
    return Btf(images=images.to(dtype), lights=LIGHTS, views=VIEWS, h=0.1)


def lambert(albedo=0.6):
    cosine = LIGHTS.directions(torch.float64)[:, 2]
    images = (albedo * cosine)[:, None, None, None, None].expand(len(LIGHTS), len(VIEWS), 4, 4, 3).contiguous()
    return Btf(images=images, lights=LIGHTS, views=VIEWS)


def test_exact_at_the_samples(rng):
    btf = random_btf(rng)
    uv = texel_centres(5, 6, torch.float64)
    for l in (0, 7):
        for v in (0, 5):
            wi, wo = LIGHTS.directions(torch.float64)[l], VIEWS.directions(torch.float64)[v]
            T = btf.evaluate(uv, wi.expand(5, 6, 3), wo.expand(5, 6, 3))
            torch.testing.assert_close(T, btf.images[l, v], **FLOAT64)


def test_lambert_falls_to_zero_at_the_horizon():
    theta = torch.tensor([80.0, 85.0, 89.0, 90.0, 100.0], dtype=torch.float64).deg2rad()
    wi = from_angles(theta, torch.zeros(5, dtype=torch.float64))
    wo = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(5, 3)
    T = lambert().evaluate(torch.rand(5, 2, dtype=torch.float64), wi, wo)[:, 0]
    torch.testing.assert_close(T, 0.6 * theta.cos().clamp(min=0), rtol=1e-9, atol=1e-12)


def test_ambient_of_a_lambertian_is_its_albedo():
    wo = torch.tensor([[0.3, 0.0, 0.95]], dtype=torch.float64)
    ambient = lambert().ambient(torch.zeros(1, 2, dtype=torch.float64), wo)
    assert float(ambient[0, 0]) == pytest.approx(0.6, rel=4e-2)  # three rings of lights; measured 2.6e-2


def test_continuous_along_light_and_view_sweeps(rng):
    btf = random_btf(rng)
    uv = torch.tensor([0.31, 0.77], dtype=torch.float64)
    fixed = normalize(torch.tensor([0.3, 0.5, 0.6], dtype=torch.float64))
    for swept in ("wi", "wo"):
        jumps = []
        for n in (2_000, 4_000):
            theta = torch.linspace(-2.0, 2.0, n, dtype=torch.float64)
            w = from_angles(theta, torch.full_like(theta, 0.7))
            still = fixed.expand(n, 3)
            T = btf.evaluate(uv.expand(n, 2), *((w, still) if swept == "wi" else (still, w)))
            jumps.append(T.diff(dim=0).abs().max())
        assert jumps[1] < 0.6 * jumps[0]


def test_gradient(rng):
    btf = random_btf(rng)
    uv = torch.rand(4, 2, dtype=torch.float64, generator=rng).requires_grad_()
    theta = torch.tensor([0.2, 0.6, 1.0, 1.3], dtype=torch.float64)
    wi = from_angles(theta, torch.tensor([0.2, 1.0, 2.0, -1.0], dtype=torch.float64)).requires_grad_()
    wo = from_angles(theta.flip(0), torch.tensor([0.3, 1.1, 2.2, -1.2], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(btf.evaluate, (uv, wi, wo))


def test_round_trip_through_disk(tmp_path, rng):
    btf = random_btf(rng, dtype=torch.float16)
    btf_module.save(btf, tmp_path / "a.btf.zarr", samples=4)
    back = btf_module.load(tmp_path / "a.btf.zarr")
    assert torch.equal(back.pictures(), btf.images)
    assert torch.equal(back.rows(1, 3), btf.rows(1, 3))
    assert (back.lights, back.views, back.h) == (LIGHTS, VIEWS, 0.1)


@pytest.mark.errors
def test_values_that_do_not_fit_are_refused(tmp_path):
    images = torch.full((len(LIGHTS), len(VIEWS), 2, 2, 3), 1e6)
    with pytest.raises(ShapeError, match="expected values that fit float16, got one beyond it; store float32"):
        btf_module.save(Btf(images=images, lights=LIGHTS, views=VIEWS), tmp_path / "a.btf.zarr")
    btf_module.save(Btf(images=images, lights=LIGHTS, views=VIEWS), tmp_path / "a.btf.zarr", dtype="float32")


@pytest.mark.errors
def test_bad_tables_are_refused(tmp_path, rng):
    with pytest.raises(ShapeError, match=r"btf\.images: expected shape \(12, 6, any, any, 3\)"):
        Btf(images=torch.zeros(11, 6, 2, 2, 3), lights=LIGHTS, views=VIEWS)
    images = torch.zeros(12, 6, 4, 4, 3)
    images[3, 2, 3, 1, 0] = math.nan
    with pytest.raises(ShapeError, match="got nan at light 3, view 2, row 3, column 1"):
        Btf(images=images, lights=LIGHTS, views=VIEWS).rows(2, 4)
    btf_module.save(random_btf(rng), tmp_path / "a.btf.zarr")
    meta = tmp_path / "a.btf.zarr" / "zarr.json"
    meta.write_text(meta.read_text().replace('"lights"', '"was_lights"'))
    with pytest.raises(FormatError, match="expected 'lights' in the file"):
        btf_module.load(tmp_path / "a.btf.zarr")


@pytest.mark.errors
def test_values_that_are_no_reflectance_are_counted(tmp_path, rng):
    images = torch.zeros(12, 6, 4, 4, 3)
    images[3, 2, 3] = math.inf
    table = Btf(images=images, lights=LIGHTS, views=VIEWS)
    with pytest.raises(
        ShapeError, match="got inf at light 3, view 2, row 3, column 0, and 11 more in rows 0 to 3; repair"
    ):
        table.rows(0, 4)
    with pytest.raises(ShapeError, match=r"btf\.images: expected finite values, got inf .* 11 more"):
        table.pictures()
    with pytest.raises(ShapeError, match="expected at least one texel, got 4 x 0"):
        Btf(images=images[:, :, :0], lights=LIGHTS, views=VIEWS)


@pytest.mark.errors
def test_damage_on_disk_is_named(tmp_path, rng):
    path = tmp_path / "a.btf.zarr"
    btf_module.save(random_btf(rng), path)
    table = btf_module.load(path)
    for chunk in (path / "images" / "c").rglob("*"):
        if chunk.is_file():
            chunk.write_bytes(chunk.read_bytes()[:9])
    for read in (table.pictures, lambda: table.rows(0, 1)):
        with pytest.raises(FormatError, match="the copy may be incomplete"):
            read()
    meta = path / "images" / "zarr.json"
    meta.write_text('{"zarr_format": 3, "node_type": "group"}')
    with pytest.raises(FormatError, match="expected an array 'images', got a group"):
        btf_module.load(path)


def test_codes_are_decoded_where_they_are_read(tmp_path, rng):
    codes = torch.randint(0, 256, (len(LIGHTS), len(VIEWS), 5, 6, 3), generator=rng, dtype=torch.uint8)
    linear = image.to_linear(codes.double() / 255)
    coded, floats = (
        Btf(images=codes, lights=LIGHTS, views=VIEWS, encoding="srgb"),
        Btf(images=linear, lights=LIGHTS, views=VIEWS),
    )
    torch.testing.assert_close(coded.pictures().double(), linear, **FLOAT32)
    torch.testing.assert_close(coded.rows(1, 3).double(), linear[:, :, 1:3], **FLOAT32)
    w = normalize(torch.rand(2, 50, 3, dtype=torch.float64, generator=rng) * 2 - torch.tensor([1.0, 1.0, 0.0]))
    uv = torch.rand(50, 2, dtype=torch.float64, generator=rng)
    torch.testing.assert_close(coded.evaluate(uv, *w), floats.evaluate(uv, *w), **FLOAT32)
    torch.testing.assert_close(coded.ambient(uv, w[1]), floats.ambient(uv, w[1]), **FLOAT32)


def test_codes_without_poles_to_add_stay_bytes(rng):
    lights = hemisphere.from_rings((0, 50), (1, 5), (0, 0))
    codes = torch.randint(0, 256, (6, 6, 3, 3, 3), generator=rng, dtype=torch.uint8)
    coded = Btf(images=codes, lights=lights, views=lights, encoding="srgb")
    w = lights.directions()[4]
    T = coded.evaluate(texel_centres(3, 3), w.expand(3, 3, 3), w.expand(3, 3, 3))
    torch.testing.assert_close(T, image.decode_codes(codes[4, 4]), **FLOAT32)
    assert coded._nodes.dtype == torch.uint8


@pytest.mark.errors
def test_an_encoding_that_does_not_fit_is_refused(tmp_path, rng):
    for dtype, encoding in ((torch.uint8, "linear"), (torch.float32, "srgb")):
        images = torch.zeros(len(LIGHTS), len(VIEWS), 2, 2, 3, dtype=dtype)
        with pytest.raises(ShapeError, match=r"expected uint8 codes \(encoding srgb\) or floats \(linear\), got torch"):
            Btf(images=images, lights=LIGHTS, views=VIEWS, encoding=encoding)
    path = tmp_path / "a.btf.zarr"
    btf_module.save(random_btf(rng), path, encoding="log")
    with pytest.raises(FormatError, match="expected the encoding 'linear' or 'srgb', got 'log'"):
        btf_module.load(path)
