import pytest
import torch

from torchmeso.errors import FormatError, GeometryError
from torchmeso.geometry import mesh, mesh_file, obj

TWO_PARTS = """mtllib looks.mtl
o Body
v 0 0 0 1 0 0
v 1 0 0 1 0 0
v 1 1 0 1 0 0
v 0 1 0 1 0 0
v 2 0 0 1 0 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl red
f 1/1 2/2 3/3 4/4
usemtl blue skin
f -4/-3 -1/-3 -3/-2   # the last three
usemtl red
f 1/1/9 2/2/9 3/3/9
"""


def test_parts_are_named_with_and_without_their_library(tmp_path):
    (tmp_path / "a.obj").write_text(TWO_PARTS)
    found = mesh_file.read(tmp_path / "a.obj")
    assert [group.name for group in found.groups] == ["red", "blue skin"]
    assert found.part.tolist() == [0, 0, 1, 0]
    assert found.groups[0].finish is None
    corner = found.vertices[found.faces]
    assert corner[0].tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0]]
    assert corner[1].tolist() == [[0, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert corner[2].tolist() == [[1, 0, 0], [2, 0, 0], [1, 1, 0]]
    assert found.uv is not None
    assert found.uv[found.faces[2]].tolist() == [[1, 0], [1, 0], [1, 1]]


def test_looks_come_from_the_library(tmp_path):
    (tmp_path / "a.obj").write_text(TWO_PARTS)
    (tmp_path / "looks.mtl").write_text(
        "newmtl red\nKd 0.8 0.1 0.1\n# nothing\nnewmtl blue skin\nmap_Kd -s 2 2 1 maps\\my colour.png\n"
        "map_Bump -bm 0.5 bump.png\nnorm normal.png\n"
    )
    red, blue = (group.finish for group in mesh_file.read(tmp_path / "a.obj").groups)
    assert red is not None
    assert (red.albedo, red.albedo_map, red.normal_map) == ((0.8, 0.1, 0.1), None, None)
    assert blue is not None
    assert blue.albedo == (1, 1, 1)
    assert blue.albedo_map == tmp_path / "maps" / "my colour.png"
    assert blue.normal_map == tmp_path / "normal.png"


def test_a_closed_body_of_two_parts_is_one_component(tmp_path):
    lines = [f"v {x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1)] + [
        "vt 0 0",
        "vt 1 0",
        "vt 1 1",
        "vt 0 1",
    ]
    quads = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    for i, quad in enumerate(quads):
        lines += [f"usemtl m{i % 2}", "f " + " ".join(f"{v}/{t + 1}" for t, v in enumerate(quad))]
    (tmp_path / "cube.obj").write_text("\n".join(lines))
    found = mesh_file.read(tmp_path / "cube.obj")
    body = mesh.dress_file(found)
    assert body.closed.tolist() == [True]
    assert torch.bincount(found.part).tolist() == [6, 6]


def test_texture_coordinates_that_some_faces_lack_are_none(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\nf 1 2 3\n")
    assert mesh_file.read(tmp_path / "a.obj").uv is None


@pytest.mark.parametrize("corners", ["1/1 2/2 3/3", "1/1/1 2/2/1 3/3/1", "1//1 2//1 3//1", "1 2 3", " 1/1  2/2 3/3 "])
@pytest.mark.parametrize("others", ["", "f 1/1 2/2 3/3\n", "f 1 2 3\n"])
def test_corners_are_written_in_many_ways(corners, others, tmp_path):
    (tmp_path / "a.obj").write_text(
        f"v 0 0 0\nv 1 0 0\nv 0 1 0 # end\nvt 0 0\nvt 1\nvt 0 1 0\nvn 0 0 1\nf {corners}\n{others}"
    )
    found = mesh_file.read(tmp_path / "a.obj")
    assert found.vertices[found.faces[0]].tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    textured = "//" not in corners and "/" in corners and others != "f 1 2 3\n"
    assert (found.uv is not None) == textured
    if found.uv is not None:
        assert found.uv[found.faces[0]].tolist() == [[0, 0], [1, 0], [0, 1]]


@pytest.mark.errors
@pytest.mark.parametrize(
    ("text", "kind", "message"),
    [
        ("v 0 0 0\nv 1 0 0\n", GeometryError, r"a\.obj: expected triangles, got none"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", FormatError, r"a\.obj: expected an OBJ file"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", FormatError, "names vertex 0; the first is 1"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf -0.7 2 3\n", FormatError, r"a\.obj: expected an OBJ file"),
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999\n", FormatError, r"a\.obj: expected an OBJ file"),
        ("v 0 0 0\nv 1 x 0\nv 0 1 0\nf 1 2 3\n", FormatError, r"a\.obj: expected an OBJ file"),
        ("v 0 0 0\nv 1 nan 0\nv 0 1 0\nf 1 2 3\n", GeometryError, "expected finite vertex positions"),
    ],
)
def test_what_cannot_be_read(text, kind, message, tmp_path):
    (tmp_path / "a.obj").write_text(text)
    with pytest.raises(kind, match=message):
        mesh_file.read(tmp_path / "a.obj")


@pytest.mark.errors
def test_polygons_that_are_none_are_refused(tmp_path):
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 zero\nf 1 1 1\n")
    with pytest.raises(FormatError, match=r"a\.obj: expected an OBJ file \("):
        obj.read_polygons(path)
    path.write_text("v 0 0 0\nf 1 1 2\n")
    with pytest.raises(GeometryError, match=r"a\.obj: expected faces of vertices 1 to 1, got others"):
        obj.read_polygons(path)
    path.write_text("v 0 0 nan\nf 1 1 1\n")
    with pytest.raises(GeometryError, match=r"a\.obj: expected finite coordinates, got NaN or infinity"):
        obj.read_polygons(path)


@pytest.mark.errors
def test_looks_that_are_no_numbers(tmp_path):
    (tmp_path / "looks.mtl").write_text("newmtl red\nKd red green blue\n")
    (tmp_path / "a.obj").write_text(TWO_PARTS)
    with pytest.raises(FormatError, match=r"looks\.mtl: expected numbers for Kd and -bm"):
        mesh_file.read(tmp_path / "a.obj")
