import pytest
import torch

from tests.synthesize.test_quad_tiling import CUBE
from torchmeso.errors import ConfigError, FormatError, GeometryError
from torchmeso.geometry import shapes
from torchmeso.synthesize.parameterize import SurfaceOptions, of_file, way

CORNERS = [[x, y, z] for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]


def write(path, points, faces, places=None):
    lines = ["v " + " ".join(map(str, p)) for p in points]
    lines += ["vt " + " ".join(map(str, p)) for p in places or []]
    each = (lambda k: f"{k + 1}/{k + 1}") if places else (lambda k: str(k + 1))
    lines += ["f " + " ".join(each(k) for k in face) for face in faces]
    path.write_text("\n".join(lines))
    return path


@pytest.fixture
def box(tmp_path):
    return write(tmp_path / "box.obj", CORNERS, CUBE.tolist())


@pytest.fixture
def ball(tmp_path):
    """A triangle mesh, with its places on a cube."""
    body = shapes.sphere(triangles=200)
    points, faces = torch.unique(body.vertices.double(), dim=0, return_inverse=True)
    places = points / points.abs().amax(1, keepdim=True) / 2 + torch.tensor([1.0, 2, 3])
    return write(tmp_path / "ball.obj", points.tolist(), faces[body.faces].tolist(), places.tolist())


def test_a_mesh_of_quads(box):
    assert way(box, SurfaceOptions()) == "quads"
    found = of_file(box, SurfaceOptions(split=3, smooth=2))
    assert len(found.quads) == 54 and len(found.faces) == 54 * 8


def test_a_polycube_map_and_a_cube(ball):
    assert way(ball, SurfaceOptions()) == "polycube"
    assert len(of_file(ball, SurfaceOptions()).quads) == 6
    assert len(of_file(ball, SurfaceOptions(by="cube")).quads) == 6 * 8**2
    assert len(of_file(ball, SurfaceOptions(by="cube", split=2)).quads) == 24


def test_flipped_quads_are_mended_and_said(tmp_path):
    faces = CUBE.tolist()
    path = write(tmp_path / "a.obj", CORNERS, [faces[0][::-1], *faces[1:]])
    with pytest.warns(UserWarning, match=r"a.obj: 1 quads were turned over and were turned back"):
        of_file(path, SurfaceOptions())


def test_vertices_at_one_place_are_one(tmp_path):
    points = torch.tensor(CORNERS)[CUBE].reshape(-1, 3).tolist()
    found = of_file(write(tmp_path / "a.obj", points, torch.arange(24).reshape(6, 4).tolist()), SurfaceOptions())
    assert len(found.vertices) == 8


@pytest.mark.errors
def test_bad_meshes_are_one_sentence(box, ball, tmp_path):
    mixed = write(tmp_path / "mixed.obj", CORNERS, [*CUBE.tolist()[1:], [0, 3, 2], [0, 2, 1]])
    text = "mixed.obj: expected faces of four corners, got 2 of 7 with others; make them quads"
    with pytest.raises(GeometryError, match=text):
        of_file(mixed, SurfaceOptions(by="quads"))
    with pytest.raises(GeometryError, match=r"a.off: expected quads, which are read from OBJ files only"):
        (tmp_path / "a.off").write_text("OFF\n")
        of_file(tmp_path / "a.off", SurfaceOptions(by="quads"))
    with pytest.raises(GeometryError, match=r"box.obj: expected three texture coordinates at each corner"):
        of_file(box, SurfaceOptions(by="polycube"))
    cube = write(tmp_path / "cube.obj", CORNERS, CUBE.tolist(), [[1, 1, 1], *CORNERS[1:]])
    with pytest.raises(GeometryError, match="expected triangles in a PolyCube map, got faces of other corners"):
        of_file(cube, SurfaceOptions(by="polycube"))
    with pytest.raises(FormatError, match=r"none.obj: expected a mesh file, found none"):
        of_file(tmp_path / "none.obj", SurfaceOptions())
    with pytest.raises(ConfigError, match=r"surface.by: expected a way to quads, got 'cubes'; did you mean 'cube'"):
        SurfaceOptions(by="cubes")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ConfigError, match=r"surface.split: expected a value from 1 to 64, got 0"):
        SurfaceOptions(split=0)
