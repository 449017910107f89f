"""A mesostructure: one tile of geometry with materials, in the slab z in [-h, 0], repeating in u and v.

Triangles may stick out of the unit cell; they come in again on the other side. Sources are the generators
(`meso.generators`), height fields, and any triangle tile that trimesh reads.

Test: tests/meso/test_mesostructure.py
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data.height_field import HeightField
from torchmeso.errors import GeometryError, check_range
from torchmeso.geometry import mesh_file
from torchmeso.transport.materials import Palette
from torchmeso.transport.tracer import Geometry

Rgb = tuple[float, float, float]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Mesostructure:
    """One tile.

    Attributes:
        geometry: triangles in tile units (x = u, y = v, z in [-h, 0]) with their materials.
        h: slab depth in tile units.
    """

    geometry: Geometry
    h: float

    def __post_init__(self) -> None:
        """Raise ConfigError or GeometryError unless the material lies in the slab."""
        check_range("mesostructure.h", self.h, 1e-6, 10)
        if len(self.geometry.faces) == 0:
            raise GeometryError("mesostructure: expected at least one triangle, got none")
        low, high = self.geometry.vertices[:, 2].min(), self.geometry.vertices[:, 2].max()
        if high > 1e-6 or low < -self.h * (1 + 1e-5) - 1e-6:
            raise GeometryError(
                f"mesostructure: expected z from {-self.h:g} to 0 (0 = top), got {float(low):g} to {float(high):g}; "
                "move or scale the geometry, or set h"
            )


def from_height_field(
    field: HeightField,
    *,
    albedo: Rgb = (0.6, 0.6, 0.6),
    roughness: float = 0.5,
    f0: float = 0.0,
) -> Mesostructure:
    """Return the triangles of a height field: two per texel, corners at texel centres, closed over the border.

    Args:
        field: heights and colour.
        albedo: linear RGB, times the field's own colour where it has one (then usually white).
        roughness: GGX width of the coat.
        f0: reflectance of the coat at normal incidence; 0 = none.
    """
    height, width = field.height.shape
    column, row = torch.arange(width + 1), torch.arange(height + 1)
    u = _exact((column % width + 0.5) / width) + column // width
    v = _exact(1 - (row % height + 0.5) / height) - row // height
    z = field.height.float()[row % height][:, column % width]
    grid_u, grid_v = torch.meshgrid(u, v, indexing="xy")
    vertices = torch.stack([grid_u, grid_v, z], -1).reshape(-1, 3)
    number = torch.arange(len(vertices)).reshape(height + 1, width + 1)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = torch.stack([torch.stack([a, b, c], -1), torch.stack([a, c, d], -1)], 2).reshape(-1, 3)
    geometry = Geometry(
        vertices=vertices,
        faces=faces,
        part=torch.zeros(len(faces), dtype=torch.long),
        palette=palette((albedo, roughness, f0)),
        albedo_map=field.albedo,
    )
    return Mesostructure(geometry=geometry, h=field.h)


def from_file(
    path: str | Path, *, h: float | None = None, albedo: Rgb = (0.6, 0.6, 0.6), roughness: float = 0.5, f0: float = 0.0
) -> Mesostructure:
    """Return a tile from a mesh file: x = u and y = v in tile units, z up; moved so that its top is z = 0.

    Args:
        path: anything trimesh reads.
        h: slab depth; None = the extent of the geometry.
        albedo: linear RGB of the whole tile.
        roughness: GGX width of the coat.
        f0: reflectance of the coat at normal incidence; 0 = none.

    Raises:
        FormatError: the file is missing or unreadable.
        GeometryError: it has no triangles, or is deeper than `h`.
    """
    found = mesh_file.read(path)
    vertices, faces = found.vertices, found.faces
    vertices = (vertices - torch.tensor([0.0, 0.0, float(vertices[:, 2].max())])).float()
    depth = max(float(-vertices[:, 2].min()), 1e-6) if h is None else h
    part = torch.zeros(len(faces), dtype=torch.long)
    geometry = Geometry(vertices=vertices, faces=faces, part=part, palette=palette((albedo, roughness, f0)))
    return Mesostructure(geometry=geometry, h=depth)


def _exact(x: Float[Tensor, "n"]) -> Float[Tensor, "n"]:
    """Round to multiples of 2^-22, so that moving by whole tiles is exact and the border closes without a crack."""
    return (x * (1 << 22)).round() / (1 << 22)


def palette(*parts: tuple[Rgb, float, float]) -> Palette:
    """Return a palette from (albedo, roughness, f0) per part."""
    return Palette(
        albedo=torch.tensor([p[0] for p in parts], dtype=torch.float32),
        alpha=torch.tensor([p[1] for p in parts], dtype=torch.float32),
        f0=torch.tensor([[p[2]] * 3 for p in parts], dtype=torch.float32),
    )
