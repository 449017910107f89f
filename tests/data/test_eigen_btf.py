import math
from dataclasses import replace

import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.data import eigen_btf, mdf, store
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.mdf import Mdf
from torchmeso.errors import FormatError, MesoError, ShapeError
from torchmeso.geometry import hemisphere, kriging
from torchmeso.geometry.directions import from_angles, normalize

LIGHTS, VIEWS = hemisphere.grid(4, 3, 80), hemisphere.grid(5, 3, 75)


def make(rng, rank=3, dtype=torch.float64):
    maps = torch.rand(len(LIGHTS), 4, 5, rank, 3, dtype=torch.float64, generator=rng)
    codes = (maps * 255).round().to(torch.uint8) if dtype == torch.uint8 else maps.to(dtype)
    ones = torch.ones(rank, 3, dtype=torch.float64 if dtype == torch.float64 else torch.float32)
    weights = torch.randn(len(VIEWS), rank, dtype=torch.float64, generator=rng).to(ones.dtype)
    scale = ones / 255 if dtype == torch.uint8 else ones
    return EigenBtf(maps=codes, weights=weights, scale=scale, offset=0.1 * ones, lights=LIGHTS, views=VIEWS)


def full_table(eigen):
    """The BTF the model stands for, written out: an independent evaluation at the samples."""
    return torch.einsum("lhwkc,vk->lvhwc", eigen.decoded(), eigen.weights)


def test_samples_are_weights_times_maps(rng):
    eigen = make(rng)
    table = full_table(eigen)
    for l, v, row, column in [(0, 0, 0, 0), (7, 9, 3, 4), (11, 14, 2, 1)]:
        uv = torch.tensor([(column + 0.5) / 5, 1 - (row + 0.5) / 4], dtype=torch.float64)
        wi, wo = LIGHTS.directions(torch.float64)[l], VIEWS.directions(torch.float64)[v]
        torch.testing.assert_close(eigen.evaluate(uv, wi, wo), table[l, v, row, column], **FLOAT64)


def test_interpolating_the_model_is_interpolating_its_table(rng):
    """Maps and weights are interpolated apart; by linearity that equals the interpolated table on the finer views."""
    from torchmeso.data.btf import Btf

    eigen = make(rng)
    views, weights = kriging.finer(VIEWS)
    images = torch.einsum("lvhwc,nv->lnhwc", full_table(eigen), weights)
    btf = Btf(images=images, lights=LIGHTS, views=views)
    uv = torch.rand(300, 2, dtype=torch.float64, generator=rng) * 3 - 1
    wi, wo = normalize(torch.randn(2, 300, 3, dtype=torch.float64, generator=rng)).unbind(0)
    torch.testing.assert_close(eigen.evaluate(uv, wi, wo), btf.evaluate(uv, wi, wo), rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(eigen.ambient(uv, wo), btf.ambient(uv, wo), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.float32])
def test_codes_decode_after_interpolation(rng, dtype):
    eigen = make(rng, dtype=dtype)
    plain = EigenBtf(
        maps=eigen.decoded(),
        weights=eigen.weights,
        scale=torch.ones(3, 3),
        offset=torch.zeros(3, 3),
        lights=LIGHTS,
        views=VIEWS,
    )
    uv = torch.rand(50, 2, generator=rng)
    wi, wo = normalize(torch.randn(2, 50, 3, generator=rng).abs() * torch.tensor([1, 1, 0.5])).unbind(0)
    off_pole = wi[:, 2] < 0.95  # the pole is a mean of codes, rounded in the storage type
    uv, wi, wo = uv[off_pole], wi[off_pole], wo[off_pole]
    torch.testing.assert_close(eigen.evaluate(uv, wi, wo), plain.evaluate(uv, wi, wo), rtol=1e-4, atol=1e-5)


