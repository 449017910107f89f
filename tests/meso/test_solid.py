import pytest
import torch

from tests.meso.test_bake_gdm import box
from torchmeso.meso import bake_gdm, generators, solid
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.meso.mesostructure import Mesostructure
from torchmeso.meso.parts import rectangle
from torchmeso.transport.tracer import Geometry

START = 1e-4
SMALL = GdmOptions(texels=6, layers=4, n_theta=2, n_phi=3)


def test_bodies_are_found_across_the_border_and_sheets_left_out():
    meso = box([[0.2, 0.2, -0.3], [0.7, 0.7, -0.2]], [[0.6, 0.6, -0.1], [1.1, 0.9, -0.05]], 0.4)
    found = solid.bodies(meso.geometry, meso.h)
    assert len(found.unique()) == 2
    assert (found >= 0).all()
    found = solid.bodies(only(meso.geometry, slice(1, None)), meso.h)
    assert (found[:11] == -1).all()  # a side is missing: a sheet
    assert (found[11:] >= 0).all()


def test_a_height_field_divides_and_its_winding_does_not_matter(rng):
    meso = generators.groove()
    place = torch.rand(3000, 3, generator=rng) * torch.tensor([1.0, 1.0, -meso.h])
    turned = Geometry(**{**parts(meso.geometry), "faces": meso.geometry.faces.flip(1)})
    a, b = (solid.Solids(g, meso.h).inside(place, start=START) for g in (meso.geometry, turned))
    assert torch.equal(a, b)
    assert 0.05 < a.float().mean() < 0.95
    assert (a | (place[:, 2] > -meso.h)).all()


TWO_BOXES = {
    "stacked": [([0.2, 0.2, -0.4], [0.6, 0.6, -0.3]), ([0.2, 0.2, -0.3], [0.6, 0.6, -0.1])],
    "on a slab": [([0.1, 0.1, -0.4], [0.9, 0.9, -0.3]), ([0.3, 0.3, -0.3], [0.6, 0.6, -0.1])],
    "side by side": [([0.1, 0.1, -0.4], [0.5, 0.9, -0.3]), ([0.5, 0.1, -0.4], [0.8, 0.9, -0.2])],
    "corner to corner": [([0.1, 0.1, -0.4], [0.5, 0.5, -0.3]), ([0.5, 0.5, -0.3], [0.9, 0.9, -0.1])],
    "edge to edge": [([0.1, 0.1, -0.4], [0.5, 0.5, -0.3]), ([0.5, 0.1, -0.3], [0.9, 0.5, -0.1])],
    "nested": [([0.1, 0.1, -0.4], [0.9, 0.9, -0.1]), ([0.3, 0.3, -0.3], [0.6, 0.6, -0.2])],
    "overlapping": [([0.1, 0.1, -0.4], [0.6, 0.6, -0.1]), ([0.3, 0.3, -0.3], [0.8, 0.8, -0.2])],
    "the same": [([0.1, 0.1, -0.4], [0.9, 0.9, -0.3])] * 2,
    "as wide as the tile": [([0.0, 0.1, -0.4], [1.0, 0.9, -0.2])],
    "as the whole tile": [([0.0, 0.0, -0.5], [1.0, 1.0, -0.2])],
    "over its own copy": [([-0.2, 0.1, -0.4], [1.3, 0.9, -0.3])],
}


@pytest.mark.parametrize("boxes", TWO_BOXES.values(), ids=TWO_BOXES)
def test_boxes_however_they_lie(boxes, rng):
    low, high = ([box[k] for box in boxes] for k in (0, 1))
    meso = box(low, high, 0.5)
    check(meso.geometry, *membership(low, high, rng))


@pytest.mark.parametrize("name", ["stacked", "side by side", "corner to corner", "edge to edge"])
def test_boxes_that_share_their_vertices(name, rng):
    low, high = ([box[k] for box in TWO_BOXES[name]] for k in (0, 1))
    g = box(low, high, 0.5).geometry
    vertices, number = g.vertices.unique(dim=0, return_inverse=True)
    check(Geometry(**{**parts(g), "vertices": vertices, "faces": number[g.faces]}), *membership(low, high, rng))


def test_a_blade_on_a_box_leaves_it_a_body(rng):
    low, high = [[0.1, 0.1, -0.4]], [[0.9, 0.9, -0.3]]
    g = box(low, high, 0.5).geometry
    vertices = torch.cat([g.vertices, torch.tensor([[0.5, 0.5, 0.0], [0.6, 0.5, 0.0]])])
    faces = torch.cat([g.faces, torch.tensor([[7, 8, 9]])])
    bladed = Geometry(**{**parts(g), "vertices": vertices, "faces": faces, "part": g.part.new_zeros(len(faces))})
    assert solid.bodies(bladed, 0.5)[-1] == -1
    check(bladed, *membership(low, high, rng))


def test_every_triangle_with_its_back(rng):
    low, high = [[0.1, 0.1, -0.4]], [[0.9, 0.9, -0.3]]
    g = box(low, high, 0.5).geometry
    both = {"faces": torch.cat([g.faces, g.faces.flip(1)]), "part": g.part.repeat(2)}
    check(Geometry(**{**parts(g), **both}), *membership(low, high, rng))


