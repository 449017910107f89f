"""Frames of quilted materials: both backends, and beside materials that are made of the map's texels themselves."""

from dataclasses import replace

import pytest
import torch

from tests.render.scenes import camera, sun
from torchmeso.compress import double_sh, eigen, sh_pca
from torchmeso.compress.double_sh import DoubleShOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.compress.sh_pca import ShPcaOptions
from torchmeso.data.textured import Textured
from torchmeso.errors import ConfigError
from torchmeso.geometry import mesh, shapes
from torchmeso.meso import bake_btf, bake_mdf, generators
from torchmeso.meso.bake_btf import BtfOptions
from torchmeso.meso.bake_mdf import MdfOptions
from torchmeso.render import frame
from torchmeso.render.frame import FrameOptions, Skips
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Material, Object, Scene, quilted
from torchmeso.synthesize import patch_error, quilting
from torchmeso.synthesize.quilting import QuiltingOptions


@pytest.fixture(scope="module")
def table():
    options = BtfOptions(texels=16, lights="grid(8, 3, 80)", views="grid(8, 3, 80)", samples=1, bounces=0)
    return bake_btf.in_memory(generators.brick(), options)


@pytest.fixture(scope="module")
def brick(table):
    model = eigen.fit(table, EigenOptions(rank=6))
    options = MdfOptions(texels=32, views="grid(8, 4, 87.5)")
    return Material(btf=model, mdf=bake_mdf.in_memory(generators.brick(), options))


@pytest.fixture(scope="module")
def map_(brick):
    """A map of twice and three times the brick's texels."""
    options = QuiltingOptions(patch=7, overlap=2, tileable=True, toroidal=True)
    rng = torch.Generator().manual_seed(0)
    return quilting.grow(patch_error.exemplar(brick.btf), (32, 48), options, rng=rng).map


def still_life(material):
    floor = torch.eye(4)
    floor[1, 3] = -0.6
    return (
        Object(mesh=shapes.torus(tiles=(6, 2), triangles=600), material=material),
        Object(mesh=mesh.transform(shapes.plane(size=(12.0, 12.0), tiles=(12, 12)), floor), material=material),
    )


def compare(scene, view, options):
    exact, fast = frame.render(scene, view, options), Renderer(scene, options).render(view)
    return exact, fast, int(((exact.rgb - fast.rgb).abs().amax(-1) > 1 / 255).sum())


@pytest.mark.parametrize("filtering", [False, True])
@pytest.mark.parametrize("silhouette", ["none", "paper", "curved"])
def test_the_same_picture_as_torch(silhouette, filtering, brick, map_, device):
    scene = Scene(objects=still_life(quilted(brick, map_)), lights=(sun(1, 2, 1),), ambient=0.2)
    options = FrameOptions(silhouette=silhouette, shadow_map_size=128, filtering=filtering)
    exact, fast, wrong = compare(scene, camera((1.0, 1.2, 3.0), size=64), options)
    assert wrong <= 4  # decisions on their threshold
    assert (exact.owner != fast.owner).sum() <= 2 and (exact.shadowed != fast.shadowed).sum() <= 4
    plain = Renderer(replace(scene, objects=still_life(brick)), options).render(camera((1.0, 1.2, 3.0), size=64))
    assert ((plain.rgb - fast.rgb).abs().amax(-1) > 0.05).sum() > 300  # it does something


@pytest.mark.parametrize("kind", ["double-sh", "sh-pca", "pictures"])
def test_every_kind_of_reflectance(kind, table, brick, map_, device):
    looks = {
        "double-sh": lambda: double_sh.fit(table, DoubleShOptions(light_terms=9, view_terms=4)),
        "sh-pca": lambda: sh_pca.fit(table, ShPcaOptions(rank=5, light_terms=9)),
        "pictures": lambda: Textured(
            albedo=torch.rand(16, 16, 3, generator=torch.Generator().manual_seed(1)),
            normals=torch.tensor([0.1, 0.2, 1.0]).expand(32, 32, 3).clone(),
        ),
    }
    material = quilted(Material(btf=looks[kind](), mdf=brick.mdf), map_)
    scene = Scene(objects=still_life(material), lights=(sun(1, 2, 1),), ambient=0.2)
    assert compare(scene, camera((1.0, 1.2, 3.0), size=64), FrameOptions(shadow_map_size=128))[2] <= 4


def test_the_same_picture_as_of_a_material_made_of_the_texels(brick, map_, device):
    """Texture coordinates count sides of the exemplar: with a whole material, periods."""
    whole = replace(brick, btf=replace(brick.btf, maps=map_.apply(brick.btf.maps, 1)), mdf=None)
    options = FrameOptions(silhouette="none", filtering=False)
    view, pictures = camera((0.0, 2.5, 2.5), size=64), []
    for material, tiles in ((quilted(replace(brick, mdf=None), map_), (12, 12)), (whole, (4, 6))):
        body = Object(mesh=shapes.plane(size=(3.0, 3.0), tiles=tiles), material=material)
        pictures.append(Renderer(Scene(objects=(body,), lights=(sun(1, 2, 1),)), options).render(view).rgb.clone())
    assert ((pictures[0] - pictures[1]).abs().amax(-1) > 2 / 255).sum() <= 8


@pytest.mark.parametrize("name", ["bounds", "losers", "behind", "facing"])
def test_skips_change_nothing(name, brick, map_, device):
    scene = Scene(objects=still_life(quilted(brick, map_)), lights=(sun(1, 2, 1),))
    options = FrameOptions(shadow_map_size=128)
    without = replace(options, skips=replace(Skips(), **{name: False}))
    pictures = [Renderer(scene, x).render(camera((1.0, 1.2, 3.0), size=64)).rgb for x in (options, without)]
    assert pictures[0].equal(pictures[1])


def test_plain_and_quilted_stand_side_by_side(brick, map_, device):
    objects = still_life(brick)
    scene = Scene(objects=(replace(objects[0], material=quilted(brick, map_)), objects[1]), lights=(sun(1, 2, 1),))
    assert compare(scene, camera((1.0, 1.2, 3.0), size=64), FrameOptions(shadow_map_size=128))[2] <= 4


@pytest.mark.errors
def test_what_cannot_be_laid_out(table, map_):
    with pytest.raises(ConfigError, match="expected a material with a BTF, an MDF or pictures, got a plain colour"):
        quilted(Material(), map_)
    with pytest.raises(ConfigError, match=r"a Btf \(btf\) cannot be laid out by a map; compress it first"):
        quilted(Material(btf=table), map_)
