import pytest
import torch

from torchmeso.geometry import shapes, shell
from torchmeso.geometry.directions import normalize
from torchmeso.geometry.rays import RayScene
from torchmeso.geometry.shell import BORDER, BOTTOM, TOP
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.meso.displace import displace
from torchmeso.render import gdm_trace
from torchmeso.render.gdm_trace import Entries


def rays_into(built, base, n, rng, *, onto="faces"):
    """Rays that come in through random points of the boundary, or exactly through its edges or vertices."""
    bound = shell.boundary(built, base=base)
    k = torch.randint(len(bound.faces), (n,), generator=rng)
    share = torch.rand(n, 3, generator=rng, dtype=torch.float64)
    if onto == "edges":
        share[:, 0] = 0
    if onto == "vertices":
        share[:, :2] = 0
    share = share / share.sum(1, keepdim=True)
    corner = built.vertices[bound.faces[k]]
    point = (share[..., None] * corner).sum(1)
    normal = normalize(torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    w = normalize(torch.randn(n, 3, generator=rng, dtype=torch.float64))
    w = torch.where((w * normal).sum(-1, keepdim=True) > 0, -w, w)
    return Entries(point - 0.2 * w, w, bound.tet[k], bound.corner[k]), point, normal


@pytest.mark.parametrize("onto", ["faces", "edges", "vertices"])
@pytest.mark.parametrize("name", ["torus", "plane"])
def test_every_ray_comes_out_again(name, onto, rng):
    body = shapes.torus(triangles=300, tiles=(6, 2)) if name == "torus" else shapes.plane(triangles=50, tiles=(3, 3))
    built = shell.build(body, 0.2)
    entries, _, _ = rays_into(built, "open", 4000, rng, onto=onto)
    found = gdm_trace.trace(built, None, entries, floor=False)
    assert not found.hit.any()
    assert torch.isin(found.through, torch.tensor([TOP, BOTTOM, BORDER])).all()
    assert (found.prisms < 200).all()
    assert torch.isfinite(found.place).all()


def test_rays_leave_where_the_boundary_is_met_next(rng):
    """Against Embree on the boundary: the first surface behind the entry."""
    built = shell.build(shapes.torus(triangles=300, tiles=(6, 2)), 0.2)
    entries, point, normal = rays_into(built, "open", 6000, rng)
    steep = (entries.direction * normal).sum(-1) < -0.05
    entries = Entries(*(x[steep] for x in entries[:4]))
    point = point[steep]
    found = gdm_trace.trace(built, None, entries, floor=False)
    bound = shell.boundary(built, base="open")
    scene = RayScene(built.vertices.float(), bound.faces)
    w = entries.direction
    hits = scene.first_hit((point + 1e-4 * w).float(), w.float())
    t = hits.t.double() + 0.2 + 1e-4
    assert ((found.t - t).abs() < 2e-4).double().mean() > 0.999


def test_flat_ground_is_one_look_up_from_top_to_bottom(rng):
    """On a plane texture space is the world: a ray meets what the table says, however many prisms it passes."""
    body = shapes.plane(size=(8.0, 8.0), tiles=(8, 8), triangles=200)
    meso = generators.spheres()
    gdm = bake_gdm.in_memory(meso, GdmOptions(texels=24, layers=9, n_theta=12, n_phi=24))
    built = shell.build(body, meso.h)
    bound = shell.boundary(built)
    top = (bound.kind == TOP).nonzero()[:, 0]
    k = top[torch.randint(len(top), (1500,), generator=rng)]
    share = torch.rand(1500, 3, generator=rng, dtype=torch.float64)
    point = ((share / share.sum(1, keepdim=True))[..., None] * built.vertices[bound.faces[k]]).sum(1)
    inner = (point.abs() < 2.5).all(1)
    k, point = k[inner], point[inner]
    w = normalize(torch.randn(len(k), 3, generator=rng, dtype=torch.float64) * torch.tensor([1.0, 0.2, 1.0]))
    w[:, 1] = -w[:, 1].abs() - 0.4
    w = normalize(w)
    found = gdm_trace.trace(built, gdm, Entries(point - w, w, bound.tet[k], bound.corner[k]))
    assert found.hit.all()
    first = gdm_trace.trace(built, None, Entries(point - w, w, bound.tet[k], bound.corner[k]))
    way = normalize(first.place - torch.stack([point[:, 0], -point[:, 2], torch.zeros(len(k))], -1) - _origin(body))
    torch.testing.assert_close(way, first.direction, rtol=0, atol=1e-6)
    caster = bake_gdm.RayCastGdm(meso, 1.0)
    back = found.place[:, 2] / found.direction[:, 2]  # to the top, along the way
    on_top = found.place - back[:, None] * found.direction
    t, _ = caster.cast(on_top.float(), found.direction.float(), torch.zeros(len(k), dtype=torch.bool))
    error = (back - t.double().clamp(max=10)).abs() * 24
    assert error.median() < 0.5
    assert error.quantile(0.9) < 2.5


def _origin(body):
    """Texture coordinates of the world's origin, in the plane's own order of axes."""
    middle = body.uv.double().mean(0)
    return torch.tensor([float(middle[0]), float(middle[1]), 0.0], dtype=torch.float64)


def test_a_dressed_torus_is_hit_where_its_real_triangles_are(rng):
    body = shapes.torus(triangles=600, tiles=(6, 3))
    meso = generators.brick()
    gdm = bake_gdm.in_memory(meso, GdmOptions(texels=24, layers=9, n_theta=12, n_phi=24))
    built = shell.build(body, meso.h)
    entries, _, _ = rays_into(built, "solid", 4000, rng)
    found = gdm_trace.trace(built, gdm, entries)
    truth = displace(body, meso)
    hits = RayScene(truth.vertices, truth.faces).first_hit(entries.origin.float(), entries.direction.float())
    # A ray that comes in once more elsewhere is another entry's business.
    inside = found.hit | (hits.t > found.t + 1e-3)
    assert inside.double().mean() > 0.97
    both = found.hit & (hits.face >= 0) & (hits.t.double() > 0.2 - 1e-4)
    voxel = float(body.scale.mean()) / 24
    error = (found.t - hits.t.double()).abs()[both] / voxel
    assert error.median() < 0.3
    assert error.quantile(0.9) < 2
