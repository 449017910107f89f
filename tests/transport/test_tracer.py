import math

import pytest
import torch

from torchmeso.errors import ShapeError
from torchmeso.geometry.directions import from_angles, normalize
from torchmeso.meso import generators
from torchmeso.transport.materials import Palette
from torchmeso.transport.tracer import Geometry, MeshTracer, TileTracer

GREY = Palette(albedo=torch.tensor([[0.5] * 3, [0.2, 0.4, 0.6]]), alpha=torch.ones(2), f0=torch.zeros(2, 3))


def down(n, rng, steepest=89.0):
    theta = torch.rand(n, generator=rng) * math.radians(steepest)
    return -from_angles(theta, torch.rand(n, generator=rng) * 2 * math.pi)


def start(n, rng):
    return torch.cat([torch.rand(n, 2, generator=rng) * 6 - 3, torch.full((n, 1), 1e-5)], 1)


def copies(geometry, reach):
    """The tile laid out over a large field: the finite stand-in."""
    pieces = [
        geometry.vertices + torch.tensor([float(i), float(j), 0.0])
        for i in range(-reach, reach)
        for j in range(-reach, reach)
    ]
    n = len(geometry.vertices)
    faces = torch.cat([geometry.faces + k * n for k in range(len(pieces))])
    return Geometry(
        vertices=torch.cat(pieces), faces=faces, part=geometry.part.repeat(len(pieces)), palette=geometry.palette
    )


def test_endless_sheet_at_grazing_angles(rng):
    meso = generators.sheet(h=0.1)
    d = down(2000, rng, 89.9)
    surface = TileTracer(meso.geometry, meso.h).trace(start(2000, rng), d)
    assert surface.hit.all()
    torch.testing.assert_close(surface.t, (0.1 + 1e-5) / -d[:, 2], rtol=2e-5, atol=0)
    assert ((surface.position[:, :2] >= -1e-3) & (surface.position[:, :2] <= 1 + 1e-3)).all()


@pytest.mark.parametrize("name", ["brick", pytest.param("weave", marks=pytest.mark.slow), "spheres", "groove"])
def test_wrapping_equals_many_copies(name, rng):
    meso = generators.GENERATORS[name]()
    o, d = start(4000, rng), down(4000, rng, 80)
    tile = TileTracer(meso.geometry, meso.h).trace(o, d)
    field = MeshTracer(copies(meso.geometry, 6)).trace(o, d)
    assert (tile.hit == field.hit).all()
    wrong = (tile.t - field.t).abs() > 1e-4
    assert wrong.float().mean() <= 1e-3  # rays that graze an edge
    same = ~wrong
    assert (tile.material.albedo - field.material.albedo).abs()[same].amax(-1).gt(1e-3).float().mean() <= 2e-3
    assert (tile.normal - field.normal).abs()[same].amax(-1).gt(1e-3).float().mean() <= 2e-3


@pytest.mark.parametrize("name", ["brick", "spheres"])
def test_shadow_rays_agree_with_first_hits(name, rng):
    meso = generators.GENERATORS[name]()
    tracer = TileTracer(meso.geometry, meso.h)
    surface = tracer.trace(start(3000, rng), down(3000, rng, 85))
    out = -down(3000, rng, 89)
    origin = tracer.leave(surface)
    blocked = tracer.occluded(origin, out, torch.full((3000,), torch.inf))
    assert (blocked == tracer.trace(origin, out).hit).all()
    t = tracer.trace(origin, out).t
    assert not tracer.occluded(origin, out, t * 0.999)[blocked].any()
    assert tracer.occluded(origin, out, t * 1.001)[blocked].all()


def test_level_rays_end(rng):
    meso = generators.brick()
    tracer = TileTracer(meso.geometry, meso.h)
    o = torch.tensor([[0.5, 0.5, -1e-6], [0.25, 0.0, -0.09]])
    d = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    surface = tracer.trace(o, d)
    assert torch.isfinite(surface.position).all()


def test_normals_face_the_ray(rng):
    meso = generators.weave()
    d = down(1000, rng)
    surface = TileTracer(meso.geometry, meso.h).trace(start(1000, rng), d)
    assert ((surface.normal * d).sum(-1)[surface.hit] <= 1e-6).all()


def test_several_geometries_keep_their_materials():
    quad = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces, part = torch.tensor([[0, 1, 2], [0, 2, 3]]), torch.zeros(2, dtype=torch.long)
    below = Geometry(vertices=quad - torch.tensor([0.0, 0, 1]), faces=faces, part=part + 1, palette=GREY)
    half = Geometry(vertices=quad * torch.tensor([0.5, 1, 1]), faces=faces, part=part, palette=GREY)
    tracer = MeshTracer(half, below)
    o = torch.tensor([[0.0, 0, 2], [0.9, 0, 2], [3.0, 0, 2]])
    d = torch.tensor([[0.0, 0, -1]]).expand(3, 3)
    surface = tracer.trace(o, d)
    assert surface.hit.tolist() == [True, True, False]
    assert torch.allclose(surface.material.albedo[:2], GREY.albedo)
    hits, owner = tracer.first_hits(o, d)
    assert owner[:2].tolist() == [0, 1]
    assert hits.face[2] == -1


def test_albedo_map_is_looked_up_at_the_vertex_uv():
    quad = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    picture = torch.zeros(8, 8, 3)
    picture[:4] = 1  # the top half, v > 0.5
    white = Palette(albedo=torch.ones(1, 3), alpha=torch.ones(1), f0=torch.zeros(1, 3))
    for uv, expected in ((None, [0.0, 1.0]), (quad[:, :2].flip(1), [1.0, 0.0])):
        g = Geometry(
            vertices=quad,
            faces=torch.tensor([[0, 1, 2], [0, 2, 3]]),
            part=torch.zeros(2, dtype=torch.long),
            palette=white,
            albedo_map=picture,
            uv=uv if uv is not None else quad[:, :2].contiguous(),
        )
        surface = MeshTracer(g).trace(
            torch.tensor([[0.75, 0.25, 1], [0.25, 0.75, 1]]), torch.tensor([[0.0, 0, -1]] * 2)
        )
        assert surface.material.albedo[:, 0].tolist() == expected


def test_rays_leave_surfaces_cleanly(rng):
    meso = generators.spheres()
    tracer = TileTracer(meso.geometry, meso.h)
    surface = tracer.trace(start(3000, rng), down(3000, rng, 30))
    again = tracer.trace(tracer.leave(surface), surface.normal)
    assert not (again.hit & (again.t < 1e-3)).any()


@pytest.mark.errors
def test_mismatched_geometry_is_refused():
    with pytest.raises(ShapeError, match=r"geometry\.part: expected shape \(1\)"):
        Geometry(
            vertices=normalize(torch.rand(3, 3)),
            faces=torch.tensor([[0, 1, 2]]),
            part=torch.zeros(2, dtype=torch.long),
            palette=GREY,
        )
