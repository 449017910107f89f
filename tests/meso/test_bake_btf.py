import math

import pytest
import torch

from torchmeso.data import btf as btf_data
from torchmeso.errors import ConfigError, SizeError
from torchmeso.geometry import hemisphere
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions

SMALL = BtfOptions(texels=8, lights="grid(4, 2, 70)", views="grid(3, 2, 60)", samples=1, bounces=0)
LIGHTS = hemisphere.parse(SMALL.lights)


def with_options(**changes):
    from dataclasses import replace

    return replace(SMALL, **changes)


def test_flat_sheet_is_albedo_times_cosine():
    btf = bake_btf.in_memory(generators.sheet(albedo=(0.2, 0.4, 0.8)), SMALL)
    cosine = LIGHTS.directions()[:, 2]
    expected = cosine[:, None, None, None, None] * torch.tensor([0.2, 0.4, 0.8])
    torch.testing.assert_close(btf.pictures(), expected.expand_as(btf.pictures()), rtol=1e-4, atol=1e-6)


def test_groove_bottom_is_dark_behind_its_wall():
    """Light from +u at theta = 52.5 (ring 1 of 2 at 70): the strip next to the right wall is in shadow."""
    btf = bake_btf.in_memory(generators.groove(h=0.1, width=0.5), with_options(texels=32, lights="grid(4, 1, 52.5)"))
    row = btf.pictures()[0, 0, 16, :, 0]  # light phi = 0, nearly straight view
    u = (torch.arange(32) + 0.5) / 32
    reach = 0.1 * math.tan(math.radians(52.5))
    view_shift = 0.1 * math.tan(math.radians(hemisphere.parse(SMALL.views).theta_deg[0]))
    bottom = u - view_shift  # where a ray through u meets the bottom
    lit = (bottom > 0.25) & (bottom < 0.75 - reach - 0.04) & (u < 0.75)
    dark = (bottom > 0.75 - reach + 0.04) & (u < 0.74)
    assert lit.any()
    assert dark.any()
    assert (row[lit] > 0.25).all()
    assert (row[dark] == 0).all()


def test_interreflection_lights_the_shadow():
    meso = generators.groove(h=0.2, width=0.5, albedo=(0.8, 0.8, 0.8))
    direct = bake_btf.in_memory(meso, with_options(lights="grid(4, 1, 60)", samples=16))
    bounced = bake_btf.in_memory(meso, with_options(lights="grid(4, 1, 60)", samples=16, bounces=3))
    assert (bounced.pictures() >= direct.pictures() - 1e-6).all()
    assert bounced.pictures().mean() > direct.pictures().mean() * 1.02


def test_cut_off_bake_goes_on_with_the_same_bits(tmp_path):
    meso, options = generators.weave(segments=8), with_options(bounces=1)
    whole, resumed = tmp_path / "whole.btf.zarr", tmp_path / "resumed.btf.zarr"
    bake_btf.bake(meso, options, whole, about={"source": "test"})

    def stop_early(share):
        if share >= 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bake_btf.bake(meso, options, resumed, about={"source": "test"}, progress=stop_early)
    assert not resumed.exists()
    bake_btf.bake(meso, options, resumed, about={"source": "test"})
    a, b = btf_data.load(whole), btf_data.load(resumed)
    assert torch.equal(a.pictures(), b.pictures())
    torch.testing.assert_close(a.pictures().float(), bake_btf.in_memory(meso, options).pictures(), rtol=1e-3, atol=1e-6)


def test_more_samples_average_the_footprint():
    """The mean over a texture of fine samples equals that of coarse ones; the edges get grey."""
    fine = bake_btf.in_memory(generators.brick(), with_options(samples=144)).pictures()
    coarse = bake_btf.in_memory(generators.brick(), with_options(samples=49)).pictures()
    assert float(fine.mean()) == pytest.approx(float(coarse.mean()), rel=5e-2)


def test_view_through_a_hole_is_black():
    btf = bake_btf.in_memory(generators.weave(width=0.5, backing=False), with_options(texels=16))
    assert (btf.pictures()[:, 0].amax(0) == 0).any()


@pytest.mark.errors
def test_absurd_sizes_are_refused():
    with pytest.raises(SizeError, match=r"bake\.btf: needs .* GiB of memory, the limit is 64\.0 GiB; lower bake"):
        BtfOptions(texels=2048)
    with pytest.raises(ConfigError, match=r"bake\.btf\.bounces"):
        with_options(bounces=-1)
