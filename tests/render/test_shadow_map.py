import math

import pytest
import torch

from tests.render.scenes import camera, moved, scene, sun
from torchmeso.geometry import mesh, shapes
from torchmeso.geometry.light import DirectionalLight, PointLight, SpotLight
from torchmeso.meso import generators
from torchmeso.meso.bake_mdf import RayCastMdf
from torchmeso.render import shadow_map
from torchmeso.render.frame import FrameOptions, render
from torchmeso.render.scene import assemble
from torchmeso.render.shadow_map import Above

WHITE = torch.full((3,), 10.0)


def blocked(subject, light, positions, *, size=256, silhouette="curved"):
    world = assemble(subject)
    return shadow_map.blocked(
        shadow_map.build(subject, world, light, size=size, silhouette=silhouette), torch.as_tensor(positions)
    )


def floor_points(half=2.0, n=200):
    x = (torch.arange(n) + 0.5) / n * 2 * half - half
    grid = torch.stack(torch.meshgrid(x, x, indexing="xy"), -1).reshape(-1, 2)
    return torch.stack([grid[:, 0], torch.zeros(len(grid)), grid[:, 1]], -1)


def ball_on_floor(mdf=None):
    return scene(moved(shapes.sphere(radius=0.5, triangles=5000), y=1.0), shapes.plane(size=(4, 4)), mdf=mdf)


