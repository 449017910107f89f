import math

import pytest
import torch

from tests.tolerances import FLOAT64
from torchmeso.bench import vdm
from torchmeso.bench.vdm import VdmOptions
from torchmeso.geometry import shapes
from torchmeso.geometry.directions import from_angles
from torchmeso.meso import generators
from torchmeso.meso.bake_gdm import RayCastGdm


def angles(*deg):
    return torch.tensor(deg, dtype=torch.float64).deg2rad()


def test_a_bent_way_is_that_around_a_circle():
    """A ray at 60 degrees to a circle of radius 1/2, and inside of one: by plane geometry."""
    tau = torch.linspace(0, 0.4, 9, dtype=torch.float64)
    theta, radius = math.radians(60), 0.5
    x, y = tau * math.sin(theta), -tau * math.cos(theta)
    for sign in (1, -1):
        s, z = vdm.bent(tau, torch.full_like(tau, math.cos(theta)), torch.full_like(tau, sign / radius))
        from_centre = torch.stack([x, y + sign * radius], -1)
        r = from_centre.norm(dim=-1)
        torch.testing.assert_close(z, sign * (r - radius), **FLOAT64)
        torch.testing.assert_close(s, radius * torch.atan2(x, sign * from_centre[:, 1]), **FLOAT64)


def test_a_way_through_the_slab_ends_at_its_bottom_or_top():
    cosine, c = torch.meshgrid(angles(0, 20, 60, 80, 87).cos(), torch.linspace(-4, 4, 9).double(), indexing="ij")
    end, out = vdm.through(0.16, cosine, c)
    _, z = vdm.bent(end, cosine, c)
    torch.testing.assert_close(z, torch.where(out, 0.0, -0.16).double(), rtol=0, atol=1e-6)
    assert out[-1, -1]
    assert not out[:, :5].any()


def test_a_sheet_is_met_where_the_bent_slab_ends():
    """A sheet at the bottom and no other material: the closed form of the way through."""
    meso = generators.sheet(h=0.1)
    found = vdm.bake(meso, VdmOptions(texels=2, views="grid(4, 4, 80)", curvatures=5, most=4.0))
    cosine = found.views.directions(torch.float64)[:, 2]
    c = torch.linspace(-4, 4, 5, dtype=torch.float64)
    end, out = vdm.through(0.1, cosine[None, :], c[:, None])
    assert torch.equal(found.left[..., 0, 0], out)
    torch.testing.assert_close(found.way[..., 1, 1].double(), torch.where(out, 0, end), rtol=2e-3, atol=1e-3)


def test_a_flat_surface_is_asked_as_a_ray_is_cast(rng):
    meso = generators.weave()
    caster = RayCastGdm(meso, 1.0)
    uv = torch.rand(2000, 2, generator=rng).double()
    wo = from_angles(
        torch.rand(2000, generator=rng).double() * 1.2, 2 * math.pi * torch.rand(2000, generator=rng).double()
    )
    way = vdm.cast(caster, uv, wo, torch.zeros(2000, dtype=torch.float64))
    top = torch.cat([uv, torch.zeros(2000, 1)], 1).float()
    t, _ = caster.cast(top, -wo.float(), torch.zeros(2000, dtype=torch.bool))
    t = torch.minimum(t.double(), meso.h / wo[:, 2])
    assert ((way - t).abs() < 1e-3).double().mean() > 0.995  # but for rays along an edge


def test_samples_are_what_is_asked_for(rng):
    meso = generators.weave()
    table = vdm.bake(meso, VdmOptions(texels=8, views="grid(6, 3, 75)", curvatures=3, most=2.0))
    uv = vdm.texel_centres(8, 8, torch.float64).reshape(-1, 2)
    for view, wo in enumerate(table.views.directions(torch.float64)):
        for k, c in enumerate((-2.0, 0.0, 2.0)):
            found = table.evaluate(uv, wo.expand(64, 3), torch.full((64,), c, dtype=torch.float64))
            right = torch.where(table.left[k, view], torch.inf, table.way[k, view].double()).flatten()
            torch.testing.assert_close(found.way, right, rtol=1e-6, atol=1e-6)


def test_curvatures_of_a_sphere_and_a_torus():
    ball = shapes.sphere(radius=2.0, triangles=8000, tiles=(8, 4))
    found = vdm.curvature(ball) / ball.scale[:, None]
    middle = ball.vertices[:, 1].abs() < 1.5
    expected = torch.tensor([0.5, 0.0, 0.5], dtype=torch.float64).expand(int(middle.sum()), 3)
    torch.testing.assert_close(found[middle], expected, rtol=0, atol=0.02)
    ring = shapes.torus(radius=1.0, tube=0.4, triangles=20000, tiles=(5, 2))
    found = vdm.curvature(ring) / ring.scale[:, None]
    inner = ring.vertices[:, [0, 2]].norm(dim=1) < 0.601
    expected = torch.tensor([-1 / 0.6, 0.0, 1 / 0.4], dtype=torch.float64).expand(int(inner.sum()), 3)
    torch.testing.assert_close(found[inner], expected, rtol=0, atol=0.05)


def test_curvature_along_a_direction():
    matrix = torch.tensor([3.0, 0.0, 1.0], dtype=torch.float64)
    w = from_angles(angles(50, 50, 50), angles(0, 45, 90))
    torch.testing.assert_close(vdm.along(matrix.expand(3, 3), w), torch.tensor([3.0, 2.0, 1.0]).double(), **FLOAT64)


def test_a_slab_without_a_bottom_is_refused():
    with pytest.raises(ValueError, match="curvatures below"):
        vdm.bake(generators.sheet(h=0.5), VdmOptions(most=4.0))
