import pytest
import torch

from tests.render.scenes import camera, scene
from torchmeso.data.mdf import Mdf
from torchmeso.geometry import hemisphere, shapes
from torchmeso.geometry.rays import RayScene
from torchmeso.meso import generators
from torchmeso.meso.bake_mdf import RayCastMdf
from torchmeso.meso.displace import displace
from torchmeso.render import curved_silhouette
from torchmeso.render.frame import FrameOptions, render
from torchmeso.render.rasterize import rasterize
from torchmeso.render.scene import assemble
from torchmeso.render.silhouette import find_intervals

BARE, PAPER, CURVED = (FrameOptions(silhouette=s, shadows=False) for s in ("none", "paper", "curved"))


def masks(body, meso, view):
    """Return the pixels of the bare mesh that each test, and the displaced mesh, remove."""
    bare = render(scene(body), view, BARE).owner >= 0
    subject = scene(body, mdf=RayCastMdf(meso))
    truth = displace(body, meso, max_edge=0.1)
    origin, direction, _ = view.rays(view.pixel_centres().reshape(-1, 2))
    hit = RayScene(truth.vertices, truth.faces).first_hit(origin, direction).face >= 0
    carved = [bare & (render(subject, view, options).owner < 0) for options in (PAPER, CURVED)]
    return *carved, bare & ~hit.reshape(bare.shape)


def iou(a, b):
    return float((a & b).sum() / (a | b).sum())


@pytest.mark.parametrize(
    ("name", "tiles", "least"), [("brick", (3, 1), 0.9), pytest.param("weave", (6, 2), 0.88, marks=pytest.mark.slow)]
)
def test_closer_to_the_displaced_mesh_than_the_paper(name, tiles, least):
    body = shapes.torus(tiles=tiles, triangles=3000)
    paper, curved, truth = masks(body, generators.GENERATORS[name](), camera((0, 2.2, 3.2), size=200))
    assert truth.sum() > 100
    assert iou(curved, truth) > iou(paper, truth) + 0.05
    assert iou(curved, truth) > least


def test_sheet_on_a_sphere_is_a_smaller_sphere():
    """Depth h everywhere, so the silhouette is the sphere of radius 1 - h s (flat facets: a little less)."""
    body = shapes.sphere(radius=1.0, tiles=(12, 6), triangles=20_000)
    subject = scene(body, mdf=RayCastMdf(generators.sheet(h=0.15)))
    view = camera((0, 0, 5), projection="orthographic", view_height=2.2, size=200)
    seen = (render(subject, view, CURVED).owner >= 0).sum()
    row = render(subject, view, CURVED).owner[100] >= 0  # the equator, where the texture has one scale
    scale = float(body.scale[body.vertices[:, 1].abs() < 0.05].mean())
    assert float(row.sum()) * 2.2 / 200 == pytest.approx(2 * (1 - 0.15 * scale), abs=2 * 2.2 / 200)
    assert seen > 0


def ends(body, view):
    world = assemble(scene(body))
    layers = rasterize(view, world.vertices, world.faces)
    found, _ = find_intervals(layers, world)
    front = curved_silhouette.end(world, view, layers, found.front, front=True)
    back = curved_silhouette.end(world, view, layers, found.back, front=False)
    return front, back, layers.t[found.back] - layers.t[found.front], found


def test_ends_of_a_sphere_are_alike():
    """Cosines are sqrt(1 - r^2) on both sides, the normals turn by 1 / radius along the tangent part of the ray."""
    view = camera((0, 0, 5), projection="orthographic", view_height=2.2)
    front, back, length, _ = ends(shapes.sphere(triangles=40_000), view)
    inner = length > 0.5
    torch.testing.assert_close(front.cosine[inner], length[inner] / 2, rtol=0.02, atol=0.01)
    torch.testing.assert_close(back.cosine[inner], length[inner] / 2, rtol=0.02, atol=0.01)
    sine2 = 1 - front.cosine[inner].square()
    torch.testing.assert_close(front.curvature[inner].median(), sine2.median(), rtol=0.05, atol=0.01)
    assert (front.bulge >= 0).all()
    assert front.bulge.max() < 1e-2


def test_deep_intervals_are_not_marched():
    view = camera((0, 0, 5), projection="orthographic", view_height=2.2)
    front, back, length, _ = ends(shapes.sphere(triangles=5000), view)
    mdf = RayCastMdf(generators.sheet(h=0.1))
    meeting = curved_silhouette.meet(front, back, length, mdf)
    assert meeting.hit[~meeting.marched].all()
    # Below the sphere a chord of length L is 1 - sqrt(1 - L^2/4) deep.
    deep = 1 - (1 - (length.clamp(max=2) / 2).square()).sqrt() > 0.1 * front.scale * 1.1
    assert not meeting.marched[deep].any()
    assert meeting.marched.sum() > 20


def test_meeting_place_lies_on_the_relief():
    """A sheet half-way down the slab, under a sphere: where the march stops, the chord is as deep as the sheet."""
    view = camera((0, 0, 5), projection="orthographic", view_height=2.2, size=128)
    front, back, length, _ = ends(shapes.sphere(triangles=40_000), view)
    views = hemisphere.grid(4, 2, 87.5)
    mdf = Mdf(delta=torch.full((8, 2, 2), 0.5), no_hit=None, directions=views, h=0.2)
    meeting = curved_silhouette.meet(front, back, length, mdf)
    # A chord of length L of the unit sphere is 1 - sqrt(1 - L^2/4 + (L/2 - t)^2) deep at t.
    to_axis = (1 - (length / 2).square()).clamp(min=0)
    depth = 1 - (to_axis + (length / 2 - meeting.at).square()).sqrt()
    which = meeting.hit & meeting.marched
    assert which.sum() > 50
    assert (depth - 0.1 * (front.scale + back.scale) / 2)[which].abs().max() < 0.01


def test_nothing_to_test():
    view = camera((0, 0, 5), (0, 0, 9))
    front, back, length, _ = ends(shapes.sphere(triangles=500), view)
    assert len(curved_silhouette.meet(front, back, length, RayCastMdf(generators.sheet())).hit) == 0