def test_a_slanted_body_over_its_own_copies(rng):
    """Parts of it lie above the same points of the tile, in its copies: a corridor of boxes that climbs."""
    steps = [([0.3 * k, 0.2, -0.45 + 0.1 * k], [0.3 * k + 0.5, 0.7, -0.3 + 0.1 * k]) for k in range(4)]
    low, high = ([step[k] for step in steps] for k in (0, 1))
    check(box(low, high, 0.5).geometry, *membership(low, high, rng))


def membership(low, high, rng, h=0.5):
    """Points, whether they lie in a box or its copies, and whether they keep off all faces."""
    place = torch.rand(4000, 3, generator=rng) * torch.tensor([1.0, 1.0, -h])
    truth, near = torch.zeros(4000, dtype=torch.bool), torch.zeros(4000, dtype=torch.bool)
    for a, b in zip(torch.tensor(low), torch.tensor(high), strict=True):
        for i in (-2, -1, 0, 1, 2):
            for j in (-1, 0, 1):
                p = place + torch.tensor([i, j, 0.0])
                truth |= ((p > a) & (p < b)).all(-1)
                near |= ((p - a).abs() < 3 * START).any(-1) | ((p - b).abs() < 3 * START).any(-1)
    return place, truth, near


def check(geometry, place, truth, near):
    found = solid.Solids(geometry, 0.5).inside(place, start=START)
    assert torch.equal(found[~near], truth[~near])
    assert truth.any()


def test_more_bodies_than_scenes_are_still_asked(rng, monkeypatch):
    monkeypatch.setattr(solid, "MOST_SCENES", 2)
    low = [[0.1 * k, 0.1 + 0.01 * k, -0.4 + 0.011 * k] for k in range(6)]
    high = [[x + 0.25, 0.9 + 0.01 * k, z + 0.13] for k, (x, _, z) in enumerate(low)]
    check(box(low, high, 0.5).geometry, *membership(low, high, rng))
    monkeypatch.setattr(solid, "MOST_BODIES", 2)
    check(box(low, high, 0.5).geometry, *membership(low, high, rng))


def test_a_sphere_is_one_body_in_spite_of_its_poles():
    meso = generators.spheres()
    assert len(solid.bodies(meso.geometry, meso.h).unique()) == 6  # floor and four spheres, and what has no area


def test_soups_are_baked_to_numbers(rng):
    """Triangles anywhere, some without an area, some three at an edge: sheets, finite tables, no error."""
    corner = torch.rand(60, 3, 3, generator=rng) * torch.tensor([1.5, 1.5, -0.5]) - torch.tensor([0.2, 0.2, 0.0])
    corner[:5, 2] = corner[:5, 1]
    corner[5:10, 1:] = corner[5:10, :1]
    vertices = torch.cat([corner.reshape(-1, 3), torch.tensor([[0.5, 0.5, -0.1]])])
    faces = torch.cat([torch.arange(180).reshape(-1, 3), torch.tensor([[30, 31, 180], [30, 31, 180], [31, 30, 34]])])
    meso = Mesostructure(geometry=tile_of(vertices, faces), h=0.5)
    gdm = bake_gdm.in_memory(meso, SMALL)
    assert (solid.bodies(meso.geometry, 0.5) == -1).any()
    assert gdm.matter.isfinite().all()
    assert gdm.distance.float().isfinite().all()


def test_nothing_is_solid_in_a_sheet_and_all_of_it_under_a_plate():
    speck = torch.tensor([[0.5, 0.5, -0.1], [0.5001, 0.5, -0.1], [0.5, 0.5001, -0.1]])
    empty = bake_gdm.in_memory(Mesostructure(geometry=tile_of(speck, torch.tensor([[0, 1, 2]])), h=0.2), SMALL)
    assert (empty.occupancy == 0).all()
    assert empty.left.all()
    plate = bake_gdm.in_memory(Mesostructure(geometry=tile_of(*rectangle(0, 1, 0, 1, 0.0)), h=0.2), SMALL)
    assert (plate.occupancy[:-1] == 1).all()
    assert (plate.occupancy[-1] == 0).all()  # on the surface
    assert (plate.distance == 0).all()
    assert not plate.left[:-1].any()


def test_the_smallest_tables_and_supersampling():
    """Two layers, one texel, six directions; shares of a plate that fills part of a voxel."""
    meso = box([[0.0, 0.0, -0.4]], [[1.0, 1.0, -0.3]], 0.4)
    for n in (1, 2, 4):
        gdm = bake_gdm.in_memory(meso, GdmOptions(texels=1, layers=2, n_theta=2, n_phi=3, supersample=n))
        assert gdm.occupancy.shape == (2, 1, 1)
        assert 0 <= float(gdm.occupancy.min()) <= float(gdm.occupancy.max()) <= 1
    fine = bake_gdm.in_memory(meso, GdmOptions(texels=2, layers=5, n_theta=2, n_phi=3, supersample=4))
    assert fine.occupancy[:, 0, 0].tolist() == [1.0, 0.5, 0.0, 0.0, 0.0]


def only(g, faces):
    return Geometry(**{**parts(g), "faces": g.faces[faces], "part": g.part[faces]})


def tile_of(vertices, faces):
    palette = generators.sheet().geometry.palette
    return Geometry(vertices=vertices, faces=faces, part=torch.zeros(len(faces), dtype=torch.long), palette=palette)


def parts(g):
    return {n: getattr(g, n) for n in ("vertices", "faces", "part", "palette")}
