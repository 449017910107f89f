import math

import numpy as np
import pytest
import torch
import trimesh

from torchmeso.errors import FormatError, GeometryError, ShapeError
from torchmeso.geometry import mesh as mesh_module
from torchmeso.geometry import shapes
from torchmeso.geometry.mesh import Mesh, anisotropy, dress, load, transform

QUAD = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
QUAD_UV = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
QUAD_FACES = torch.tensor([[0, 1, 2], [0, 2, 3]])


def test_flat_square_has_the_obvious_frame():
    mesh = dress(QUAD, QUAD_FACES, 2 * QUAD_UV)
    assert torch.allclose(mesh.normals, torch.tensor([0.0, 0, 1]).expand(4, 3))
    assert torch.allclose(mesh.tangents, torch.tensor([1.0, 0, 0]).expand(4, 3))
    assert torch.allclose(mesh.scale, torch.full((4,), 0.5))
    assert mesh.closed.tolist() == [False]


def test_mirrored_texture_has_a_left_handed_frame():
    mesh = dress(QUAD, QUAD_FACES, QUAD_UV * torch.tensor([-1.0, 1.0]))
    assert (mesh.sign == -1).all()
    assert torch.allclose(mesh.tangents, torch.tensor([-1.0, 0, 0]).expand(4, 3))
    b = mesh.sign[:, None] * torch.linalg.cross(mesh.normals, mesh.tangents)
    assert torch.allclose(b, torch.tensor([0.0, 1, 0]).expand(4, 3))  # still along +v


def test_mirror_line_splits_vertices():
    """Two squares share an edge on which the texture turns back."""
    vertices = torch.tensor([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0], [-1, 1, 0], [0, 1, 0], [1, 1, 0]])
    faces = torch.tensor([[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]])
    uv = torch.stack([vertices[:, 0].abs(), vertices[:, 1]], -1)
    mesh = dress(vertices, faces, uv)
    assert len(mesh.vertices) == 8
    assert sorted(mesh.sign.tolist()) == [-1] * 4 + [1] * 4


@pytest.mark.filterwarnings("ignore:mesh. the texture is stretched")
def test_box_keeps_its_creases():
    box = trimesh.creation.box()
    uv = torch.from_numpy(np.ascontiguousarray(box.vertices[:, :2] + box.vertices[:, 2:] * 0.3)).float()
    mesh = dress(torch.from_numpy(box.vertices.copy()).float(), torch.from_numpy(box.faces.copy()).long(), uv)
    p = mesh.vertices[mesh.faces]
    face_normal = torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    face_normal = torch.nn.functional.normalize(face_normal, dim=-1)
    assert torch.allclose(mesh.normals[mesh.faces], face_normal[:, None].expand(-1, 3, 3), atol=1e-6)
    assert mesh.closed.tolist() == [True]


def test_seam_of_a_tiled_torus_does_not_show_in_the_frame():
    mesh = shapes.torus(triangles=2_000)
    _, group = torch.unique(mesh.vertices, dim=0, return_inverse=True)
    for values in (mesh.normals, mesh.tangents, mesh.scale[:, None]):
        low = torch.full((int(group.max()) + 1, values.shape[1]), torch.inf)
        low.scatter_reduce_(0, group[:, None].expand_as(values), values, "amin")
        assert (values - low[group]).abs().max() < 1e-6


def test_inward_mesh_is_turned_with_a_warning():
    sphere = shapes.sphere(triangles=400)
    with pytest.warns(UserWarning, match="looked inwards and were turned"):
        mesh = dress(sphere.vertices, sphere.faces.flip(1), sphere.uv)
    assert (mesh.vertices * mesh.normals).sum(-1).min() > 0.5


def test_stretched_texture_is_reported():
    with pytest.warns(UserWarning, match=r"stretched by a mean factor of 4\.0"):
        mesh = dress(QUAD * torch.tensor([4.0, 1.0, 1.0]), QUAD_FACES, QUAD_UV)
    assert anisotropy(mesh) == pytest.approx(4, rel=1e-5)


def test_needles_and_points_do_not_poison_the_frame():
    vertices = torch.cat([QUAD, torch.tensor([[0.5, 0.5, 0.0]])])
    faces = torch.cat([QUAD_FACES, torch.tensor([[0, 4, 2], [1, 1, 2]])])
    mesh = dress(vertices, faces, torch.cat([QUAD_UV, torch.tensor([[0.5, 0.5]])]))
    for values in (mesh.normals, mesh.tangents, mesh.scale):
        assert torch.isfinite(values).all()


def test_transform_moves_and_scales():
    angle = math.radians(30)
    matrix = torch.eye(4)
    matrix[:2, :2] = 2 * torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    matrix[2, 2] = 2
    matrix[0, 3] = 7
    moved = transform(dress(QUAD, QUAD_FACES, QUAD_UV), matrix)
    assert torch.allclose(moved.scale, torch.full((4,), 2.0))
    assert torch.allclose(moved.vertices[0], torch.tensor([7.0, 0, 0]))
    assert torch.allclose(moved.tangents[0], torch.tensor([math.cos(angle), math.sin(angle), 0]))


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
def test_files_round_trip(tmp_path, suffix):
    quad = trimesh.Trimesh(QUAD.numpy(), QUAD_FACES.numpy(), process=False)
    quad.visual = trimesh.visual.TextureVisuals(uv=QUAD_UV.numpy())
    quad.export(tmp_path / f"quad{suffix}")
    mesh = load(tmp_path / f"quad{suffix}")
    corner = torch.cat([mesh.vertices, mesh.uv], 1)[mesh.faces.flatten()]
    assert sorted(map(tuple, corner.tolist())) == sorted(
        map(tuple, torch.cat([QUAD, QUAD_UV], 1)[QUAD_FACES.flatten()].tolist())
    )


