from dataclasses import replace

import pytest
import torch

from tests.render.scenes import LIGHTS, camera, moved, patched
from torchmeso.data.sh_btf import ShBtf
from torchmeso.data.sh_pca_btf import ShPcaBtf
from torchmeso.errors import BackendError
from torchmeso.geometry import hemisphere, shapes
from torchmeso.meso import bake_btf, generators
from torchmeso.meso.bake_btf import BtfOptions
from torchmeso.meso.bake_mdf import RayCastMdf
from torchmeso.render.frame import FrameOptions
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Material, Object, Scene


def test_only_what_changed_is_uploaded(still_life, brick, device):
    """Scene after scene: the picture of a renderer made for it, and what was the same is not made again."""
    view, options = camera((1.5, 2.0, 3.5)), FrameOptions(shadow_map_size=128)
    first = Scene(objects=still_life, lights=LIGHTS["spot"])
    torus, ball, *rest = still_life
    painted = replace(torus, material=replace(brick, btf=replace(brick.btf, scale=0.5 * brick.btf.scale)))
    flat = replace(torus, material=replace(brick, mdf=None))
    moving = replace(torus, mesh=moved(torus.mesh, x=-0.2, y=0.1))
    red = replace(ball, material=Material(albedo=(0.2, 0.2, 0.9)))
    faces = sum(len(o.mesh.faces) for o in still_life)
    steps = {
        "nothing": (first, 0, 0, 0),
        "background": (replace(first, background=(0.3, 0.2, 0.1)), 0, 0, 0),
        "albedo": (replace(first, objects=(torus, red, *rest)), 0, 0, 0),
        "a BTF": (replace(first, objects=(painted, ball, *rest)), 0, 1, 0),
        "an MDF": (replace(first, objects=(flat, ball, *rest)), 0, 0, 2),  # the floor still has the BTF
        "a mesh": (replace(first, objects=(moving, ball, *rest)), faces, 0, 2),
        "an object": (replace(first, objects=(torus, ball)), len(torus.mesh.faces) + len(ball.mesh.faces), 0, 2),
        "no ambient": (replace(first, objects=(torus, ball), ambient=0.0), 0, 1, 0),
        "light": (replace(first, objects=(torus, ball), ambient=0.0, lights=LIGHTS["sun"]), 0, 0, 1),
        "all": (first, faces, 2, 2),
    }
    renderer = Renderer(first, options)
    renderer.render(view)
    assert renderer.counts["tables uploaded"] == 3
    for name, (scene, n_face, n_table, n_map) in steps.items():
        renderer.update(scene)
        mine, fresh = renderer.render(view), Renderer(scene, options).render(view)
        assert torch.equal(mine.rgb, fresh.rgb), name
        assert torch.equal(mine.shadowed, fresh.shadowed), name
        found = [renderer.counts[x] for x in ("faces uploaded", "tables uploaded", "shadow maps drawn")]
        assert found == [n_face, n_table, n_map], name
        assert torch.equal(renderer.render(view).rgb, fresh.rgb), name
        assert renderer.counts["faces uploaded"] == renderer.counts["tables uploaded"] == 0


def test_a_light_drawn_after_a_material_changed_sees_the_new_one(still_life, device):
    view, options = camera((1.5, 2.0, 3.5)), FrameOptions(shadow_map_size=128)
    plain = tuple(replace(o, material=replace(o.material, btf=None)) for o in still_life)
    scene = Scene(objects=plain, lights=LIGHTS["sun"])
    renderer = Renderer(Scene(objects=still_life, lights=LIGHTS["sun"]), options)
    renderer.render(view)
    renderer.update(scene)
    fresh = Renderer(replace(scene, lights=LIGHTS["point"]), options).render(view)
    assert torch.equal(renderer.render(view, LIGHTS["point"]).shadowed, fresh.shadowed)


def test_a_scene_that_cannot_be_read_leaves_the_one_before(still_life, device):
    scene, view = Scene(objects=still_life, lights=LIGHTS["sun"]), camera((1.5, 2.0, 3.5))
    renderer = Renderer(scene, FrameOptions(shadow_map_size=128))
    before = renderer.render(view).rgb.clone()
    bad = replace(still_life[0], material=Material(mdf=RayCastMdf(generators.sheet())))
    with pytest.raises(BackendError, match="got RayCastMdf"):
        renderer.update(replace(scene, objects=(bad, *still_life[1:])))
    assert torch.equal(renderer.render(view).rgb, before)


def test_a_material_on_other_faces_is_uploaded(brick, device):
    body, plain = shapes.torus(triangles=400), Material()
    first = Scene(objects=(patched(body, brick, plain),), lights=LIGHTS["sun"])
    renderer, view = Renderer(first), camera((1.5, 2.0, 2.5))
    for o in (patched(body, brick, plain, height=0.1), Object(mesh=body, material=brick, others=(plain, plain))):
        scene = replace(first, objects=(o,))
        renderer.update(scene)
        assert torch.equal(renderer.render(view).rgb, Renderer(scene).render(view).rgb)


def test_what_kernels_cannot_read(device):
    objects = (Object(mesh=shapes.sphere(triangles=100), material=Material(mdf=RayCastMdf(generators.sheet()))),)
    with pytest.raises(BackendError, match="expected an MDF of 8 bits, got RayCastMdf"):
        Renderer(Scene(objects=objects, lights=()))
    many = LIGHTS["sun"] * 65
    plain = Scene(
        objects=(Object(mesh=shapes.sphere(triangles=100), material=Material()),), lights=many, ambient_rule="paper"
    )
    with pytest.raises(BackendError, match="at most 64 lights where ambient light shows only in shadow, got 65"):
        Renderer(plain).render(camera((0, 0, 4)))


def test_harmonics_have_a_limit_on_the_device(device):
    one, far = torch.ones(81, 1, 3), hemisphere.ubo81()
    many = ShBtf(maps=torch.zeros(81, 1, 1, 1, 3), scale=one, offset=one, lights=far, views=far)
    body = Object(mesh=shapes.plane(size=(1.0, 1.0), tiles=(1, 1)), material=Material(btf=many))
    with pytest.raises(BackendError, match="expected at most 64 coefficients of light or view, got 81"):
        Renderer(Scene(objects=(body,), lights=()))


@pytest.mark.parametrize(("rank", "terms", "message"), [(3, 81, "64 coefficients .* got 81"), (193, 1, "192 comp")])
def test_components_have_a_limit_on_the_device(rank, terms, message, device):
    pole = hemisphere.from_rings([0], [1], [0])
    many = ShPcaBtf(
        maps=torch.zeros(1, 1, 1, rank), scale=torch.ones(rank), offset=torch.zeros(rank),
        basis=torch.zeros(rank, terms, 3), lights=pole, views=pole,
    )  # fmt: skip
    body = Object(mesh=shapes.plane(size=(1.0, 1.0), tiles=(1, 1)), material=Material(btf=many))
    with pytest.raises(BackendError, match=message):
        Renderer(Scene(objects=(body,), lights=()))


def test_whole_tables_are_for_torch(device):
    options = BtfOptions(texels=2, lights="grid(4, 2, 80)", views="grid(4, 2, 80)", samples=1, bounces=0)
    table = bake_btf.in_memory(generators.brick(), options)
    body = Object(mesh=shapes.plane(size=(1.0, 1.0), tiles=(1, 1)), material=Material(btf=table))
    with pytest.raises(BackendError, match=r"expected an eigen, double-SH or SH \+ PCA BTF, got Btf"):
        Renderer(Scene(objects=(body,), lights=()))
