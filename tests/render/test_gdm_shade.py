import math
from dataclasses import replace

import pytest
import torch

from tests.data.test_gdm import layered
from tests.render.scenes import camera, sun
from torchmeso.errors import ConfigError
from torchmeso.geometry import mesh, shapes
from torchmeso.geometry.light import PointLight
from torchmeso.meso import bake_gdm, generators
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.render import frame
from torchmeso.render.device_gdm import columns, sample_codes
from torchmeso.render.frame import FrameOptions, Skips
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Material, Object, Scene, ShellOptions, assemble

OPTIONS = FrameOptions(shadow_map_size=128, skips=Skips(carried=False))  # what torch does


@pytest.fixture(scope="module")
def weave():
    return bake_gdm.in_memory(generators.weave(), GdmOptions(texels=20, layers=7, n_theta=8, n_phi=16, cap=0.7))


def ground(level=-0.2, albedo=(0.5, 0.4, 0.3), f0=0.0):
    """A GDM of flat ground at a height, of one material."""
    gdm = layered(level)
    matter = torch.zeros(*gdm.voxels, 10)
    matter[..., 2], matter[..., 3:6], matter[..., 6], matter[..., 7:] = 1, torch.tensor(albedo), 0.3, f0
    return replace(gdm, matter=matter)


def on_plane(material, light, **options):
    body = shapes.plane(size=(4.0, 4.0), tiles=(4, 4), triangles=8)
    return Scene(objects=(Object(mesh=body, material=material),), lights=(light,), ambient=0.0, **options)


def above(**options):
    return camera((0.3, 3.0, 0.2), up=(0.0, 0.0, -1.0), fov_deg=20.0, **options)


@pytest.mark.parametrize("backend", ["torch", "opencl"])
def test_flat_ground_lies_at_its_depth_and_shines_as_a_diffuser(backend):
    light = sun(0.5, 1.0, 0.3)
    scene = on_plane(Material(gdm=ground()), light)
    eye = above()
    shown = frame.render(scene, eye, OPTIONS) if backend == "torch" else Renderer(scene, OPTIONS).render(eye)
    origin, direction, _ = eye.rays(eye.pixel_centres(torch.float64).reshape(-1, 2))
    depth = ((-0.2 - origin[..., 1]) / direction[..., 1]).reshape(64, 64)
    torch.testing.assert_close(shown.depth.double(), depth, rtol=0, atol=1e-2)  # between coarse directions
    cosine = float(light.direction[1])
    expected = torch.tensor([0.5, 0.4, 0.3]).expand(64, 64, 3) * cosine
    torch.testing.assert_close(shown.rgb.float(), expected, rtol=0, atol=2e-3)
    assert not shown.shadowed.any()


def test_a_coat_shines_as_in_the_formula():
    """Against `transport.materials`, in the mirror direction and beside it."""
    from torchmeso.transport import materials
    from torchmeso.transport.materials import Reflectance

    light = sun(0.2, 1.0, 0.1)
    scene = on_plane(Material(gdm=ground(f0=0.04)), light)
    eye = above()
    shown = frame.render(scene, eye, OPTIONS).rgb.reshape(-1, 3)
    _, direction, _ = eye.rays(eye.pixel_centres(torch.float32).reshape(-1, 2))
    n = len(direction)
    turned = torch.tensor([0, 2, 1])  # the plane's normal is +y; the material is the same all around
    wi, direction = light.direction.float().expand(n, 3)[:, turned], direction[:, turned]
    parts = Reflectance(torch.tensor([[0.5, 0.4, 0.3]]).expand(n, 3), torch.full((n,), 0.3), torch.full((n, 3), 0.04))
    expected = math.pi * materials.evaluate(parts, wi, -direction.float()) * wi[:, 2:]
    torch.testing.assert_close(shown, expected, rtol=2e-3, atol=1e-4)
    on_device = Renderer(scene, OPTIONS).render(eye).rgb.reshape(-1, 3)
    torch.testing.assert_close(on_device, shown, rtol=2e-3, atol=1e-4)


