"""A still life that several tests render."""

import pytest

from tests.render.scenes import moved
from torchmeso.compress import eigen
from torchmeso.compress.eigen import EigenOptions
from torchmeso.geometry import shapes
from torchmeso.meso import bake_btf, bake_mdf, generators
from torchmeso.meso.bake_btf import BtfOptions
from torchmeso.meso.bake_mdf import MdfOptions
from torchmeso.render.scene import Material, Object


@pytest.fixture(scope="package")
def brick():
    """A brick wall of both tables, small."""
    meso = generators.brick()
    lights = views = "grid(8, 3, 80)"
    table = bake_btf.in_memory(meso, BtfOptions(texels=16, lights=lights, views=views, samples=1, bounces=0))
    model = eigen.fit(table, EigenOptions(rank=6))
    return Material(btf=model, mdf=bake_mdf.in_memory(meso, MdfOptions(texels=32, views="grid(8, 4, 87.5)")))


@pytest.fixture(scope="package")
def weave():
    """A material with holes, without a BTF."""
    options = MdfOptions(texels=32, views="grid(8, 4, 87.5)")
    return Material(mdf=bake_mdf.in_memory(generators.weave(), options), albedo=(0.7, 0.5, 0.3))


@pytest.fixture(scope="package")
def still_life(brick, weave):
    """Two bodies and an open floor, a plain and two textured materials."""
    return (
        Object(mesh=moved(shapes.torus(tiles=(6, 2), triangles=600), y=0.3), material=brick),
        Object(mesh=moved(shapes.sphere(radius=0.4, triangles=300), y=0.4), material=Material(albedo=(0.9, 0.2, 0.1))),
        Object(mesh=moved(shapes.cylinder(radius=0.3, height=0.8, tiles=(4, 2), triangles=400), x=1.3), material=weave),
        Object(mesh=moved(shapes.plane(size=(6.0, 6.0), tiles=(4, 4)), y=-0.6), material=brick),
    )