LAMPS = {
    "directional": (sun(0, 1, 0), 0.5),
    "point": (PointLight(position=torch.tensor([0.0, 4, 0]), intensity=WHITE), 4 * math.tan(math.asin(0.5 / 3))),
    "spot": (
        SpotLight(
            position=torch.tensor([0.0, 4, 0]),
            axis=torch.tensor([0.0, -1, 0]),
            intensity=WHITE,
            inner_deg=30,
            outer_deg=40,
        ),
        4 * math.tan(math.asin(0.5 / 3)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", LAMPS)
def test_shadow_of_a_ball_is_a_disc_of_the_right_size(name):
    light, radius = LAMPS[name]
    points = floor_points(1.5)
    got = blocked(ball_on_floor(), light, points, size=512)
    expected = points[:, [0, 2]].norm(dim=-1) < radius
    assert (got & expected).sum() / (got | expected).sum() > 0.95


@pytest.mark.parametrize("theta_deg", [0, 40, 75, 85])
@pytest.mark.parametrize("size", [32, 256])
def test_a_plane_never_shadows_itself(theta_deg, size):
    theta = math.radians(theta_deg)
    # Beside and below it a ball at either end, so that the map covers all of it.
    balls = [moved(shapes.sphere(radius=0.1, triangles=64), x=x, y=-0.2, z=x) for x in (-2.2, 2.2)]
    subject = scene(shapes.plane(size=(4, 4), triangles=200), *balls)
    assert not blocked(subject, sun(math.sin(theta), math.cos(theta), 0.2), floor_points(1.9), size=size).any()


@pytest.mark.parametrize("side", [4, 40, 4000])
def test_a_wide_floor_takes_no_texels_from_the_shadow_on_it(side):
    ball = moved(shapes.sphere(radius=0.5, triangles=5000), y=1.0)
    points = floor_points(1.5)
    got = blocked(scene(ball, shapes.plane(size=(side, side), tiles=(1, 1))), sun(0, 1, 0), points, size=128)
    expected = points[:, [0, 2]].norm(dim=-1) < 0.5
    shared = (got & expected).sum() / (got | expected).sum()
    assert shared > (0.95 if side < 100 else 0.2)  # the ball is 1/4000 of the last: as fine as float32 allows


def test_sheets_shadow_one_another():
    """Neither has a depth of its own."""
    awning = moved(shapes.plane(size=(1, 1)), y=1.0)
    points = floor_points(1.5)
    got = blocked(scene(shapes.plane(size=(8, 8)), awning), sun(0, 1, 0), points)
    expected = (points[:, [0, 2]].abs() < 0.5).all(-1)
    assert (got != expected).float().mean() < 0.02


@pytest.mark.parametrize("kind", ["directional", "point", "spot"])
def test_a_ball_shadows_only_its_far_side(kind, rng):
    """No acne: what faces the light, but for two texels at the terminator, is lit; the far side is not."""
    at = torch.tensor([1.0, 3.0, 2.0])
    lamps = {
        "directional": DirectionalLight(direction=at / at.norm(), irradiance=WHITE),
        "point": PointLight(position=at, intensity=WHITE),
        "spot": SpotLight(position=at, axis=-at / at.norm(), intensity=WHITE, inner_deg=20, outer_deg=25),
    }
    body = shapes.sphere(triangles=20_000)
    centre = body.vertices[body.faces].mean(1)
    normal = torch.nn.functional.normalize(centre, dim=-1)
    to_light = at - centre if kind != "directional" else at.expand_as(centre)
    cosine = (normal * torch.nn.functional.normalize(to_light, dim=-1)).sum(-1)
    got = blocked(scene(body), lamps[kind], centre, size=512)
    assert not got[cosine > 0.12].any()
    assert got[cosine < -0.2].all()


def test_the_shadow_starts_where_the_ball_touches_the_floor():
    """No peter-panning: beside the point of contact the floor is dark within two texels and the ball's own curve."""
    subject = scene(moved(shapes.sphere(radius=0.5, triangles=20_000), y=0.5), shapes.plane(size=(4, 4)))
    light = sun(1, 1, 0)
    x = torch.linspace(-1.2, 1.2, 400)
    got = blocked(subject, light, torch.stack([x, torch.zeros(400), torch.zeros(400)], -1), size=384)
    # The ball's shadow on the line z = 0 runs from where the light grazes it to the other side: centre -0.5.
    edges = (-0.5 - 0.5 * math.sqrt(2), -0.5 + 0.5 * math.sqrt(2))
    expected = (x > edges[0]) & (x < edges[1])
    wrong = (got != expected).nonzero()[:, 0]
    assert all(min(abs(float(x[i]) - e) for e in edges) < 0.02 for i in wrong)


def test_shadow_silhouettes_follow_the_mesostructure():
    """A sheet of world depth d on the ball: its shadow is a disc of radius r - d."""
    ball = moved(shapes.sphere(radius=0.5, tiles=(12, 6), triangles=20_000), y=1.0)
    scale = float(ball.scale[(ball.vertices[:, 1] - 1).abs() < 0.05].mean())
    sheet = RayCastMdf(generators.sheet(h=0.2))
    points = floor_points(1.0, 300)
    radius = points[:, [0, 2]].norm(dim=-1)
    subject = scene(ball, shapes.plane(size=(4, 4)), mdf=sheet)
    light = sun(0.0, 1.0, 0.0)
    bare = blocked(subject, light, points, silhouette="none", size=128)
    carved = blocked(subject, light, points, silhouette="curved", size=128)
    assert float(radius[bare].max()) == pytest.approx(0.5, abs=0.02)
    assert float(radius[carved].max()) < 0.5 - 0.5 * 0.2 * scale
    assert (bare | ~carved).all()


def test_a_thin_blocker_keeps_its_shadow():
    """A slab of depth far larger than the body: the shadow starts no later than the body's back."""
    sheet = RayCastMdf(generators.weave(h=0.3))
    ball = moved(shapes.sphere(radius=0.2, tiles=(2, 1), triangles=5000), y=0.6)
    subject = scene(ball, shapes.plane(size=(4, 4)), mdf=sheet)
    below = torch.tensor([[0.0, 0.0, 0.0]])
    assert blocked(subject, sun(0, 1, 0), below, silhouette="none").all()
    assert blocked(subject, sun(0, 1, 0), below, silhouette="paper").all()


def test_point_light_sees_in_all_directions():
    """A small ball on each side of a lamp shadows what lies behind it."""
    for axis in range(3):
        for sign in (-1.0, 1.0):
            place = torch.zeros(3)
            place[axis] = sign
            subject = scene(moved(shapes.sphere(radius=0.2, triangles=500), *place.tolist()))
            lamp = PointLight(position=torch.zeros(3), intensity=WHITE)
            got = blocked(subject, lamp, torch.stack([2 * place, -2 * place, 0.5 * place]))
            assert got.tolist() == [True, False, False]


def test_light_inside_a_body_lights_its_surroundings():
    subject = scene(shapes.sphere(radius=0.5, triangles=500), moved(shapes.sphere(radius=0.2, triangles=500), x=2.0))
    lamp = PointLight(position=torch.zeros(3), intensity=WHITE)
    points = torch.tensor([[1.0, 0, 0], [3.0, 0, 0]])
    assert blocked(subject, lamp, points).tolist() == [False, True]


def test_mesostructured_plane_is_lit_all_over():
    """Receivers at the depth of the material see the light: nothing of the floor's own slab shadows it."""
    subject = scene(
        shapes.plane(size=(4, 4), tiles=(8, 8)), mdf=RayCastMdf(generators.brick()), lights=(sun(1, 2, 0.5),)
    )
    picture = render(subject, camera((0, 3, 2), fov_deg=35), FrameOptions(shadow_map_size=256))
    assert not picture.shadowed.any()


def test_a_point_sunk_beyond_a_crease_is_as_dark_as_its_surface():
    """Inside of a ring, close to where light passes it by: what lies a little deeper lies where the ring has no gap."""
    subject, light = scene(shapes.torus(tube=0.3, triangles=20_000)), sun(1, 0, 0)
    world = assemble(subject)
    shadow = shadow_map.build(subject, world, light, size=512, silhouette="curved")
    surface = torch.tensor([[-0.118, 0, 0.69], [1.083, 0, 0.72]])  # behind the gap; on the side of the light
    sunk = torch.tensor([[-0.12, 0, 0.72], [1.06, 0, 0.72]])
    lean = torch.tensor([0.5, 0.9])
    assert shadow_map.blocked(shadow, surface).tolist() == [True, False]
    assert shadow_map.blocked(shadow, sunk).tolist() == [False, False]
    assert shadow_map.blocked(shadow, sunk, above=Above(surface, lean)).tolist() == [True, False]


@pytest.mark.parametrize("size", [16, 32, 64, 512])
def test_no_light_comes_through_a_gap_that_is_finer_than_a_texel(size):
    """The same ring, whose gap coarse maps do not show; a shadow would first start on a sheet in its body."""
    sheet = mesh.transform(shapes.plane(size=(0.2, 0.2)), torch.tensor(
        [[0, 1, 0, -0.3], [1, 0, 0, 0], [0, 0, -1, 0.8], [0, 0, 0, 1.0]]
    ))  # fmt: skip
    subject, light = scene(shapes.torus(tube=0.3, triangles=20_000), sheet), sun(1, 0, 0)
    shadow = shadow_map.build(subject, assemble(subject), light, size=size, silhouette="curved")
    surface = torch.tensor([[-0.118, 0, 0.69], [1.08, 0, 0.72]])
    sunk = torch.tensor([[-0.12, 0, 0.75], [1.06, 0, 0.72]])
    for position in (surface, sunk):
        above = Above(surface, torch.tensor([0.5, 0.9]))
        assert shadow_map.blocked(shadow, position, above=above).tolist() == [True, False]
