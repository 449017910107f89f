import torch

from tests.meso.test_bake_gdm import box
from torchmeso.geometry.rays import RayScene
from torchmeso.meso import generators, solid
from torchmeso.transport import tracer
from torchmeso.transport.tracer import Geometry


def test_bodies_are_found_across_the_border_and_sheets_left_out():
    meso = box([[0.2, 0.2, -0.3], [0.7, 0.7, -0.2]], [[0.6, 0.6, -0.1], [1.1, 0.9, -0.05]], 0.4)
    found = solid.bodies(meso.geometry, meso.h)
    assert len(found.unique()) == 2
    assert (found >= 0).all()
    holed = Geometry(**{**_parts(meso.geometry), "faces": meso.geometry.faces[1:], "part": meso.geometry.part[1:]})
    found = solid.bodies(holed, meso.h)
    assert (found[:11] == -1).all()  # a side is missing: a sheet
    assert (found[11:] >= 0).all()


def test_a_height_field_divides_and_its_winding_does_not_matter(rng):
    meso = generators.groove()
    place = torch.rand(3000, 3, generator=rng) * torch.tensor([1.0, 1.0, -meso.h])
    turned = Geometry(**{**_parts(meso.geometry), "faces": meso.geometry.faces.flip(1)})
    a, b = (_inside(g, meso.h, place) for g in (meso.geometry, turned))
    assert torch.equal(a, b)
    assert 0.05 < a.float().mean() < 0.95
    assert (a | (place[:, 2] > -meso.h)).all()


def _inside(geometry, h, place):
    vertices, faces, source = tracer.unit_cell(geometry.vertices, geometry.faces, 0.5)
    return solid.inside(RayScene(vertices, faces), solid.bodies(geometry, h)[source], place, start=1e-4)


def _parts(g):
    return {n: getattr(g, n) for n in ("vertices", "faces", "part", "palette")}
