import pytest
import torch

from tests.render.scenes import camera, scene, sun
from tests.tolerances import FLOAT32
from torchmeso.data.mdf import Mdf
from torchmeso.errors import ConfigError, ShapeError
from torchmeso.geometry import hemisphere, mesh, shapes
from torchmeso.geometry.light import PointLight
from torchmeso.meso import generators
from torchmeso.meso.bake_mdf import RayCastMdf
from torchmeso.render.rasterize import rasterize
from torchmeso.render.scene import DistanceFunction, Material, Object, Scene, assemble, interpolate, rays


def test_assembled_meshes_keep_their_arrays():
    a, b = shapes.sphere(triangles=200), shapes.plane(triangles=8)
    world = assemble(scene(a, b))
    assert len(world.faces) == len(a.faces) + len(b.faces)
    assert torch.equal(world.vertices[world.faces[: len(a.faces)]], a.vertices[a.faces])
    assert torch.equal(world.vertices[world.faces[len(a.faces) :]], b.vertices[b.faces])
    assert world.owner.tolist() == [0] * len(a.faces) + [1] * len(b.faces)
    assert world.closed.tolist() == [True, False]
    assert world.component.max() == 1


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_fragments_lie_on_the_rays_and_on_the_surface(projection):
    """Sphere: positions have length 1, and the frame's normal is the position."""
    subject = scene(shapes.sphere(triangles=20_000))
    view = camera((1, 2, 3), projection=projection)
    world = assemble(subject)
    layers = rasterize(view, world.vertices, world.faces)
    which = torch.arange(len(layers.t))
    points = interpolate(world, layers, view, which)
    torch.testing.assert_close(points.position.norm(dim=-1), torch.ones(len(which)), rtol=2e-3, atol=0)
    torch.testing.assert_close(points.frame.n, points.position, rtol=0, atol=0.02)
    assert (points.owner == 0).all()


def test_texture_coordinates_are_perspective_correct():
    """On a plane, uv is a known function of the position, at every fragment."""
    plane = shapes.plane(size=(2, 2), tiles=(4, 4))
    view = camera((0.3, 0.4, 1.5))
    world = assemble(scene(plane))
    layers = rasterize(view, world.vertices, world.faces)
    points = interpolate(world, layers, view, torch.arange(len(layers.t)))
    x, y, z = points.position.unbind(-1)
    # Vertices are snapped to 1/256 pixel, so the ray of a pixel meets the snapped plane a little off.
    torch.testing.assert_close(points.uv, torch.stack([(x + 1) * 2, (1 - z) * 2], -1), rtol=0, atol=0.02)
    torch.testing.assert_close(points.frame.t, torch.tensor([1.0, 0, 0]).expand_as(points.frame.t), **FLOAT32)
    torch.testing.assert_close(points.scale, torch.full_like(points.scale, 0.5), **FLOAT32)
    assert y.abs().max() < 0.01


def test_selected_points_are_the_same_points():
    world = assemble(scene(shapes.sphere(triangles=200)))
    view = camera((0, 0, 3))
    layers = rasterize(view, world.vertices, world.faces)
    points = interpolate(world, layers, view, torch.arange(len(layers.t)))
    some = points.select(torch.tensor([5, 3]))
    assert torch.equal(some.uv, points.uv[[5, 3]])
    assert torch.equal(some.frame.b, points.frame.b[[5, 3]])


def test_rays_go_through_pixel_centres():
    view = camera((0, 0, 3), size=5)
    _, direction, _ = rays(view, torch.tensor([12]), torch.float32)
    torch.testing.assert_close(direction[0], torch.tensor([0.0, 0, -1]), **FLOAT32)


def test_both_kinds_of_distance_answer_the_protocol():
    views = hemisphere.grid(4, 2, 87.5)
    table = Mdf(delta=torch.zeros(8, 2, 2), no_hit=None, directions=views, h=0.1)
    for mdf in (table, RayCastMdf(generators.sheet())):
        assert isinstance(mdf, DistanceFunction)


@pytest.mark.errors
def test_scenes_nobody_can_render_are_refused():
    with pytest.raises(ConfigError, match="at least one object"):
        Scene(objects=(), lights=(sun(0, 0, 1),))
    with pytest.raises(ConfigError, match=r"scene\.ambient_rule: expected 'add' or 'paper', got 'either'"):
        Scene(objects=scene(shapes.plane()).objects, lights=(), ambient_rule="either")


def test_a_body_of_several_materials_stays_whole():
    body = shapes.sphere(triangles=200)
    part = (body.vertices[body.faces].mean(1)[:, 1] > 0).long()
    red, blue = Material(albedo=(1.0, 0.0, 0.0)), Material(albedo=(0.0, 0.0, 1.0))
    two = Object(mesh=body, material=red, others=(blue,), part=part)
    subject = Scene(objects=(Object(mesh=shapes.plane(), material=blue), two), lights=())
    world = assemble(subject)
    assert subject.surfaces == (blue, red, blue)
    assert world.object.tolist() == [0, 1, 1]
    assert torch.equal(world.owner[2:], part + 1)
    assert world.closed.tolist() == [False, True]


@pytest.mark.errors
def test_faces_without_a_material_are_refused():
    body = shapes.sphere(triangles=200)
    n = len(body.faces)
    with pytest.raises(ConfigError, match=r"object\.part: expected a value from 0 to 0, got 1"):
        Object(mesh=body, material=Material(), part=torch.ones(n, dtype=torch.long))
    with pytest.raises(ShapeError, match=rf"object\.part: expected shape \({n}\), got \(3,\)"):
        Object(mesh=body, material=Material(), part=torch.zeros(3, dtype=torch.long))


def far_away(subject, distance):
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[0, 3] = matrix[2, 3] = distance
    return mesh.transform(subject, matrix)


def test_a_scene_far_away_has_an_origin_of_its_own():
    body = shapes.sphere(triangles=200)
    home, far = assemble(scene(body)), assemble(scene(far_away(body, 1e6)))
    assert not home.origin.any()
    assert far.vertices.dtype == torch.float32
    assert far.origin.tolist() == [1e6, 0, 1e6]
    torch.testing.assert_close(far.vertices, home.vertices, rtol=0, atol=1e-6)


def test_camera_and_lights_come_along():
    world = assemble(scene(far_away(shapes.sphere(triangles=200), 1e6)))
    view = camera((1e6, 0, 1e6 + 3), at=(1e6, 0, 1e6))
    lamp = PointLight(position=torch.tensor([1e6 + 1, 2, 1e6], dtype=torch.float64), intensity=torch.ones(3))
    light = sun(0, 1, 0)
    assert world.seen_by(view).eye.tolist() == [0, 0, 3]
    moved = world.lit_by((lamp, light))
    assert moved[0].position.tolist() == [1, 2, 0]
    assert moved[1] is light


@pytest.mark.errors
def test_light_that_is_no_number_is_refused():
    body = shapes.sphere(triangles=200)
    with pytest.raises(ConfigError, match=r"scene.ambient: expected a value from 0 to 1e\+20, got nan"):
        scene(body, ambient=float("nan"))
    with pytest.raises(ConfigError, match=r"scene\.background"):
        Scene(objects=scene(body).objects, lights=(), background=(0.0, float("inf"), 0.0))
