from dataclasses import fields, replace

import pytest
import torch

from tests.render.scenes import LIGHTS, camera, moved, patched
from torchmeso.backends import opencl
from torchmeso.compress import double_sh, eigen, sh_pca
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.data.textured import Textured
from torchmeso.geometry import mesh, shapes
from torchmeso.geometry.light import SpotLight
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions
from torchmeso.render import frame
from torchmeso.render.frame import FrameOptions, Skips
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Material, Object, Scene, in_double


def compare(scene, view, options):
    """Both pictures, and at how many pixels they differ by more than 1/255."""
    exact, fast = frame.render(scene, view, options), Renderer(scene, options).render(view)
    differs = (exact.rgb - fast.rgb).abs().amax(-1) > 1 / 255
    return exact, fast, int(differs.sum())


@pytest.mark.parametrize("silhouette", ["none", "paper", "curved"])
@pytest.mark.parametrize("light", LIGHTS)
def test_the_same_picture_as_torch(silhouette, light, still_life, device):
    scene = Scene(objects=still_life, lights=LIGHTS[light], background=(0.1, 0.2, 0.3))
    view = camera((1.5, 2.0, 3.5), size=96)
    exact, fast, wrong = compare(scene, view, FrameOptions(silhouette=silhouette, shadow_map_size=128))
    assert wrong <= 4  # decisions on their threshold
    assert (exact.owner != fast.owner).sum() <= 2
    assert (exact.shadowed != fast.shadowed).sum() <= 4
    near = (exact.depth - fast.depth).abs() <= 1e-4 * exact.depth
    assert (~near & exact.depth.isfinite()).sum() <= 4
    assert exact.counts["pixels with a fragment"] == fast.counts["pixels with a fragment"]
    if silhouette != "none":  # without depth, triangles turned away are not drawn
        assert exact.counts["fragments"] == fast.counts["fragments"]
        assert exact.counts["layers"] == fast.counts["layers"]
        assert 0 < fast.counts["intervals"] <= exact.counts["intervals"]  # those behind a resolved pixel are skipped


@pytest.fixture
def processor(request, monkeypatch):
    """A processor that has no more than these instructions."""
    kept = tuple(x for x in request.param if x in opencl._instructions())
    opencl._program.cache_clear()
    monkeypatch.setattr(opencl, "_instructions", lambda: kept)
    yield kept
    opencl._program.cache_clear()


@pytest.mark.parametrize("processor", [(), opencl.AVX512], ids=["plain", "avx512"], indirect=True)
@pytest.mark.parametrize("silhouette", ["paper", "curved"])
def test_the_same_picture_on_an_older_processor(silhouette, processor, still_life, device):
    scene = Scene(objects=still_life, lights=LIGHTS["spot"])
    options = FrameOptions(silhouette=silhouette, shadow_map_size=64)
    exact, fast, wrong = compare(scene, camera((1.5, 2.0, 3.5), size=64), options)
    assert wrong <= 3
    assert (exact.shadowed != fast.shadowed).sum() <= 3


def test_the_same_picture_as_torch_in_float64(still_life, device):
    scene = Scene(objects=still_life, lights=LIGHTS["spot"])
    view, options = camera((1.5, 2.0, 3.5), size=160), FrameOptions(shadow_map_size=256)
    exact, fast = frame.render(in_double(scene), view, options), Renderer(scene, options).render(view)
    assert exact.rgb.dtype == exact.depth.dtype == torch.float64
    assert ((exact.rgb - fast.rgb).abs().amax(-1) > 1 / 255).double().mean() <= 5e-4


@pytest.mark.parametrize("rule", ["add", "paper"])
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_both_cameras_and_ambient_rules(rule, projection, still_life, device):
    scene = Scene(objects=still_life, lights=LIGHTS["sun"], ambient=0.3, ambient_rule=rule)
    view = camera((1.5, 2.0, 3.5), size=64, projection=projection, view_height=4.0)
    assert compare(scene, view, FrameOptions(shadow_map_size=128))[2] <= 3