def test_real_mesh_is_closed_after_its_texture_seams_are_welded(data_dir):
    mesh = load(data_dir / "mesh" / "spot.obj")
    assert mesh.closed.all()
    assert len(mesh.faces) == 5856


@pytest.mark.errors
def test_meshes_that_cannot_be_dressed_say_why(tmp_path):
    with pytest.raises(FormatError, match=r"nothing\.obj: expected a mesh file, found none"):
        load(tmp_path / "nothing.obj")
    (tmp_path / "bad.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 3\n")
    with pytest.raises((FormatError, GeometryError), match=r"bad\.ply"):
        load(tmp_path / "bad.ply")
    trimesh.Trimesh(QUAD.numpy(), QUAD_FACES.numpy(), process=False).export(tmp_path / "bare.off")
    with pytest.raises(GeometryError, match=r"bare\.off: expected texture coordinates, got none; make some with"):
        load(tmp_path / "bare.off")
    (tmp_path / "points.obj").write_text("v 0 0 0\nv 1 0 0\n")
    with pytest.raises((GeometryError, FormatError), match=r"points\.obj"):
        load(tmp_path / "points.obj")
    (tmp_path / "nan.obj").write_text("v nan 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    with pytest.raises(GeometryError, match="finite"):
        load(tmp_path / "nan.obj")


@pytest.mark.errors
def test_arrays_that_cannot_be_dressed_say_why():
    with pytest.raises(GeometryError, match="world and texture area, got none"):
        dress(QUAD, QUAD_FACES, torch.zeros(4, 2))
    with pytest.raises(GeometryError, match="finite positions"):
        dress(QUAD * torch.nan, QUAD_FACES, QUAD_UV)
    with pytest.raises(GeometryError, match="rotation, positive uniform scale"):
        transform(dress(QUAD, QUAD_FACES, QUAD_UV), torch.diag(torch.tensor([1.0, 2.0, 1.0, 1.0])))
    square = dress(QUAD, QUAD_FACES, QUAD_UV)
    fields = {name: getattr(square, name) for name in Mesh.__dataclass_fields__}
    with pytest.raises(ShapeError, match=r"mesh\.uv: expected shape \(4, 2\), got \(3, 2\)"):
        Mesh(**{**fields, "uv": square.uv[:3]})
    assert mesh_module.CREASE_DEG == 60


def test_texture_coordinates_far_from_zero_are_moved_by_whole_tiles():
    near = dress(QUAD, QUAD_FACES, QUAD_UV)
    assert torch.equal(dress(QUAD, QUAD_FACES, QUAD_UV + torch.tensor([1024.0, -4096.0])).uv, near.uv)
    assert torch.equal(dress(QUAD, QUAD_FACES, QUAD_UV + 3).uv, near.uv + 3)  # a few tiles are no matter


def test_positions_far_from_the_origin_stay_sharp():
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[0, 3] = 1e6
    far = transform(dress(QUAD * 0.1, QUAD_FACES, QUAD_UV), matrix)
    assert far.vertices.dtype == torch.float64
    assert far.normals.dtype == torch.float32
    torch.testing.assert_close(far.vertices[:, 0] - 1e6, QUAD[:, 0].double() * 0.1, rtol=0, atol=1e-8)
    matrix[0, 3] = 1.0
    assert transform(dress(QUAD, QUAD_FACES, QUAD_UV), matrix).vertices.dtype == torch.float32


def test_files_far_from_the_origin_stay_sharp(tmp_path):
    lines = [f"v {x + 1e6:.4f} {y:.4f} {z:.4f}" for x, y, z in (QUAD * 0.1).tolist()]
    lines += [f"vt {u} {v}" for u, v in QUAD_UV.tolist()] + ["f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]
    (tmp_path / "far.obj").write_text("\n".join(lines))
    far = load(tmp_path / "far.obj")
    assert far.vertices.dtype == torch.float64
    assert far.normals.dtype == torch.float32
    assert (far.vertices[:, 0] - 1e6).abs().max() == pytest.approx(0.1, abs=1e-6)


def test_a_sheet_with_two_sides_keeps_one():
    both = torch.cat([QUAD_FACES, QUAD_FACES.flip(1)])
    with pytest.warns(UserWarning, match="2 faces lay back to back on others and were left out"):
        assert len(dress(QUAD, both, QUAD_UV).faces) == 2


@pytest.mark.errors
@pytest.mark.parametrize(
    ("change", "message"),
    [({"faces": QUAD_FACES + 9}, "expected vertex numbers from 0 to 3, got 9 to 12"),
     ({"faces": QUAD_FACES - 1}, "got -1 to 2"),
     ({"faces": QUAD_FACES[:0]}, "expected triangles, got none"),
     ({"vertices": QUAD * 1e20}, r"expected positions within 1e\+15 of the origin"),
     ({"uv": QUAD_UV * 1e9}, r"expected texture coordinates over at most 100000 tiles, got 1e\+09")],
)  # fmt: skip
def test_arrays_nothing_can_be_made_of(change, message):
    arrays = {"vertices": QUAD, "faces": QUAD_FACES, "uv": QUAD_UV, **change}
    with pytest.raises(GeometryError, match=message):
        dress(**arrays)
