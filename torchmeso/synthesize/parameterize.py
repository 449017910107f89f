"""Quads on the surface of a mesh file, a tile's place each.

leung2007tileable, section 4.1: any parameterisation by quads that distorts little will do. Quads come from the mesh
itself (OBJ of quads), from a PolyCube map (OBJ with three texture coordinates), from a cube around it, or from
QuadriFlow (closed meshes).

Test: tests/synthesize/test_parameterize.py
"""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.errors import ConfigError, FormatError, GeometryError, check_range, did_you_mean
from torchmeso.geometry import components, cube_projection, mesh_file, obj, polycube, quadriflow, quads
from torchmeso.geometry.quads import Patches, QuadMesh

By = Literal["auto", "quads", "polycube", "cube", "quadriflow"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceOptions:
    """How a mesh is laid out in quads, a tile each.

    Attributes:
        by: where quads come from; auto = the mesh's own where all of its faces are quads, a PolyCube map where it has
            three texture coordinates, else a cube.
        split: tiles along a side of a quad, or of the cube; None = 1, and 8 of a cube.
        quads: about how many QuadriFlow makes, before they are split.
        smooth: smaller quads along a side of a tile; QuadriFlow's are laid back onto the mesh.
        seed: the same one gives the same arrangement.
    """

    by: By = "auto"
    split: int | None = None
    quads: int = 400
    smooth: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise ConfigError for dials out of range."""
        if self.by not in get_args(By):
            raise ConfigError(
                f"surface.by: expected a way to quads, got '{self.by}'{did_you_mean(self.by, get_args(By))}"
            )
        for name, value, most in (("split", self.split, 64), ("smooth", self.smooth, 32)):
            if value is not None:
                check_range(f"surface.{name}", value, 1, most)
        check_range("surface.quads", self.quads, 6, 100_000)


def of_file(path: str | Path, options: SurfaceOptions) -> Patches:
    """Return a mesh file's surface in quads.

    Raises:
        MesoError: the file is missing or unreadable, or has no quads of the kind that is asked for.
    """
    path = Path(path)
    if not path.is_file():
        raise FormatError(f"{path}: expected a mesh file, found none; check the path")
    make = {"quads": _own_quads, "polycube": _polycube, "cube": _cube, "quadriflow": _quadriflow}
    try:
        return make[way(path, options)](path, options)
    except GeometryError as error:
        raise GeometryError(f"{path.name}: {error}") from error


def way(path: str | Path, options: SurfaceOptions) -> By:
    """Return where the quads of a mesh file come from; `auto` looks into it."""
    path = Path(path)
    if options.by != "auto":
        return options.by
    if path.suffix.lower() != ".obj":
        return "cube"
    found = obj.read_polygons(path)
    if len(found.size) and bool((found.size == quads.SIDES).all()):
        return "quads"
    return "polycube" if bool((found.places[:, 2] != 0).any()) else "cube"


def _own_quads(path: Path, options: SurfaceOptions) -> Patches:
    """Return the surface of an OBJ file of quads."""
    if path.suffix.lower() != ".obj":
        raise GeometryError(
            "expected quads, which are read from OBJ files only; convert it, or take another way (cube)"
        )
    found = obj.read_polygons(path)
    other = found.size != quads.SIDES
    if bool(other.any()) or not len(other):
        raise GeometryError(
            f"expected faces of four corners, got {int(other.sum())} of {len(other)} with others; make them quads, or "
            "take another way (cube, quadriflow)"
        )
    points, number = _welded(found.vertices)
    mesh, turned = quads.mended(QuadMesh(points, number[found.vertex].reshape(-1, quads.SIDES)))
    if turned:
        warnings.warn(f"{path.name}: {turned} quads were turned over and were turned back", stacklevel=4)
    return quads.patches(quads.split(mesh, options.split or 1).mesh, options.smooth or 1)


def _polycube(path: Path, options: SurfaceOptions) -> Patches:
    """Return the surface of an OBJ file with three texture coordinates."""
    found = obj.read_polygons(path) if path.suffix.lower() == ".obj" else None
    if found is None or not bool((found.places[:, 2] != 0).any()) or bool((found.place < 0).any()):
        raise GeometryError(
            "expected three texture coordinates at each corner, a PolyCube map, which are read from OBJ files only; "
            "take another way (cube, quadriflow)"
        )
    if bool((found.size != 3).any()):
        raise GeometryError("expected triangles in a PolyCube map, got faces of other corners; make them triangles")
    pair, number = torch.stack([found.vertex, found.place], 1).unique(dim=0, return_inverse=True)
    return polycube.project(
        found.vertices[pair[:, 0]], number.reshape(-1, 3), found.places[pair[:, 1]], options.split or 1
    )


def _cube(path: Path, options: SurfaceOptions) -> Patches:
    """Return the surface of any mesh as it is seen from the middle."""
    return cube_projection.project(*_points(path), options.split or 8)


def _quadriflow(path: Path, options: SurfaceOptions) -> Patches:
    """Return the surface of a closed mesh in quads of about one size, along its own lines."""
    points, faces = _points(path)
    coarse = quadriflow.quads_of(points, faces, options.quads)
    return quadriflow.onto(
        quads.patches(quads.split(coarse, options.split or 1).mesh, options.smooth or 8), points, faces
    )


def _points(path: Path) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "F 3"]]:
    """Return positions and triangles of a mesh file, one vertex at each place."""
    found = mesh_file.read(path)
    points, number = _welded(found.vertices)
    faces = number[found.faces]
    return points, faces[~(faces == faces.roll(1, 1)).any(1)]


def _welded(vertices: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "V 3"], Int[Tensor, "n"]]:
    """Return the places of vertices, each once: files are often split along creases."""
    number = components.weld(vertices)
    points = torch.zeros(int(number.max()) + 1 if len(number) else 0, 3, dtype=torch.float64)
    points[number] = vertices.double()
    return points, number