@pytest.mark.parametrize("silhouette", ["paper", "curved"])
def test_an_eye_inside_a_body_and_under_the_floor(silhouette, still_life, device):
    scene = Scene(objects=still_life, lights=LIGHTS["sun"])
    for eye in ((0.0, 0.3, 0.9), (0.0, 0.4, 0.1), (0.0, -2.0, 0.5)):
        exact, fast, wrong = compare(scene, camera(eye, at=(0.1, 0.0, 0.0)), FrameOptions(silhouette=silhouette))
        assert wrong <= 4
        assert torch.equal(exact.owner == -2, fast.owner == -2)


@pytest.mark.parametrize("storage", ["uint8", "float16", "float32"])
def test_every_storage_of_maps(storage, device):
    table = bake_btf.in_memory(
        generators.brick(), BtfOptions(texels=8, lights="ubo81", views="grid(6, 3, 80)", samples=1, bounces=0)
    )
    material = Material(btf=eigen.fit(table, EigenOptions(rank=9, storage=storage)))
    objects = (Object(mesh=shapes.sphere(triangles=500), material=material),)
    assert compare(Scene(objects=objects, lights=LIGHTS["sun"]), camera((0, 0, 4)), FrameOptions())[2] == 0


def test_what_a_screen_shows(still_life, device):
    renderer = Renderer(Scene(objects=still_life, lights=LIGHTS["sun"]), FrameOptions(shadow_map_size=128))
    view = camera((1.5, 2.0, 3.5))
    shown = renderer.show(view).clone()
    picture = renderer.render(view)
    linear = picture.rgb.clamp(0, 1)
    srgb = torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    assert (shown[..., :3].float() - 255 * srgb).abs().max() <= 0.51 + 0.01
    assert torch.equal(shown[..., 3] == 255, picture.owner != -1)


def test_frame_after_frame(still_life, device):
    """A picture does not depend on the ones before it."""
    options = FrameOptions(shadow_map_size=128)
    scene = Scene(objects=still_life, lights=LIGHTS["sun"])
    renderer = Renderer(scene, options)
    views = [camera((1.5, 2.0, 3.5)), camera((-3, 1, 1)), camera((0, 9, 0.1), size=40), camera((1.5, 2.0, 3.5))]
    for view in views:
        assert torch.equal(renderer.render(view).rgb, Renderer(scene, options).render(view).rgb)
    for light in ("point", "spot", "sun"):
        other = replace(scene, lights=LIGHTS[light])
        mine, fresh = renderer.render(views[0], LIGHTS[light]), Renderer(other, options).render(views[0])
        assert torch.equal(mine.rgb, fresh.rgb)


@pytest.mark.parametrize("silhouette", ["none", "curved"])
def test_more_layers_than_there_was_room_for(silhouette, brick, device):
    """Six bodies one in the other: eye and light both ask for more room, and draw again."""
    body = shapes.sphere(triangles=300)
    sizes = [torch.diag(torch.tensor([s, s, s, 1.0])) for s in (1.0, 0.9, 0.8, 0.7, 0.6, 0.5)]
    objects = tuple(Object(mesh=mesh.transform(body, m), material=brick) for m in sizes)
    scene = Scene(objects=objects, lights=LIGHTS["sun"])
    options = FrameOptions(silhouette=silhouette, shadow_map_size=256)
    exact, fast, wrong = compare(scene, camera((1.5, 1.0, 2.5), size=128), options)
    assert wrong <= 4
    assert torch.equal(exact.owner, fast.owner)


def test_shadow_maps_rest_while_the_light_does(still_life, device):
    renderer = Renderer(Scene(objects=still_life, lights=LIGHTS["sun"]), FrameOptions(shadow_map_size=128))
    renderer.render(camera((1.5, 2.0, 3.5)))
    assert renderer.counts["shadow maps drawn"] == 1
    renderer.render(camera((-3, 1, 1)))
    assert renderer.counts["shadow maps drawn"] == 0
    renderer.render(camera((-3, 1, 1)), LIGHTS["spot"])
    assert renderer.counts["shadow maps drawn"] == 2


