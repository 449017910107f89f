import pytest
import torch
import trimesh

from torchmeso.errors import ConfigError, FormatError, GeometryError, ShapeError
from torchmeso.geometry import mesh_file
from torchmeso.geometry.mesh_file import Group, MeshFile


def test_what_trimesh_reads_is_one_part(tmp_path):
    trimesh.creation.box().export(tmp_path / "box.off")
    found = mesh_file.read(tmp_path / "box.off")
    assert [group.name for group in found.groups] == ["box"]
    assert found.uv is None
    assert found.uv_sets == 0
    assert len(found.faces) == len(found.part) == 12


@pytest.mark.errors
def test_refusals(tmp_path):
    with pytest.raises(FormatError, match=r"none\.obj: expected a mesh file, found none"):
        mesh_file.read(tmp_path / "none.obj")
    trimesh.creation.box().export(tmp_path / "box.off")
    with pytest.raises(GeometryError, match=r"box\.off: expected uv_set 0, got 1; only glTF"):
        mesh_file.read(tmp_path / "box.off", uv_set=1)
    with pytest.raises(ConfigError, match="uv_set"):
        mesh_file.read(tmp_path / "box.off", uv_set=-1)
    face = torch.tensor([[0, 1, 3]])
    with pytest.raises(GeometryError, match="expected vertices 0 to 2 in faces, got 3"):
        MeshFile(vertices=torch.eye(3), faces=face, uv=None, part=torch.zeros(1).long(), groups=(Group("", None),))
    with pytest.raises(GeometryError, match="expected triangles, got none"):
        MeshFile(vertices=torch.eye(3), faces=face[:0], uv=None, part=face[:0, 0], groups=(Group("", None),))
    with pytest.raises(ShapeError, match=r"mesh_file\.uv: expected shape \(3, 2\), got \(3, 3\)"):
        MeshFile(
            vertices=torch.eye(3),
            faces=face % 3,
            uv=torch.eye(3),
            part=torch.zeros(1).long(),
            groups=(Group("", None),),
        )
