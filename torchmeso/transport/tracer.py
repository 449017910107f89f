"""What light can meet: triangles with materials, once in the world or repeated in a tile.

`MeshTracer` is a finite scene. `TileTracer` is one period of a mesostructure that repeats in u and v between
z = -h and z = 0: rays that leave the unit cell on one side come in again on the other, so grazing rays see an
endless sheet (finite copies fail there).

Test: tests/transport/test_tracer.py
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.data import address
from torchmeso.errors import check_shape
from torchmeso.geometry.directions import dot, normalize
from torchmeso.geometry.rays import Hits, RayScene, offset
from torchmeso.transport.materials import Palette, Reflectance

MAX_CELLS = 512
"""Unit cells a ray may cross in a tile before it counts as lost (a ray parallel to the slab)."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Geometry:
    """Triangles with materials.

    Attributes:
        vertices: (V, 3).
        faces: (F, 3).
        part: (F,) row of the palette.
        palette: the materials.
        albedo_map: (H, W, 3) colour that multiplies the palette's albedo, or None.
        uv: (V, 2) where the map is looked up; None = at (x, y) of the vertex, as in a tile.
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    part: Int[Tensor, "F"]
    palette: Palette
    albedo_map: Float[Tensor, "H W 3"] | None = None
    uv: Float[Tensor, "V 2"] | None = None

    def __post_init__(self) -> None:
        """Raise ShapeError unless the arrays match."""
        check_shape("geometry.vertices", self.vertices, (-1, 3))
        check_shape("geometry.faces", self.faces, (-1, 3))
        check_shape("geometry.part", self.part, (len(self.faces),))


class Surface(NamedTuple):
    """What rays hit.

    Attributes:
        hit: (n,) whether there is anything; the rest is meaningless where not.
        t: (n,) distance.
        position: (n, 3).
        normal: (n, 3) geometric, unit, on the side the ray comes from.
        material: parameters at the points.
    """

    hit: Bool[Tensor, "n"]
    t: Float[Tensor, "n"]
    position: Float[Tensor, "n 3"]
    normal: Float[Tensor, "n 3"]
    material: Reflectance


@runtime_checkable
class Tracer(Protocol):
    """Something rays can be cast into."""

    def trace(self, origin: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"]) -> Surface:
        """Return the first surface along each ray."""
        ...

    def occluded(
        self, origin: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"], limit: Float[Tensor, "n"]
    ) -> Bool[Tensor, "n"]:
        """Return whether anything lies between the origin and the distance `limit` (inf = anywhere)."""
        ...

    def leave(self, surface: Surface) -> Float[Tensor, "n 3"]:
        """Return origins for rays that leave the hit points, clear of the surface itself."""
        ...


class MeshTracer:
    """A finite scene of one or several geometries."""

    def __init__(self, *geometries: Geometry):
        """Build the acceleration structures."""
        self._geometries = geometries
        first_vertex, first_face, vertices, faces = 0, [], [], []
        for g in geometries:
            first_face.append(sum(len(f) for f in faces))
            faces.append(g.faces + first_vertex)
            vertices.append(g.vertices)
            first_vertex += len(g.vertices)
        self._first_face = torch.tensor(first_face)
        self._vertices, self._faces = torch.cat(vertices), torch.cat(faces)
        self._scene = RayScene(self._vertices, self._faces)
        self._size = float((self._vertices.amax(0) - self._vertices.amin(0)).max()) + float(self._vertices.abs().max())

    def trace(self, origin: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"]) -> Surface:
        """Return the first surface along each ray."""
        hits = self._scene.first_hit(origin, direction)
        face = hits.face.clamp(min=0)
        position = (hits.barycentric.unsqueeze(-1) * self._vertices[self._faces[face]]).sum(1)
        normal = _facing_normal(self._vertices, self._faces, face, direction)
        return Surface(hits.face >= 0, hits.t, position, normal, self._materials(face, hits))

    def occluded(
        self, origin: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"], limit: Float[Tensor, "n"]
    ) -> Bool[Tensor, "n"]:
        """Return whether anything lies between the origin and the distance `limit` (inf = anywhere)."""
        return self._scene.occluded(origin, direction, limit)

    def leave(self, surface: Surface) -> Float[Tensor, "n 3"]:
        """Return origins for rays that leave the hit points, clear of the surface itself."""
        return offset(surface.position, surface.normal, self._size)

    def first_hits(self, origin: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"]) -> tuple[Hits, Tensor]:
        """Return raw hits, and which geometry each belongs to (meaningless where nothing is hit)."""
        hits = self._scene.first_hit(origin, direction)
        return hits, torch.bucketize(hits.face.clamp(min=0), self._first_face, right=True) - 1

    def _materials(self, face: Tensor, hits: Hits) -> Reflectance:
        owner = torch.bucketize(face, self._first_face, right=True) - 1
        parts = Reflectance(torch.zeros(len(face), 3), torch.ones(len(face)), torch.zeros(len(face), 3))
        for k, g in enumerate(self._geometries):
            mine = (owner == k).nonzero()[:, 0]
            own = face[mine] - self._first_face[k]
            uv = None
            if g.uv is not None:
                uv = (hits.barycentric[mine].unsqueeze(-1) * g.uv[g.faces[own]]).sum(1)
            found = reflectance(g, own, uv)
            for whole, piece in zip(parts, found, strict=True):
                whole[mine] = piece
        return parts


class TileTracer:
    """One period of a mesostructure in [0, 1]^2 x [-h, 0], repeated without end in u and v."""

    def __init__(self, geometry: Geometry, h: float):
        """Build the acceleration structure; triangles that stick out of the cell are brought in from all sides."""
        self._geometry, self._h = geometry, h
        self._margin = 1e-4  # tile units around cell and slab, so that nothing on a border is missed
        vertices, faces, source = unit_cell(geometry.vertices, geometry.faces, self._margin)
        self._vertices, self._faces, self._source = vertices, faces, source
        self._scene = RayScene(vertices, faces)

    def trace(self, origin: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"]) -> Surface:
        """Return the first surface along each ray; positions have x and y in the unit cell."""
        n = len(origin)
        t_total = torch.zeros(n)
        face = torch.full((n,), -1, dtype=torch.long)
        position = torch.zeros(n, 3)

        def record(active: Tensor, start: Tensor, way: Tensor, limit: Tensor, travelled: Tensor) -> Tensor:
            found = self._scene.first_hit(start, way, limit)
            struck = found.face >= 0
            ray = active[struck]
            face[ray] = found.face[struck]
            t_total[ray] = travelled[struck] + found.t[struck]
            position[ray] = start[struck] + found.t[struck, None] * way[struck]
            return struck

        self._walk(origin, direction, torch.full((n,), torch.inf), record)
        hit = face >= 0
        cell_face = face.clamp(min=0)
        normal = _facing_normal(self._vertices, self._faces, cell_face, direction)
        material = reflectance(self._geometry, self._source[cell_face], position[:, :2])
        return Surface(hit, torch.where(hit, t_total, torch.inf), position, normal, material)

    def occluded(
        self, origin: Float[Tensor, "n 3"], direction: Float[Tensor, "n 3"], limit: Float[Tensor, "n"]
    ) -> Bool[Tensor, "n"]:
        """Return whether anything of the endless sheet lies between the origin and the distance `limit`."""
        blocked = torch.zeros(len(origin), dtype=torch.bool)

        def record(active: Tensor, start: Tensor, way: Tensor, reach: Tensor, travelled: Tensor) -> Tensor:
            struck = self._scene.occluded(start, way, reach)
            blocked[active[struck]] = True
            return struck

        self._walk(origin, direction, limit, record)
        return blocked

    def leave(self, surface: Surface) -> Float[Tensor, "n 3"]:
        """Return origins for rays that leave the hit points, clear of the surface itself."""
        return offset(surface.position, surface.normal, 1.0)

    def _walk(self, origin: Tensor, direction: Tensor, limit: Tensor, record) -> None:
        """Cast rays cell by cell; `record` casts those still alive and says which are done."""
        active = torch.arange(len(origin))
        start = torch.cat([origin[:, :2] - origin[:, :2].floor(), origin[:, 2:]], 1)
        way = direction
        travelled = torch.zeros(len(origin))
        reach = torch.minimum(limit, self._slab_exit(start, way))
        for _ in range(MAX_CELLS):
            t_axis = torch.where(way[:, :2] > 0, 1 - start[:, :2], -start[:, :2]) / way[:, :2]
            t_axis = torch.where(way[:, :2] == 0, torch.inf, t_axis).clamp(min=0)
            t_cell, axis = t_axis.min(-1)
            done = record(active, start, way, torch.minimum(t_cell + self._margin, reach), travelled)
            alive = ~done & (t_cell < reach)
            if not bool(alive.any()):
                return
            active, way, axis, t_cell = active[alive], way[alive], axis[alive], t_cell[alive]
            start = start[alive] + t_cell[:, None] * way
            # Enter the next cell exactly on its border, whatever the rounding of the step.
            start.scatter_(1, axis[:, None], (way.gather(1, axis[:, None]) < 0).to(start.dtype))
            start[:, :2].clamp_(0, 1)
            travelled, reach = travelled[alive] + t_cell, reach[alive] - t_cell

    def _slab_exit(self, start: Tensor, way: Tensor) -> Tensor:
        """Return the distance at which a ray leaves the slab through its top or bottom; inf for a level ray."""
        top = (self._margin - start[:, 2]) / way[:, 2]
        bottom = (-self._h - self._margin - start[:, 2]) / way[:, 2]
        leave = torch.where(way[:, 2] > 0, top, bottom)
        return torch.where(way[:, 2] == 0, torch.inf, leave).clamp(min=0)


def unit_cell(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], margin: float
) -> tuple[Float[Tensor, "W 3"], Int[Tensor, "G 3"], Int[Tensor, "G"]]:
    """Return all periodic copies of the triangles that come within `margin` of the unit cell, and their originals."""
    corner = vertices[faces]
    low, high = corner[..., :2].amin(1), corner[..., :2].amax(1)
    first, last = (-(high.amax(0) + margin).floor()).int().tolist(), (1 - (low.amin(0) - margin).floor()).int().tolist()
    copies, source = [], []
    for i in range(first[0], last[0] + 1):
        for j in range(first[1], last[1] + 1):
            shift = torch.tensor([i, j], dtype=vertices.dtype)
            touches = ((low + shift <= 1 + margin) & (high + shift >= -margin)).all(-1)
            copies.append(corner[touches] + torch.cat([shift, shift.new_zeros(1)]))
            source.append(touches.nonzero()[:, 0])
    cell = torch.cat(copies)
    return cell.reshape(-1, 3), torch.arange(3 * len(cell)).reshape(-1, 3), torch.cat(source)


def _facing_normal(vertices: Tensor, faces: Tensor, face: Tensor, direction: Tensor) -> Tensor:
    """Return unit geometric normals of `face`, turned towards where the rays come from."""
    a, b, c = vertices[faces[face]].unbind(1)
    normal = normalize(torch.linalg.cross((b - a).double(), (c - a).double())).to(direction.dtype)
    return torch.where((dot(normal, direction) > 0)[:, None], -normal, normal)


def reflectance(g: Geometry, face: Int[Tensor, "n"], uv: Float[Tensor, "n 2"] | None) -> Reflectance:
    """Return the material of triangles, with the albedo map (where there is one) at `uv`."""
    part = g.part[face]
    albedo = g.palette.albedo[part]
    if g.albedo_map is not None:
        assert uv is not None
        taps = address.bilinear(uv, g.albedo_map.shape[0], g.albedo_map.shape[1])
        albedo = albedo * (g.albedo_map.reshape(-1, 3)[taps.texel] * taps.weight.unsqueeze(-1)).sum(-2)
    return Reflectance(albedo, g.palette.alpha[part], g.palette.f0[part])