def test_what_stops_a_resting_light_is_found_out_once(still_life, device):
    scene, options = Scene(objects=still_life, lights=LIGHTS["spot"]), FrameOptions(shadow_map_size=128)
    renderer = Renderer(scene, options)
    eyes = ((1.5, 2.0, 3.5), (-3.0, 1.0, 1.0), (1.5, 2.0, 3.5), (1.5, 2.0, 3.5))
    left_out = []
    for eye in eyes:
        mine, fresh = renderer.render(camera(eye)), Renderer(scene, options).render(camera(eye))
        assert torch.equal(mine.rgb, fresh.rgb)
        assert torch.equal(mine.shadowed, fresh.shadowed)
        left_out.append(mine.counts["shadow stamps left out"])
    assert left_out[0] > left_out[1] == left_out[2] == left_out[3] > 0
    assert left_out[0] == Renderer(scene, options).render(camera(eyes[0])).counts["shadow stamps left out"]


def test_triangles_stay_while_the_camera_does(still_life, device):
    """The light moves over them; with the eye in a body and triangles cut at the near plane too."""
    scene = Scene(objects=still_life, lights=LIGHTS["sun"])
    options = FrameOptions(shadow_map_size=128)
    for eye in ((1.5, 2.0, 3.5), (0.0, 0.3, 0.9), (0.0, 0.4, 0.1)):
        renderer = Renderer(scene, options)
        kept = []
        for light in ("sun", "point", "spot", "spot"):
            mine = renderer.render(camera(eye), LIGHTS[light])
            fresh = Renderer(scene, options).render(camera(eye), LIGHTS[light])
            assert torch.equal(mine.rgb, fresh.rgb)
            assert mine.counts["triangles drawn"] == fresh.counts["triangles drawn"]
            kept.append(mine.counts["triangles kept"])
        assert kept[3] > kept[2] == 0  # other sizes of maps make a new picture
        assert renderer.render(camera((1.0, 2.0, 3.5)), LIGHTS["spot"]).counts["triangles kept"] == 0


@pytest.mark.parametrize("filtering", [True, False])
def test_what_lies_far_away(filtering, brick, device):
    """A floor to the horizon: many texels to a pixel, long ones at the far end."""
    floor = shapes.plane(size=(60.0, 60.0), tiles=(60, 60))
    scene = Scene(objects=(Object(mesh=floor, material=brick),), lights=LIGHTS["sun"])
    view = camera((0.3, 1.0, 25.0), at=(0.0, 0.0, 10.0), size=96)
    wrong = compare(scene, view, FrameOptions(shadows=False, filtering=filtering))[2]
    assert wrong <= 4


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_jittered_frames(projection, still_life, device):
    scene = Scene(objects=still_life, lights=LIGHTS["spot"])
    view = camera((1.5, 2.0, 3.5), size=64, projection=projection, view_height=4.0)
    options = FrameOptions(shadow_map_size=128, antialias=2)
    assert compare(scene, view, options)[2] <= 8
    single = replace(options, antialias=1, filtering=False)
    renderer, shown = Renderer(scene, single), Renderer(scene, replace(options, filtering=False))
    mean = torch.stack([renderer.render(c).rgb.double() for c in view.jittered(2)]).mean(0)
    torch.testing.assert_close(shown.render(view).rgb.double(), mean, atol=1e-6, rtol=1e-6)
    assert (shown.show(view)[..., :3].float() / 255).pow(2.2).sub(mean.clamp(0, 1)).abs().mean() < 0.02


SKIPS = {
    "frustum": ("triangles beside the view", "curved"),
    "empty": ("stamps that stayed empty", "curved"),
    "hidden": ("triangles turned away", "none"),
    "behind": ("stretches behind a resolved pixel", "curved"),
    "bounds": ("intervals passed by the facets alone", "paper"),
    "plain": ("frames without silhouette code", "curved"),
    "losers": ("losing fragments not shaded", "curved"),
    "facing": ("shadow tests of what leans away", "curved"),
    "resting": ("shadow maps kept", "curved"),
    "unlit": ("lights left out", "curved"),
    "unseen": ("shadow stamps left out", "curved"),
}
"""Each skip, what counts it, and a silhouette that it works with."""


