import math

import pytest
import torch

from torchmeso.data import mdf as mdf_data
from torchmeso.data.mdf import MIN_COS
from torchmeso.errors import ConfigError, SizeError
from torchmeso.geometry import hemisphere
from torchmeso.geometry.directions import from_angles
from torchmeso.meso import bake_mdf, generators
from torchmeso.meso.bake_mdf import MdfOptions, RayCastMdf

SMALL = MdfOptions(texels=16, views="grid(6, 4, 87.5)")


def test_sheet_table_is_exact_everywhere(rng):
    """The closed form holds to the last ring, below it, and at every texel: the drop is 1."""
    mdf = bake_mdf.in_memory(generators.sheet(h=0.1), SMALL)
    assert (mdf.delta == 255).all()
    theta = torch.linspace(0, 1.7, 200, dtype=torch.float64)
    wo = from_angles(theta, torch.full_like(theta, 1.0))
    D = mdf.evaluate(torch.rand(200, 2, generator=rng, dtype=torch.float64), wo)
    torch.testing.assert_close(D, 0.1 / wo[:, 2].clamp(min=MIN_COS), rtol=1e-6, atol=0)


@pytest.mark.parametrize("name", ["groove", "spheres", "brick", "weave"])
def test_table_equals_the_ray_cast_at_its_samples(name, rng):
    meso = generators.GENERATORS[name]()
    mdf = bake_mdf.in_memory(meso, SMALL)
    caster = RayCastMdf(meso)
    from torchmeso.data.address import texel_centres

    uv = texel_centres(16, 16).reshape(-1, 2)
    for v in (0, 9, 23):
        wo = hemisphere.parse(SMALL.views).directions()[v].expand(len(uv), 3)
        delta = caster.evaluate(uv, wo) * wo[:, 2] / meso.h
        assert (mdf.delta[v].flatten().float() / 255 - delta).abs().max() <= 0.501 / 255


def test_error_falls_with_the_resolution(rng):
    meso = generators.spheres()
    caster = RayCastMdf(meso)
    theta = torch.rand(4000, generator=rng, dtype=torch.float64) * math.radians(80)
    wo = from_angles(theta, torch.rand(4000, generator=rng, dtype=torch.float64) * 6.28).float()
    uv = torch.rand(4000, 2, generator=rng)
    exact = caster.evaluate(uv, wo) * wo[:, 2] / meso.h
    errors = []
    for texels, views in ((16, "grid(6, 4, 87.5)"), (32, "grid(12, 8, 87.5)"), (64, "grid(24, 16, 87.5)")):
        mdf = bake_mdf.in_memory(meso, MdfOptions(texels=texels, views=views))
        errors.append(float((mdf.drop(uv, wo)[0] - exact).abs().mean()))
    assert errors[2] < errors[1] < errors[0]
    assert errors[2] < 0.45 * errors[0]


def test_holes_are_marked():
    mdf = bake_mdf.in_memory(generators.weave(width=0.6, backing=False), SMALL)
    assert mdf.no_hit is not None
    assert (mdf.delta[mdf.no_hit] == 0).all()
    assert 0 < mdf.no_hit[0].float().mean() < 0.3


def test_cut_off_bake_goes_on_with_the_same_bits(tmp_path):
    meso = generators.brick()
    whole, resumed = tmp_path / "whole.mdf.zarr", tmp_path / "resumed.mdf.zarr"
    bake_mdf.bake(meso, SMALL, whole, about={"source": "test"})

    def stop_early(share):
        if share > 0.4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bake_mdf.bake(meso, SMALL, resumed, about={"source": "test"}, progress=stop_early)
    assert not resumed.exists()
    shares = []
    bake_mdf.bake(meso, SMALL, resumed, about={"source": "test"}, progress=shares.append)
    assert shares[-1] == 1
    a, b = mdf_data.load(whole), mdf_data.load(resumed)
    assert torch.equal(a.delta, b.delta)
    assert torch.equal(a.delta, bake_mdf.in_memory(meso, SMALL).delta)
    assert (a.h, a.directions) == (b.h, b.directions)


@pytest.mark.parametrize("storage", ["float16", "float32"])
def test_float_storage(tmp_path, storage):
    options = MdfOptions(texels=8, views="grid(4, 2, 87.5)", storage=storage)
    bake_mdf.bake(generators.brick(), options, tmp_path / "a.mdf.zarr", about={})
    assert mdf_data.load(tmp_path / "a.mdf.zarr").delta.dtype == getattr(torch, storage)


@pytest.mark.errors
def test_absurd_sizes_are_refused():
    with pytest.raises(SizeError, match=r"bake\.mdf: needs 48\.8 GiB of memory, the limit is 8\.0 GiB; lower"):
        MdfOptions(texels=8359)
    with pytest.raises(ConfigError, match=r"bake\.mdf\.texels"):
        MdfOptions(texels=0)
