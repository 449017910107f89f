import math

import pytest
import torch

from torchmeso.data import relief
from torchmeso.data.mdf import MIN_COS
from torchmeso.data.relief import REFINEMENT, Relief
from torchmeso.geometry.directions import from_angles
from torchmeso.meso import bake_mdf, generators
from torchmeso.meso.bake_mdf import MdfOptions, RayCastMdf


def tent(x):
    """A roof that repeats: 0 at whole numbers, 0.25 half-way."""
    return 0.5 * (x - x.round()).abs()


def centres(n):
    return (torch.arange(n, dtype=torch.float64) + 0.5) / n


@pytest.mark.parametrize("shift", [0.013, 0.02, 0.04])
def test_refinement_is_exact_on_planes_and_where_they_meet(shift):
    coarse, fine = tent(centres(16) + shift), tent(centres(16 * REFINEMENT) + shift)
    got = relief.refine(coarse[None].expand(16, 16), REFINEMENT)
    # Edges midway between two texels are cut off at the texels' height: nothing is ever refined beyond its neighbours.
    plain = torch.nn.functional.interpolate(
        torch.cat([coarse[-1:], coarse, coarse[:1]])[None, None], scale_factor=REFINEMENT, mode="linear"
    )[0, 0, REFINEMENT:-REFINEMENT]
    assert (got[0] - fine).abs().max() <= (plain - fine).abs().max() + 1e-12
    assert (got[0] - fine).abs().mean() < 0.5 * (plain - fine).abs().mean() + 1e-12


def test_refinement_stays_between_its_neighbours(rng):
    z = torch.rand(9, 9, generator=rng)
    fine = relief.refine(z, REFINEMENT)
    assert fine.min() >= z.min()
    assert fine.max() <= z.max()


def test_flat_relief_is_h_over_cosine():
    flat = Relief(drop=torch.full((8, 8), 0.2), hole=None, h=0.3)
    theta = torch.linspace(0, 1.5, 40)
    wo = from_angles(theta, theta * 3)
    D = flat.march(torch.rand(40, 2), wo, MIN_COS)
    torch.testing.assert_close(D, 0.2 / wo[:, 2], rtol=2e-3, atol=0)


def test_marching_finds_what_the_table_cannot(rng):
    """Rays close to the horizon run along the joints of bricks, between two azimuths of the table."""
    meso = generators.brick()
    mdf = bake_mdf.in_memory(meso, MdfOptions(texels=128, views="grid(15, 10, 87.5)"))
    theta = math.radians(70) + torch.rand(4000, generator=rng) * math.radians(18)
    wo = from_angles(theta, torch.rand(4000, generator=rng) * 2 * math.pi)
    uv = torch.rand(4000, 2, generator=rng)
    exact = RayCastMdf(meso).evaluate(uv, wo) * wo[:, 2]
    marched = (mdf.distance(uv, wo) * wo[:, 2] - exact).abs()
    table = (mdf.evaluate(uv, wo) * wo[:, 2] - exact).abs()
    assert marched.mean() < 0.5 * table.mean()
    assert (marched > 0.02).float().mean() < 0.03


def test_depth_is_the_view_from_above():
    meso = generators.spheres()
    mdf = bake_mdf.in_memory(meso, MdfOptions(texels=128))
    uv = torch.rand(3000, 2, generator=torch.Generator().manual_seed(1))
    error = (mdf.depth(uv) - RayCastMdf(meso).depth(uv)).abs()
    assert error.median() < 0.002
    assert (error > 0.02).float().mean() < 0.03  # the rims of the spheres, a jump of the depth


def test_no_ray_leaks_through_a_floor_at_the_bottom(rng):
    mdf = bake_mdf.in_memory(generators.brick(), MdfOptions(texels=32))
    theta = torch.rand(5000, generator=rng) * 1.55
    wo = from_angles(theta, torch.rand(5000, generator=rng) * 6.3)
    assert torch.isfinite(mdf.distance(torch.rand(5000, 2, generator=rng), wo)).all()


def test_holes_let_rays_through():
    hole = torch.zeros(8, 8, dtype=torch.bool)
    hole[:, :4] = True
    half = Relief(drop=torch.full((8, 8), 0.1), hole=hole, h=0.1 * 1.001)
    uv = torch.tensor([[0.25, 0.5], [0.75, 0.5]])
    assert half.depth(uv).tolist() == pytest.approx([math.inf, 0.1])
    down = torch.tensor([[0.0, 0.0, 1.0]]).expand(2, 3)
    assert half.march(uv, down, MIN_COS).isinf().tolist() == [True, False]


def test_open_weave_keeps_its_holes():
    mdf = bake_mdf.in_memory(generators.weave(width=0.6, backing=False), MdfOptions(texels=32))
    assert mdf.relief.hole is not None
    assert 0.03 < mdf.relief.hole.float().mean() < 0.3