def test_every_skip_is_here():
    elsewhere = {"carried"}  # of shells; tests/render/test_gdm_shade.py
    assert set(SKIPS) | elsewhere == {f.name for f in fields(Skips)}


@pytest.mark.parametrize("name", SKIPS)
def test_a_skip_is_wired_and_changes_nothing(name, still_life, device):
    """It counts while it is on, does not while it is off, and the picture is the same bit for bit."""
    counter, silhouette = SKIPS[name]
    objects = still_life
    if name == "plain":
        objects = tuple(replace(o, material=replace(o.material, mdf=None)) for o in objects)
    # Two spheres one behind the other overlap; one object stands behind the eye; one light shines away.
    ball = shapes.sphere(radius=0.35, triangles=200)
    extra = (
        Object(mesh=moved(ball, x=0.8, y=0.3, z=0.9), material=still_life[0].material),
        Object(mesh=moved(ball, x=0.8, y=0.32, z=0.5), material=still_life[2].material),
        Object(mesh=moved(ball, x=9.0, z=9.0), material=Material()),
    )
    away = SpotLight(
        position=torch.tensor([0.0, 5.0, 0.0]), axis=torch.tensor([0.0, 1.0, 0.0]), intensity=torch.full((3,), 50.0)
    )
    scene = Scene(objects=(*objects, *extra) if name != "plain" else objects, lights=(*LIGHTS["sun"], away))
    view = camera((4.5, 6.0, 10.5), size=256) if name == "empty" else camera((1.5, 2.0, 3.5), size=160)
    pictures, shown, counts = [], [], []
    for on in (True, False):
        options = FrameOptions(silhouette=silhouette, shadow_map_size=128, skips=replace(Skips(), **{name: on}))
        renderer = Renderer(scene, options)
        renderer.show(view)
        shown.append(renderer.show(view).clone())
        counts.append(renderer.counts[counter])
        pictures.append(renderer.render(view))
    assert torch.equal(shown[0], shown[1])
    assert torch.equal(pictures[0].rgb, pictures[1].rgb)
    assert torch.equal(pictures[0].owner, pictures[1].owner)
    used, unused = counts
    assert used > unused == 0


def test_ranks_that_add_less_than_the_error(device):
    table = bake_btf.in_memory(
        generators.brick(), BtfOptions(texels=8, lights="grid(6, 3, 80)", views="grid(6, 3, 80)", samples=1, bounces=0)
    )
    material = Material(btf=eigen.fit(table, EigenOptions(rank=12)))
    scene = Scene(objects=(Object(mesh=shapes.sphere(triangles=500), material=material),), lights=LIGHTS["sun"])
    exact = Renderer(scene).render(camera((0, 0, 4)))
    assert exact.counts["groups of components spared"] == 0
    for error in (0.02, 0.2):
        rough = Renderer(scene, FrameOptions(rank_error=error)).render(camera((0, 0, 4)))
        assert rough.counts["groups of components spared"] > 0
        # Two groups can be left out, and light and ambient both read the model.
        assert (rough.rgb - exact.rgb).abs().max() <= 2 * error * (1 + scene.ambient)


@pytest.mark.parametrize("light", ["sun", "point"])
@pytest.mark.parametrize("silhouette", ["none", "paper", "curved"])
def test_bodies_of_several_materials(silhouette, light, brick, weave, device):
    """Brick, plain, the brick's depth without its colour, and a weave with holes: the same picture as torch."""
    plain, bare = Material(albedo=(0.2, 0.6, 0.3)), Material(mdf=brick.mdf, albedo=(0.6, 0.2, 0.2))
    objects = (
        patched(moved(shapes.torus(tiles=(6, 2), triangles=600), y=0.3), brick, plain, bare, height=0.2),
        patched(moved(shapes.sphere(radius=0.5, tiles=(6, 3), triangles=400), x=1.2, y=0.4), weave, brick, height=0.3),
        Object(mesh=moved(shapes.plane(size=(6.0, 6.0), tiles=(4, 4)), y=-0.6), material=brick),
    )
    scene = Scene(objects=objects, lights=LIGHTS[light])
    options = FrameOptions(silhouette=silhouette, shadow_map_size=128)
    exact, fast, wrong = compare(scene, camera((1.5, 2.0, 3.5), size=96), options)
    assert wrong <= 4
    assert (exact.owner != fast.owner).sum() <= 2
    assert set(exact.owner.unique().tolist()) == {-1, 0, 1, 2}
    assert (exact.shadowed != fast.shadowed).sum() <= 4


