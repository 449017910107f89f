"""What a mesh file holds, as it was found: triangles, texture coordinates, frames, and named parts with their looks.

OBJ and glTF are read here (`geometry.obj`, `geometry.gltf`), because trimesh drops names of materials, tangents and
normal maps; PLY, OFF, STL and the rest through trimesh.

Test: tests/geometry/test_mesh_file.py
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.errors import FormatError, GeometryError, check_range, check_shape

Picture = Path | bytes
"""Where a picture lies, or its file's content."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Finish:
    """The look a file gives to a part: diffuse colour and normal map. Other properties are not read.

    Attributes:
        albedo: linear RGB; a factor where there is a map.
        albedo_map: colour (sRGB), or None.
        normal_map: normals in the local frame, (n + 1) / 2, green along +v, or None.
        normal_scale: factor of the map's x and y.
    """

    albedo: tuple[float, float, float] = (0.6, 0.6, 0.6)
    albedo_map: Picture | None = None
    normal_map: Picture | None = None
    normal_scale: float = 1.0


class Group(NamedTuple):
    """A named part of a mesh: `usemtl` of an OBJ file, a material of a glTF file."""

    name: str
    finish: Finish | None


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class MeshFile:
    """A mesh as it was found.

    Attributes:
        vertices: (V, 3) world, float64 where the file says as much.
        faces: (F, 3).
        uv: (V, 2) v up; None where a face has none.
        normals: (V, 3) unit, as the file gives them together with tangents; None elsewhere.
        tangents: (V, 4) unit, along +u, and the sign of the frame: b = sign (n x t); None where there are none.
        part: (F,) row of `groups`.
        groups: named parts.
        uv_sets: sets of texture coordinates there are to choose from.
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    uv: Float[Tensor, "V 2"] | None
    normals: Float[Tensor, "V 3"] | None = None
    tangents: Float[Tensor, "V 4"] | None = None
    part: Int[Tensor, "F"]
    groups: tuple[Group, ...]
    uv_sets: int = 1

    def __post_init__(self) -> None:
        """Raise ShapeError or GeometryError unless there are sound triangles."""
        n = len(self.vertices)
        check_shape("mesh_file.vertices", self.vertices, (n, 3))
        check_shape("mesh_file.faces", self.faces, (-1, 3))
        check_shape("mesh_file.part", self.part, (len(self.faces),))
        for name, width in (("uv", 2), ("normals", 3), ("tangents", 4)):
            if getattr(self, name) is not None:
                check_shape(f"mesh_file.{name}", getattr(self, name), (n, width))
        if len(self.faces) == 0:
            raise GeometryError("expected triangles, got none")
        if int(self.faces.min()) < 0 or int(self.faces.max()) >= n:
            raise GeometryError(f"expected vertices 0 to {n - 1} in faces, got {int(self.faces.max())}")
        if not torch.isfinite(self.vertices).all():
            raise GeometryError("expected finite vertex positions, got NaN or infinity")


def read(path: str | Path, *, uv_set: int = 0) -> MeshFile:
    """Return what a mesh file holds.

    Args:
        path: OBJ, glTF, GLB, or anything that trimesh reads (PLY, OFF, STL, ...).
        uv_set: which of a glTF file's sets of texture coordinates to take.

    Raises:
        FormatError: the file is missing or unreadable.
        GeometryError: it holds no triangles, coordinates that are not finite, or not that set.
    """
    from torchmeso.geometry import gltf, obj

    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: expected a mesh file, found none; check the path")
    check_range("uv_set", uv_set, 0, 15)
    suffix = path.suffix.lower()
    try:
        if suffix in (".glb", ".gltf"):
            return gltf.read(path, uv_set)
        if uv_set:
            raise GeometryError(f"expected uv_set 0, got {uv_set}; only glTF files hold several sets")
        return obj.read(path) if suffix == ".obj" else _read_trimesh(path)
    except GeometryError as error:
        raise GeometryError(f"{path.name}: {error}") from error


def _read_trimesh(path: Path) -> MeshFile:
    import trimesh

    try:
        loaded = trimesh.load(path, process=False)
    except Exception as error:  # trimesh raises whatever its many readers raise
        raise FormatError(f"{path}: trimesh could not read it ({type(error).__name__}: {error})") from error
    parts = list(loaded.dump()) if isinstance(loaded, trimesh.Scene) else [loaded]
    parts = [part for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not parts:
        raise GeometryError("expected triangles, got none")
    first = np.cumsum([0, *(len(part.vertices) for part in parts)])
    uvs = [getattr(part.visual, "uv", None) for part in parts]
    found = [uv for uv in uvs if uv is not None and len(uv)]
    names = [path.stem] if len(parts) == 1 else [str(p.metadata.get("name", i)) for i, p in enumerate(parts)]
    return MeshFile(
        vertices=torch.from_numpy(np.concatenate([part.vertices for part in parts]).astype(np.float64)),
        faces=torch.from_numpy(
            np.concatenate([part.faces + n for part, n in zip(parts, first[:-1], strict=True)]).astype(np.int64)
        ),
        uv=torch.from_numpy(np.concatenate(found).astype(np.float32)) if len(found) == len(parts) else None,
        part=torch.arange(len(parts)).repeat_interleave(torch.tensor([len(p.faces) for p in parts])),
        groups=tuple(Group(name, None) for name in names),
        uv_sets=int(len(found) == len(parts)),
    )