def dressed(weave, kind):
    body = shapes.torus(triangles=400, tiles=(6, 2))
    lower = torch.eye(4)
    lower[1, 3] = -0.5
    plain = mesh.transform(shapes.plane(size=(6.0, 6.0), tiles=(2, 2), triangles=2), lower)
    lights = (sun(0.4, 1.0, 0.5),)
    shell = ShellOptions()
    if kind == "open":
        shell = ShellOptions(base="open")
    if kind == "outward":
        shell = ShellOptions(side="outward")
    if kind == "point":
        lights = (PointLight(position=torch.tensor([1.0, 2.5, 1.0]), intensity=torch.full((3,), 20.0)), *lights)
    if kind == "coat":
        matter = weave.matter.clone()
        matter[..., 6] *= torch.linspace(0.3, 1, matter.shape[2])
        matter[..., 7:] = 0.04 * matter[..., :1].abs()
        weave = replace(weave, matter=matter)
    if kind == "columns":
        parts = ("distance", "left", "occupancy", "matter")
        weave = replace(
            weave, **{x: getattr(weave, x).repeat(1, 4, 4, *[1] * (getattr(weave, x).dim() - 3)) for x in parts}
        )
        assert columns(sample_codes(weave)) is not None
    material = Material(gdm=weave, shell=shell, albedo=(0.4, 0.2, 0.2))
    one = Object(mesh=body, material=material)
    if kind == "parts":
        part = (torch.arange(len(body.faces)) > 150).long()
        one = Object(mesh=body, material=material, others=(Material(albedo=(0.2, 0.6, 0.2)),), part=part)
    if kind == "below":
        one = Object(mesh=shapes.plane(size=(3.0, 3.0), tiles=(3, 3), triangles=18), material=material)
    objects = (one, Object(mesh=plain, material=Material(albedo=(0.3, 0.3, 0.6)))) if kind != "below" else (one,)
    return Scene(objects=objects, lights=lights, ambient=0.1)


@pytest.mark.parametrize("kind", ["solid", "open", "outward", "point", "parts", "below", "coat", "columns"])
def test_opencl_shows_what_torch_shows(weave, kind):
    scene = dressed(weave, kind)
    eye = camera((1.5, -2.5 if kind == "below" else 2.5, 2.0), size=48)
    truth = frame.render(scene, eye, OPTIONS)
    renderer = Renderer(scene, OPTIONS)
    shown = renderer.render(eye)
    assert (shown.owner == truth.owner).double().mean() > 0.999
    off = (shown.rgb - truth.rgb).abs().amax(-1) > 1 / 255
    assert off.double().mean() < 0.003
    assert torch.isfinite(shown.rgb).all()
    assert shown.counts["rays lost in a shell"] == 0
    seen = truth.owner == 0
    assert 0.1 < seen.double().mean() < 0.95
    screen = renderer.show(eye)[..., :3].float() / 255
    exact = torch.where(truth.rgb <= 0.0031308, 12.92 * truth.rgb, 1.055 * truth.rgb.clamp(0, 1) ** (1 / 2.4) - 0.055)
    assert ((screen - exact.clamp(0, 1)).abs().amax(-1) > 2 / 255).double().mean() < 0.004


@pytest.mark.parametrize("base", ["solid", "open"])
def test_the_eye_may_be_inside_of_a_shell(weave, base):
    scene = dressed(weave, base)
    at = torch.tensor([1.0, 0.33, 0.02])  # below the top of the torus, among the yarns
    ahead = at + torch.tensor([0.02, 0.3, 1.0])
    eye = camera(tuple(at.tolist()), tuple(ahead.tolist()), size=48, fov_deg=70.0)
    renderer = Renderer(scene, OPTIONS)
    shown = renderer.render(eye)
    truth = frame.render(scene, eye, OPTIONS)
    assert renderer._picture.frame.array[0]["starts"] > 0
    assert (truth.owner == 0).double().mean() > 0.2
    assert (shown.owner == truth.owner).double().mean() > 0.998
    assert ((shown.rgb - truth.rgb).abs().amax(-1) > 1 / 255).double().mean() < 0.005


