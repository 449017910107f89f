import math

import pytest
import torch

from tests.render.scenes import camera, moved, scene
from torchmeso.data.mdf import Mdf
from torchmeso.geometry import frames, hemisphere, mesh, shapes
from torchmeso.meso import bake_mdf, generators
from torchmeso.meso.bake_mdf import MdfOptions, RayCastMdf
from torchmeso.render.frame import FrameOptions, render
from torchmeso.render.rasterize import rasterize
from torchmeso.render.scene import assemble, interpolate, rays
from torchmeso.render.silhouette import find_candidates, find_intervals, nearest

BARE, PAPER, CURVED = (FrameOptions(silhouette=s, shadows=False) for s in ("none", "paper", "curved"))


def intervals_of(subject, view):
    world = assemble(subject)
    layers = rasterize(view, world.vertices, world.faces)
    return world, layers, *find_intervals(layers, world)


def test_every_fragment_of_a_convex_body_opens_or_closes_one_interval():
    subject = scene(shapes.sphere(triangles=500))
    _, layers, found, single = intervals_of(subject, camera((0, 0, 4)))
    assert len(single) == 0
    assert 2 * len(found.pixel) == len(layers.t)
    assert (layers.pixel[found.front] == found.pixel).all()
    assert (layers.t[found.front] <= layers.t[found.back]).all()


def test_intervals_are_formed_per_component():
    """Two spheres that overlap: their intervals overlap too, none is cut short by the other."""
    subject = scene(shapes.sphere(triangles=500), moved(shapes.sphere(triangles=500), z=0.7))
    _, layers, found, _ = intervals_of(subject, camera((0, 0, 6)))
    centre = found.pixel == 32 * 64 + 32
    length = layers.t[found.back[centre]] - layers.t[found.front[centre]]
    assert length.tolist() == pytest.approx([2, 2], abs=0.05)


def test_eye_inside_has_no_front():
    subject = scene(shapes.sphere(triangles=500))
    found = intervals_of(subject, camera((0, 0, 0.2), (0, 0, 5)))[2]
    assert (found.front == -1).all()
    assert len(found.pixel) == 64 * 64
    picture = render(subject, camera((0, 0, 0.2), (0, 0, 5)), PAPER)
    assert (picture.owner == -2).all()
    assert (picture.rgb == 0).all()
    assert picture.counts["pixels inside an object"] == 64 * 64


def test_a_cavity_does_not_split_the_interval_around_it():
    """A ball with a hole in it: the hole is a component of its own that bounds no matter, so it opens nothing."""
    outer, inner = shapes.sphere(radius=1.0, triangles=3000), shapes.sphere(radius=0.5, triangles=3000)
    vertices = torch.cat([outer.vertices, inner.vertices])
    faces = torch.cat([outer.faces, inner.faces.flip(1) + len(outer.vertices)])
    shell = mesh.dress(vertices, faces, torch.cat([outer.uv, inner.uv]))
    _, layers, found, _ = intervals_of(scene(shell), camera((0, 0, 5)))
    centre = found.pixel == 32 * 64 + 32
    assert len(shell.closed) == 2
    assert (layers.pixel == 32 * 64 + 32).sum() == 4
    assert (layers.t[found.back[centre]] - layers.t[found.front[centre]]).tolist() == pytest.approx([2], abs=0.02)


def test_open_surfaces_are_single_layers():
    _, layers, found, single = intervals_of(scene(shapes.plane()), camera((0, 2, 2)))
    assert len(found.pixel) == 0
    assert len(single) == len(layers.t)


@pytest.mark.parametrize("name", ["brick", "weave"])
def test_length_bound_skips_only_intervals_that_hit(name):
    """The mask equals the formula written out for every interval."""
    meso = generators.GENERATORS[name]()
    subject = scene(shapes.torus(tiles=(6, 2), triangles=800), mdf=RayCastMdf(meso))
    view = camera((0, 2.2, 3.2))
    world, layers, found, _ = intervals_of(subject, view)

    def depth(fragment, turn):
        points = interpolate(world, layers, view, fragment)
        w = frames.to_local(points.frame, turn * rays(view, layers.pixel[fragment], layers.t.dtype)[1])
        return points.scale * RayCastMdf(meso).evaluate(points.uv, w)

    expected = depth(found.front, -1) + depth(found.back, 1) <= layers.t[found.back] - layers.t[found.front]
    candidates, counts = find_candidates(subject, world, view, layers, "paper")
    assert set(candidates.fragment.tolist()) == set(found.front[expected].tolist())
    assert 0 < counts.skipped < counts.intervals
    assert counts.carved == int((~expected).sum()) > 0