@pytest.mark.parametrize("silhouette", ["paper", "curved"])
def test_a_material_cut_in_two_is_still_one(silhouette, brick, device):
    """Where both parts of a body have the same material, nothing tells where one ends."""
    body = shapes.torus(tiles=(6, 2), triangles=600)
    whole = Scene(objects=(Object(mesh=body, material=brick),), lights=LIGHTS["sun"])
    parts = replace(whole, objects=(patched(body, brick, replace(brick, albedo=(1.0, 0.0, 0.0))),))
    view, options = camera((1.5, 2.0, 2.5)), FrameOptions(silhouette=silhouette, shadow_map_size=128)
    for picture in (lambda s: frame.render(s, view, options), lambda s: Renderer(s, options).render(view)):
        one, two = picture(whole), picture(parts)
        assert torch.equal(one.depth, two.depth)
        assert torch.equal(one.owner, two.owner)
        torch.testing.assert_close(one.rgb, two.rgb, rtol=0, atol=1e-5)


@pytest.mark.parametrize("rule", ["add", "paper"])
def test_pictures_of_colours_and_normals(rule, brick, device, rng):
    """Two sizes of maps, a mirrored texture, a part with depth below a normal map: the same picture as torch."""
    lean = torch.randn(7, 12, 3, generator=rng) * 0.5 + torch.tensor([0.0, 0.0, 1.0])
    looks = Material(btf=Textured(albedo=torch.rand(16, 9, 3, generator=rng), normals=lean))
    colours = Material(btf=Textured(albedo=torch.rand(8, 8, 3, generator=rng)), mdf=brick.mdf)
    body = shapes.torus(tiles=(6, 2), triangles=600)
    mirrored = mesh.dress(body.vertices, body.faces, body.uv * torch.tensor([-1.0, 1.0]))
    assert (mirrored.sign < 0).all()
    objects = (
        patched(mirrored, looks, brick, height=0.1),
        Object(mesh=moved(shapes.plane(size=(6.0, 6.0), tiles=(4, 4)), y=-0.6), material=looks),
        Object(mesh=moved(shapes.sphere(radius=0.4, triangles=300), y=0.6), material=colours),
    )
    scene = Scene(objects=objects, lights=LIGHTS["spot"], ambient=0.3, ambient_rule=rule)
    exact, fast, wrong = compare(scene, camera((1.5, 2.0, 3.5), size=96), FrameOptions(shadow_map_size=128))
    assert wrong <= 4
    alike = (exact.owner == fast.owner) & (exact.shadowed == fast.shadowed).all(0)
    assert (exact.rgb - fast.rgb)[alike].abs().quantile(0.99) < 3e-4


@pytest.mark.parametrize("storage", ["uint8", "float32"])
@pytest.mark.parametrize("rule", ["add", "paper"])
def test_spherical_harmonics(storage, rule, brick, device):
    """A double-SH BTF beside an eigen BTF, near and small in the picture: the same picture as torch."""
    table = bake_btf.in_memory(
        generators.brick(), BtfOptions(texels=16, lights="grid(8, 4, 80)", views="grid(6, 3, 80)", samples=1, bounces=0)
    )
    few = DoubleShOptions(light_terms=16, view_terms=9, storage=storage)
    smooth = Material(btf=double_sh.fit(table, few), mdf=brick.mdf)
    objects = (
        Object(mesh=shapes.torus(tiles=(6, 2), triangles=600), material=smooth),
        Object(mesh=moved(shapes.plane(size=(6.0, 6.0), tiles=(9, 9)), y=-0.6), material=smooth),
        Object(mesh=moved(shapes.sphere(radius=0.4, triangles=300), y=0.6), material=brick),
    )
    scene = Scene(objects=objects, lights=LIGHTS["spot"], ambient=0.3, ambient_rule=rule)
    exact, fast, wrong = compare(scene, camera((1.5, 2.0, 3.5), size=96), FrameOptions(shadow_map_size=128))
    assert wrong <= 4
    alike = (exact.owner == fast.owner) & (exact.shadowed == fast.shadowed).all(0)
    assert (exact.rgb - fast.rgb)[alike].abs().quantile(0.99) < 3e-4


