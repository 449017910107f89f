"""A surface of quads with a tile on each: the arrangement, which any set of tiles of its kind dresses.

leung2007tileable, section 4: what is kept are the colours of each quad's sides or corners, in the canonical order of
all sets of a kind; the tiles themselves are looked up in a set (`dress`), so that another set takes a look-up and no
tiling. Light and view come into the tile's own frame, because texture coordinates run along the quads' sides.

A file (.surface) holds the triangles, the places of their corners in quads, the colours, and where frames turn.

Test: tests/data/test_tiled_surface.py
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.data import store, tile_atlas
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.data.tile_set import MOST_COLOURS, Marks, TileSet
from torchmeso.errors import ConfigError, ShapeError, check_shape
from torchmeso.geometry import mesh as meshes
from torchmeso.geometry.mesh import Mesh
from torchmeso.geometry.mesh_file import Group, MeshFile

SLACK = 1e-6
"""Of a side, by which places may lie beyond their quad."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TiledSurface:
    """Triangles, the quads they lie in, and what tile lies there.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) anticlockwise as seen from outside.
        cell: (F,) quad of each triangle.
        place: (F, 3, 2) of each corner in its tile, east and north from the south-west corner, [0, 1]; float64.
        quads: (Q, 4) numbers of the quads' corners, the south side first, anticlockwise.
        colours: (Q, 4) int32 as those of `TileSet`.
        jumps: (n, 3) quad, side (south, east, north, west), and quarter turns anticlockwise of the frame beyond it.
        marks: what is coloured.
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    cell: Int[Tensor, "F"]
    place: Float[Tensor, "F 3 2"]
    quads: Int[Tensor, "Q 4"]
    colours: Int[Tensor, "Q 4"]
    jumps: Int[Tensor, "n 3"]
    marks: Marks = "edges"

    def __post_init__(self) -> None:
        """Raise ShapeError unless triangles, quads and colours fit."""
        faces, quads = len(self.faces), len(self.quads)
        for name, wanted in (
            ("vertices", (-1, 3)), ("faces", (faces, 3)), ("cell", (faces,)), ("place", (faces, 3, 2)),
            ("quads", (quads, 4)), ("colours", (quads, 4)), ("jumps", (-1, 3)),
        ):  # fmt: skip
            check_shape(f"surface.{name}", getattr(self, name), wanted)
        for name, x, end in (
            ("faces", self.faces, len(self.vertices)),
            ("cell", self.cell, quads),
            ("colours", self.colours, MOST_COLOURS),
        ):
            if not x.numel() or int(x.min()) < 0 or int(x.max()) >= end:
                found = f"{int(x.min())} to {int(x.max())}" if x.numel() else "none"
                raise ShapeError(f"surface.{name}: expected numbers from 0 to {end - 1}, got {found}")
        low, high = (float(x) for x in self.place.aminmax())
        if not (low >= -SLACK and high <= 1 + SLACK):
            raise ShapeError(f"surface.place: expected places in quads, 0 to 1, got {low:g} to {high:g}")


class Base(NamedTuple):
    """A surface ready for any set of tiles.

    Attributes:
        mesh: with places in tiles as texture coordinates: its texture scale is the length of a tile's side.
        cell: (V,) quad that each of its vertices belongs to.
    """

    mesh: Mesh
    cell: Int[Tensor, "V"]


class Dressed(NamedTuple):
    """A surface with tiles on it.

    Attributes:
        mesh: its texture coordinates are those of the exemplar, through
        map: what lays the exemplar out.
    """

    mesh: Mesh
    map: QuiltingMap


def base(surface: TiledSurface, name: str = "surface") -> Base:
    """Return the mesh of a surface: frames along the sides of its quads, each quad with vertices of its own.

    Raises:
        GeometryError: no triangle has an area.
    """
    key, corner = (surface.faces * len(surface.quads) + surface.cell[:, None]).flatten().unique(return_inverse=True)
    place = torch.zeros(len(key), 2, dtype=torch.float64)
    place[corner] = surface.place.flatten(0, 1).double()
    found = MeshFile(
        vertices=surface.vertices[key // len(surface.quads)],
        faces=corner.reshape(-1, 3),
        uv=place.float(),
        part=surface.cell,
        groups=(Group(name, None),),
    )
    mesh, cell = meshes.dress_parts(found, name=name)
    of_vertex = torch.zeros(len(mesh.vertices), dtype=torch.long)
    of_vertex[mesh.faces.flatten()] = cell.repeat_interleave(3)
    return Base(mesh, of_vertex)


def dress(ready: Base, surface: TiledSurface, tiles: TileSet) -> Dressed:
    """Return the surface with a set of tiles on it.

    Raises:
        ConfigError: the set is of another kind, or has no tile of the colours of some quad.
    """
    if tiles.marks != surface.marks:
        raise ConfigError(
            f"tiles: expected a set with coloured {surface.marks}, as the surface was laid out for, got {tiles.marks}; "
            "lay it out for this set"
        )
    atlas = tile_atlas.build(tiles)
    uv = atlas.coordinates(tiles.find(surface.colours)[ready.cell], ready.mesh.uv.double())
    length = (atlas.scale[0] * atlas.scale[1]) ** -0.5
    return Dressed(replace(ready.mesh, uv=uv.to(ready.mesh.uv.dtype), scale=ready.mesh.scale * length), atlas.map)


def save(surface: TiledSurface, path: str | Path, **meta: object) -> None:
    """Write a surface (.surface), with what `meta` says about how it was made.

    Raises:
        StorageError: the disk is full, or the place cannot be written to.
    """
    tensors = {
        "surface.vertices": surface.vertices, "surface.faces": surface.faces.int(), "surface.cell": surface.cell.int(),
        "surface.place": surface.place, "surface.quads": surface.quads.int(),
        "surface.colours": surface.colours.to(torch.uint8), "surface.jumps": surface.jumps.int(),
    }  # fmt: skip
    store.write_model(path, tensors, {"kind": "surface", "surface": {"marks": surface.marks, **meta}})


def load(path: str | Path) -> TiledSurface:
    """Return the surface in a file.

    Raises:
        FormatError: the file is missing, damaged, or holds no surface.
    """
    model = open_file(path)
    with store.reading(path):
        return TiledSurface(
            vertices=model.read("surface.vertices"),
            place=model.read("surface.place"),
            colours=model.read("surface.colours").int(),
            marks=model.meta["surface"]["marks"],
            **{name: model.read(f"surface.{name}").long() for name in ("faces", "cell", "quads", "jumps")},
        )


def open_file(path: str | Path) -> store.Model:
    """Return the file of a surface, nothing of it read but what it says about itself.

    Raises:
        FormatError: the file is missing, damaged, or holds no surface.
    """
    return store.open_kind(path, "surface", expected="a tiled surface (.surface)", make="torchmeso tile TILES MESH")


def describe(path: str | Path) -> dict[str, Any]:
    """Return facts about the surface in a file, by name.

    Raises:
        FormatError: as `load`.
    """
    found, about = load(path), open_file(path).meta["surface"]
    turned = found.jumps[:, 2].bincount(minlength=4)[1:].tolist() if len(found.jumps) else [0, 0, 0]
    return {
        "kind": "tiled surface",
        "mesh": f"{len(found.faces)} triangles in {len(found.quads)} quads, coloured {found.marks}",
        "frame jumps": f"{len(found.jumps)} edges (90 deg: {turned[0]}, 180: {turned[1]}, 270: {turned[2]})",
        **{name: value for name, value in about.items() if name != "marks"},
    }