def test_no_hit_passes_everything_and_none_stays():
    views = hemisphere.grid(4, 2, 87.5)
    nothing = Mdf(
        delta=torch.zeros(8, 2, 2), no_hit=torch.ones(8, 2, 2, dtype=torch.bool), directions=views, h=0.1
    )  # fmt: skip
    subject = scene(shapes.sphere(triangles=500), mdf=nothing)
    for options in (PAPER, CURVED):
        assert (render(subject, camera((0, 0, 4)), options).owner == -1).all()
    assert (render(subject, camera((0, 0, 4)), BARE).owner == 0).any()


def carved_rows(view_options, *, depth=0.1):
    """Carve a flat sheet of world depth `depth` into a cylinder of radius 1; return what is left of it in world units.

    The view is parallel, across the axis, 0.4 wide around the outline.
    """
    height = 2 * math.pi / 8 * 3
    body = shapes.cylinder(radius=1.0, height=height, tiles=(8, 3), triangles=60_000)
    h = depth / (2 * math.pi / 8)
    subject = scene(body, mdf=RayCastMdf(generators.sheet(h=h)))
    view = camera((0.98, 0, 4), (0.98, 0, 0), projection="orthographic", view_height=0.4)
    seen = render(subject, view, view_options).owner[20:44] >= 0
    return 0.78 + 0.4 / 64 * float(seen.double().sum(1).mean())


def test_paper_carves_half_of_a_sheet():
    """Its planar ends see twice the true penetration: h/2 is carved where the truth is h."""
    pixel = 0.4 / 64
    assert carved_rows(BARE) == pytest.approx(1.0, abs=pixel)
    assert carved_rows(PAPER) == pytest.approx(1 - 0.1 / 2, abs=pixel)


def test_curved_carves_all_of_a_sheet():
    assert carved_rows(CURVED) == pytest.approx(1 - 0.1, abs=0.4 / 64)


def test_table_and_rays_agree_on_the_silhouette():
    meso = generators.brick()
    table = bake_mdf.in_memory(meso, MdfOptions(texels=128))
    view = camera((0, 2.2, 3.2), size=200)
    body = shapes.torus(tiles=(3, 1), triangles=2000)
    bare = render(scene(body), view, BARE).owner >= 0
    for options in (PAPER, CURVED):
        carved = [bare & (render(scene(body, mdf=m), view, options).owner < 0) for m in (table, RayCastMdf(meso))]
        assert (carved[0] & carved[1]).sum() / (carved[0] | carved[1]).sum() > 0.9


def test_depth_of_what_is_seen_is_the_front_plus_the_drop():
    """A sheet at h: every pixel of an open plane lies h / cos behind the plane."""
    floor = shapes.plane(size=(2, 2), tiles=(4, 4))
    view = camera((0, 2, 1), (0, 0, 0))
    shallow = render(scene(floor), view, PAPER).depth
    deep = render(scene(floor, mdf=RayCastMdf(generators.sheet(h=0.2))), view, PAPER).depth
    cosine = -view.rays(view.pixel_centres())[1][..., 1]
    seen = shallow.isfinite()
    torch.testing.assert_close((deep - shallow)[seen], (0.2 * 0.5 / cosine)[seen], rtol=1e-3, atol=1e-5)


def test_open_surface_without_a_hit_ends_at_the_bottom():
    """A no-hit entry of a floor counts as delta = 1: its shadow look-up point stays in the slab."""
    views = hemisphere.grid(4, 2, 87.5)
    nothing = Mdf(
        delta=torch.zeros(8, 2, 2), no_hit=torch.ones(8, 2, 2, dtype=torch.bool), directions=views, h=0.2
    )  # fmt: skip
    floor = shapes.plane(size=(2, 2), tiles=(4, 4))
    view = camera((0, 2, 0.01))
    depth = render(scene(floor, mdf=nothing), view, PAPER).depth[32, 32]
    assert float(depth) == pytest.approx(2 + 0.2 * 0.5, abs=1e-3)


def test_nearest_takes_the_least_depth_and_breaks_ties_by_fragment():
    subject = scene(shapes.sphere(triangles=500), moved(shapes.sphere(triangles=500), z=0.5))
    view = camera((0, 0, 6))
    world = assemble(subject)
    layers = rasterize(view, world.vertices, world.faces)
    candidates, _ = find_candidates(subject, world, view, layers, "none")
    first = nearest(candidates, candidates.depth)
    pixel = candidates.pixel[first]
    assert len(pixel) == len(set(candidates.pixel.tolist()))
    assert torch.equal(candidates.fragment[first], layers.start[pixel])