@pytest.mark.parametrize(("storage", "rank", "views"), [("uint8", 11, "grid(6, 3, 80)"), ("float32", 3, "ubo81")])
@pytest.mark.parametrize("rule", ["add", "paper"])
def test_components_of_spherical_harmonics(storage, rank, views, rule, brick, device):
    """An SH + PCA BTF beside a double-SH and an eigen BTF, near and small in the picture: the same picture as torch."""
    table = bake_btf.in_memory(
        generators.brick(), BtfOptions(texels=16, lights="grid(8, 4, 80)", views=views, samples=1, bounces=0)
    )
    few = ShPcaOptions(rank=rank, light_terms=9, storage=storage)
    blended = Material(btf=sh_pca.fit(table, few), mdf=brick.mdf)
    smooth = Material(btf=double_sh.fit(table, DoubleShOptions(light_terms=9, view_terms=9)))
    objects = (
        Object(mesh=shapes.torus(tiles=(6, 2), triangles=600), material=blended),
        Object(mesh=moved(shapes.plane(size=(6.0, 6.0), tiles=(9, 9)), y=-0.6), material=blended),
        Object(mesh=moved(shapes.sphere(radius=0.4, triangles=300), y=0.6), material=brick),
        Object(mesh=moved(shapes.sphere(radius=0.2, triangles=300), y=1.2), material=smooth),
    )
    scene = Scene(objects=objects, lights=LIGHTS["spot"], ambient=0.3, ambient_rule=rule)
    exact, fast, wrong = compare(scene, camera((1.5, 2.0, 3.5), size=96), FrameOptions(shadow_map_size=128))
    assert wrong <= 4
    alike = (exact.owner == fast.owner) & (exact.shadowed == fast.shadowed).all(0)
    assert (exact.rgb - fast.rgb)[alike].abs().quantile(0.99) < 3e-4


@pytest.mark.slow
def test_a_million_triangles_in_instances(brick, device):
    """A crowd of knots, looked at closely: what torch shows in float64, to the last fragment."""
    knot = shapes.torus_knot(tiles=(20, 2))
    places = [torch.diag(torch.tensor([0.2, 0.2, 0.2, 1.0])) for _ in range(84)]
    for i, place in enumerate(places):
        place[:2, 3] = torch.tensor([i % 10 - 4.5, i // 10 - 4.0]) * 0.64
    objects = tuple(Object(mesh=mesh.transform(knot, place), material=brick) for place in places)
    assert sum(len(o.mesh.faces) for o in objects) > 1_000_000
    scene, options = Scene(objects=objects, lights=LIGHTS["sun"]), FrameOptions(shadows=False)
    view = camera((1.1, 0.7, 8.0), at=(1.1, 0.7, 0.0), size=64, fov_deg=4)
    exact, fast = frame.render(in_double(scene), view, options), Renderer(scene, options).render(view)
    assert exact.counts["fragments"] == fast.counts["fragments"] > 1000
    assert ((exact.rgb - fast.rgb).abs().amax(-1) > 1 / 255).sum() <= 4


def test_a_slanting_sun_leaves_out_what_it_cannot_shadow(device):
    """Its box reaches nearer to the light than any body does: that alone does not put the light inside of one."""
    scene = Scene(objects=(Object(mesh=shapes.sphere(triangles=2000), material=Material()),), lights=LIGHTS["sun"])
    renderer = Renderer(scene, FrameOptions(shadow_map_size=256))
    renderer.show(camera((2.0, 3.0, 1.5)))
    stamps = renderer._maps.views.total("stamps")
    assert renderer.counts["shadow stamps left out"] > 0.8 * stamps > 0