def test_near_material_casts_shadows_and_far_material_through_the_map(weave):
    """A low light leaves less of a weave lit than a high one, and the torus shadows the ground."""
    high = frame.render(dressed(weave, "solid"), camera((1.5, 2.5, 2.0), size=48), OPTIONS)
    floor = high.owner == 1
    assert high.shadowed[0][floor].any()
    low = replace(dressed(weave, "solid"), lights=(sun(1.0, 0.25, 0.3),), ambient=0.0)
    eye = camera((1.5, 2.5, 2.0), size=48)
    dark = frame.render(low, eye, OPTIONS)
    bright = frame.render(replace(low, lights=(sun(0.1, 1.0, 0.1),)), eye, OPTIONS)
    black = [(p.rgb.amax(-1) == 0)[p.owner == 0].double().mean() for p in (dark, bright)]
    assert black[0] > 1.5 * black[1]


@pytest.mark.errors
def test_a_material_is_of_one_kind(weave):
    with pytest.raises(ConfigError, match="a GDM alone"):
        Material(gdm=weave, btf=object())  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"shell\.side"):
        ShellOptions(side="up")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"shell\.base"):
        ShellOptions(base="none")  # type: ignore[arg-type]


def test_a_new_material_alone_keeps_the_tables(weave):
    scene = dressed(weave, "solid")
    eye = camera((1.5, 2.5, 2.0), size=32)
    renderer = Renderer(scene, OPTIONS)
    renderer.render(eye)
    first, *rest = scene.objects
    other = replace(scene, objects=(replace(first, material=replace(first.material, albedo=(0.9, 0.1, 0.1))), *rest))
    renderer.update(other)
    shown = renderer.render(eye).rgb.clone()
    torch.testing.assert_close(shown, Renderer(other, OPTIONS).render(eye).rgb, rtol=0, atol=0)


def test_what_a_look_up_found_empty_is_not_asked_again(device):
    """Prisms are small beside the ways through the table; nearly every pixel is the same."""
    gdm = bake_gdm.in_memory(generators.weave(), GdmOptions(texels=24, layers=9, n_theta=8, n_phi=16))
    body = shapes.torus(triangles=4000, tiles=(4, 1))
    scene = Scene(objects=(Object(mesh=body, material=Material(gdm=gdm)),), lights=(sun(0.4, 1.0, 0.3),))
    eye = camera((0.5, 2.2, 2.4), size=160)
    on, off = (Renderer(scene, replace(OPTIONS, skips=Skips(carried=x))).render(eye) for x in (True, False))
    counter = "prisms passed without a look-up"
    assert on.counts[counter] > 0.1 * on.counts["prisms passed"]
    assert off.counts[counter] == 0
    seen = torch.isfinite(off.depth)
    assert (torch.isfinite(on.depth) != seen).double().mean() < 2e-3
    moved = (on.depth - off.depth)[seen & torch.isfinite(on.depth)].abs()
    assert (moved > 2 * gdm.voxel).double().mean() < 1e-2


@pytest.mark.parametrize("kind", ["around", "inside", "turned"])
def test_bottoms_of_shells_around_bodies_are_left_out(weave, kind):
    """From outside tops hide them, of a body turned inside out they do not, and from inside they are what is seen."""
    scene = dressed(weave, "solid")
    one, *rest = scene.objects
    if kind == "turned":
        one = replace(one, mesh=replace(one.mesh, faces=one.mesh.faces.flip(1)))
        scene = replace(scene, objects=(one, *rest))
    eye = camera((1.0, 0.0, 0.0), (1.0, 0.1, 1.0), size=64) if kind == "inside" else camera((1.5, 2.5, 2.0), size=64)
    world = assemble(scene)
    bottoms = (world.entry < 0) & torch.isin(world.owner, torch.tensor([0]))
    assert bottoms.any()
    assert world.sunk[bottoms].all() == (kind != "turned")
    assert not world.sunk[~bottoms].any()
    on, off = (
        Renderer(scene, replace(OPTIONS, skips=Skips(carried=False, hidden=x))).render(eye) for x in (True, False)
    )
    assert torch.equal(on.rgb, off.rgb)
    assert torch.equal(on.owner, off.owner)
    if kind == "around":
        assert on.counts["triangles drawn"] < 0.7 * off.counts["triangles drawn"]
    if kind == "inside":
        assert (on.owner == 0).double().mean() > 0.9