def test_gradient(rng):
    eigen = make(rng)
    uv = torch.rand(4, 2, dtype=torch.float64, generator=rng).requires_grad_()
    theta = torch.tensor([0.2, 0.6, 1.0, 1.3], dtype=torch.float64)
    wi = from_angles(theta, torch.tensor([0.2, 1.0, 2.0, -1.0], dtype=torch.float64)).requires_grad_()
    wo = from_angles(theta.flip(0), torch.tensor([0.3, 1.1, 2.2, -1.2], dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(eigen.evaluate, (uv, wi, wo))


def test_gradient_is_finite_at_the_pole(rng):
    eigen = make(rng)
    z = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    wi, wo = z.clone().requires_grad_(), z.clone().requires_grad_()
    eigen.evaluate(torch.rand(1, 2, dtype=torch.float64), wi, wo).sum().backward()
    assert torch.isfinite(wi.grad).all()
    assert torch.isfinite(wo.grad).all()


def test_nothing_below_the_light_horizon(rng):
    wi = torch.tensor([[0.6, 0.0, -0.8], [1.0, 0.0, 0.0]], dtype=torch.float64)
    wo = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(2, 3)
    assert (make(rng).evaluate(torch.rand(2, 2, dtype=torch.float64), wi, wo) == 0).all()


def test_round_trip_and_partial_load(tmp_path, rng):
    eigen = make(rng, dtype=torch.uint8)
    views = hemisphere.grid(2, 2, 87.5)
    silhouette = Mdf(delta=torch.zeros(4, 3, 3, dtype=torch.uint8), no_hit=None, directions=views, h=0.2)
    eigen_btf.save(eigen, tmp_path / "a.meso", silhouette=silhouette, samples=4)
    back = eigen_btf.load(tmp_path / "a.meso")
    assert torch.equal(back.maps, eigen.maps)
    assert torch.equal(back.weights, eigen.weights)
    assert mdf.from_model(store.Model(tmp_path / "a.meso")).h == 0.2
    two = eigen_btf.load(tmp_path / "a.meso", rank=2)
    uv, w = torch.rand(20, 2, generator=rng), normalize(torch.rand(20, 3, generator=rng))
    torch.testing.assert_close(two.evaluate(uv, w, w), eigen.truncated(2).evaluate(uv, w, w))


def test_streams_come_back_and_load_alone(tmp_path, rng):
    eigen = make(rng, dtype=torch.uint8)
    eigen.maps[..., 1, :] = 0
    eigen_btf.save(eigen, tmp_path / "a.meso", coded=True)
    model = store.Model(tmp_path / "a.meso")
    assert [name for name in model.names() if "code" in name] == ["eigen.code.0", "eigen.code.2"]
    for rank in (1, 2, 3):
        back = eigen_btf.load(tmp_path / "a.meso", rank=rank)
        assert torch.equal(back.maps, eigen.maps[..., :rank, :])
        assert torch.equal(back.scale, eigen.scale[:rank])


@pytest.mark.errors
def test_streams_that_do_not_hold_the_model_are_refused(tmp_path, rng):
    path = tmp_path / "a.meso"
    eigen_btf.save(make(rng, dtype=torch.uint8), path, coded=True)
    model = store.Model(path)
    tensors = {name: model.read(name) for name in model.names()}
    for about, text in (
        ({"texels": [1 << 20, 1 << 20]}, "expected .* bytes in a stream"),
        ({"texels": [0, 4]}, "at least one code"),
        ({"rank": 1 << 60}, "eigen.scale: expected shape"),
    ):
        store.write_model(path, tensors, {**model.meta, "eigen": {**model.meta["eigen"], **about}})
        with pytest.raises(MesoError, match=text):
            eigen_btf.load(path)
    del tensors["eigen.code.0"]
    store.write_model(path, tensors, model.meta)
    with pytest.raises(FormatError, match=r"expected a tensor 'eigen\.code\.0'"):
        eigen_btf.load(path)


def test_energy_of_the_falloff_is_continuous(rng):
    eigen = make(rng)
    theta = torch.linspace(1.2, 1.7, 2000, dtype=torch.float64)
    wi = from_angles(theta, torch.full_like(theta, 0.4))
    n = len(theta)
    wo = torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64).expand(n, 3)
    T = eigen.evaluate(torch.full((n, 2), 0.3, dtype=torch.float64), wi, wo)
    assert T.diff(dim=0).abs().max() < 20 * (0.5 / n)
    assert math.isclose(T[-1].abs().sum(), 0)


@pytest.mark.errors
def test_bad_models_are_refused(tmp_path, rng):
    eigen = make(rng)
    with pytest.raises(ShapeError, match=r"eigen\.maps: expected shape \(12, any, any, 3, 3\)"):
        EigenBtf(
            maps=eigen.maps[1:],
            weights=eigen.weights,
            scale=eigen.scale,
            offset=eigen.offset,
            lights=LIGHTS,
            views=VIEWS,
        )
    with pytest.raises(ShapeError, match=r"expected uint8 or a float type, got torch\.int32"):
        EigenBtf(
            maps=eigen.maps.int(),
            weights=eigen.weights,
            scale=eigen.scale,
            offset=eigen.offset,
            lights=LIGHTS,
            views=VIEWS,
        )
    store.write_model(tmp_path / "a.meso", {"x": torch.ones(1)}, {"kind": "other"})
    with pytest.raises(FormatError, match="expected an eigen BTF, found x"):
        eigen_btf.load(tmp_path / "a.meso")
    with pytest.raises(ShapeError, match="expected at least one component and texel"):
        replace(eigen, maps=eigen.maps[:, :0])
    with pytest.raises(ShapeError, match=r"eigen\.weights: expected finite values, got nan"):
        replace(eigen, weights=eigen.weights * math.nan)
    eigen_btf.save(eigen, tmp_path / "b.meso")
    with pytest.raises(FormatError, match="expected at least one component, got 0"):
        eigen_btf.load(tmp_path / "b.meso", rank=0)


def test_seen_from_afar_a_texture_is_its_mean(rng):
    """A pixel over many tiles shows the mean of all texels, whatever light and view."""
    from torchmeso.data import pyramid

    eigen = make(rng)
    table = full_table(eigen).mean((2, 3))
    l, v = 7, 9
    wi, wo = (d.directions(torch.float64)[i].expand(20, 3) for d, i in ((LIGHTS, l), (VIEWS, v)))
    uv = torch.rand(20, 2, dtype=torch.float64, generator=rng)
    seen = pyramid.footprint(wo, torch.full((20,), 5.0, dtype=torch.float64))
    torch.testing.assert_close(eigen.evaluate(uv, wi, wo, seen), table[l, v].expand(20, 3), **FLOAT64)
    share = hemisphere.quadrature(LIGHTS).double() / math.pi
    mean = torch.einsum("lc,l->c", table[:, v], share)
    torch.testing.assert_close(eigen.ambient(uv, wo, seen), mean.expand(20, 3), rtol=1e-5, atol=1e-6)


def test_seen_from_near_a_texture_is_read_at_the_point(rng):
    from torchmeso.data import pyramid

    eigen = make(rng)
    uv = torch.rand(30, 2, dtype=torch.float64, generator=rng)
    wi, wo = normalize(torch.rand(2, 30, 3, dtype=torch.float64, generator=rng) + 0.3).unbind(0)
    seen = pyramid.footprint(wo, torch.full((30,), 0.01, dtype=torch.float64))
    torch.testing.assert_close(eigen.evaluate(uv, wi, wo, seen), eigen.evaluate(uv, wi, wo), **FLOAT64)
    torch.testing.assert_close(eigen.ambient(uv, wo, seen), eigen.ambient(uv, wo), **FLOAT64)
