from dataclasses import replace

import pytest
import torch

from tests.geometry.test_quads import BOX
from tests.synthesize.test_tiling import tiles
from torchmeso.data import tile_atlas, tiled_surface
from torchmeso.data.tiled_surface import base, describe, dress, load, save
from torchmeso.errors import ConfigError, FormatError, ShapeError
from torchmeso.geometry import cube_projection, quads
from torchmeso.geometry.directions import dot
from torchmeso.geometry.shapes import sphere
from torchmeso.synthesize import quad_tiling


@pytest.fixture(scope="module")
def box():
    return quad_tiling.arrange(quads.patches(quads.split(BOX, 3).mesh), tiles("any"), seed=1)


def test_tiles_lie_where_the_arrangement_says(box):
    set_ = tiles("any")
    ready = base(box)
    atlas = tile_atlas.build(set_)
    mesh = dress(ready, box, set_).mesh
    corner = mesh.uv[mesh.faces]
    expected = atlas.coordinates(set_.find(box.colours)[box.cell][:, None].expand(-1, 3), box.place)
    torch.testing.assert_close(corner.double(), expected, rtol=0, atol=1e-6)
    # A tile of one texel is a tenth of the exemplar; a quad is a third of the box's side.
    torch.testing.assert_close(mesh.scale, torch.full_like(mesh.scale, 10 / 3))


def test_frames_run_along_the_sides_of_quads(box):
    mesh = base(box).mesh
    p = mesh.vertices[mesh.faces].double()
    south_west, south_east, _, north_west = box.quads[box.cell].unbind(1)
    east = box.vertices[south_east] - box.vertices[south_west]
    north = box.vertices[north_west] - box.vertices[south_west]
    t, n, sign = mesh.tangents[mesh.faces].double(), mesh.normals[mesh.faces].double(), mesh.sign[mesh.faces].double()
    assert float(dot(t, 3 * east[:, None].expand_as(p)).min()) > 0.999
    b = sign[..., None] * torch.linalg.cross(n, t)
    assert float(dot(b, 3 * north[:, None].expand_as(p)).min()) > 0.999


def test_another_set_of_the_kind_is_a_look_up(box):
    ready = base(box)
    one, other = dress(ready, box, tiles("any")), dress(ready, box, replace(tiles("any"), source=(20, 5)))
    assert other.mesh.faces is ready.mesh.faces and other.mesh.tangents is ready.mesh.tangents
    torch.testing.assert_close(other.mesh.uv, one.mesh.uv * torch.tensor([2.0, 0.5]))
    torch.testing.assert_close(other.mesh.scale, one.mesh.scale)


def test_a_ball_stays_closed(rng):
    body = sphere(triangles=300)
    points, faces = torch.unique(body.vertices, dim=0, return_inverse=True)
    found = quad_tiling.arrange(cube_projection.project(points, faces[body.faces], 2), tiles("corners"))
    mesh = dress(base(found), found, tiles("corners")).mesh
    assert mesh.closed.tolist() == [True] and len(mesh.faces) == len(found.faces)


def test_files_hold_surfaces(box, tmp_path):
    save(box, tmp_path / "a.surface", seed=1)
    again = load(tmp_path / "a.surface")
    for name in ("vertices", "faces", "cell", "place", "quads", "colours", "jumps"):
        assert getattr(again, name).equal(getattr(box, name))
    about = describe(tmp_path / "a.surface")
    assert about["mesh"] == "108 triangles in 54 quads, coloured edges" and about["seed"] == 1
    assert about["frame jumps"].startswith(f"{len(box.jumps)} edges")


@pytest.mark.errors
def test_what_does_not_fit_is_refused(box, tmp_path):
    with pytest.raises(
        ConfigError, match="expected a set with coloured edges, as the surface was laid out for, got co"
    ):
        dress(base(box), box, tiles("corners"))
    with pytest.raises(ConfigError, match="expected a tile of every combination asked for"):
        dress(base(box), box, tiles("edges"))
    with pytest.raises(ShapeError, match=r"surface.cell: expected numbers from 0 to 53, got 0 to 54"):
        replace(box, cell=box.cell + (box.cell == 53))
    with pytest.raises(ShapeError, match=r"surface.place: expected places in quads, 0 to 1, got 0 to 2"):
        replace(box, place=2 * box.place)
    with pytest.raises(FormatError, match="expected a tiled surface"):
        tiled_surface.load(tmp_path / "none.surface")
