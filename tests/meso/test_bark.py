"""Bark against the one Voronoi diagram that is known by hand, and the laws of a tile."""

import pytest
import torch

from tests.meso.looks import wrong
from torchmeso.data.address import texel_centres
from torchmeso.errors import ConfigError
from torchmeso.meso import bark as bark_module
from torchmeso.meso import generators
from torchmeso.meso.bake_mdf import RayCastMdf


def test_one_plate_is_a_square_around_its_point():
    """One feature point per tile: edges lie half a tile from it, the profile is a smooth step over `fissure`."""
    meso = generators.bark(columns=1, rows=1, warp=0.0, grain=0.0, fissure=0.3, h=0.2, texels=48, seed=2)
    point = torch.rand(1, 1, 2, generator=torch.Generator().manual_seed(2))[0, 0].double()
    uv = texel_centres(48, 48).reshape(-1, 2).double()
    offset = (uv - point + 0.5) % 1 - 0.5
    t = ((0.5 - offset.abs().amax(-1)) / 0.3).clamp(max=1)
    rise = 3 * t**2 - 2 * t**3
    D = RayCastMdf(meso).evaluate(uv, torch.tensor([0.0, 0, 1], dtype=torch.float64).expand(len(uv), 3))
    assert wrong(D, 0.2 * (1 - rise), 1e-4) == 0


def test_edges_are_as_near_as_the_nearest_bisector(rng):
    """Against every feature point of many copies, by brute force."""
    point = torch.rand(3, 4, 2, generator=rng, dtype=torch.float64)
    place = torch.rand(500, 2, generator=rng, dtype=torch.float64) * torch.tensor([4.0, 3.0])
    cell = torch.cartesian_prod(torch.arange(-4, 8), torch.arange(-3, 6))
    site = cell + point[cell[:, 1] % 3, cell[:, 0] % 4]
    d2 = (place[:, None] - site).square().sum(-1)
    own = d2.argmin(1)
    bisector = (d2 - d2.amin(1, keepdim=True)) / (2 * (site - site[own][:, None]).norm(dim=-1)).clamp(min=1e-12)
    bisector[torch.arange(500), own] = torch.inf
    edge, plate = bark_module._voronoi(place, point)
    torch.testing.assert_close(edge, bisector.amin(1), rtol=0, atol=1e-12)
    assert (plate == cell[own, 1] % 3 * 4 + cell[own, 0] % 4).all()


def test_borders_join():
    """Steps across the border are no larger than the largest inside."""
    field = generators.bark(texels=64).geometry
    z = field.vertices[:, 2].reshape(65, 65)
    assert torch.equal(z[0], z[-1])
    assert torch.equal(z[:, 0], z[:, -1])
    assert float((z[:, 63] - z[:, 64]).abs().max()) <= float(z.diff(dim=1)[:, :63].abs().max())
    assert float((z[63] - z[64]).abs().max()) <= float(z.diff(dim=0)[:63].abs().max())


def test_fissures_are_dark_and_the_seed_decides():
    a, b, again = (generators.bark(texels=64, seed=k).geometry for k in (1, 2, 1))
    assert torch.equal(a.vertices, again.vertices)
    assert not torch.equal(a.vertices, b.vertices)
    colour, z = a.albedo_map, a.vertices[:, 2].reshape(65, 65)[:64, :64]
    assert colour is not None
    assert colour[z < -0.12].mean() < 0.5 * colour[z > -0.04].mean()


@pytest.mark.errors
def test_impossible_bark_is_refused():
    with pytest.raises(ConfigError, match=r"bark\.grain: expected a value from 0 to 0\.9"):
        generators.bark(grain=1.0)
    with pytest.raises(ConfigError, match=r"bark\.texels"):
        generators.bark(texels=2)
