"""Lay a mesostructure over a mesh as real triangles: the ground truth of every approximation here.

Every base triangle's prism is filled with the part of the tiled mesostructure that lies over its UV triangle:
the mesostructure's triangles are repeated over the texture plane, cut at the edges of the UV triangle, and
carried into the world by `geometry.prisms`. Neighbouring prisms agree on their common face and cut shared
edges at the same points, so the result has no cracks.

Test: tests/meso/test_displace.py
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.errors import check_memory
from torchmeso.geometry import clip, prisms
from torchmeso.geometry.clip import Polygons
from torchmeso.geometry.mesh import Mesh
from torchmeso.meso.mesostructure import Mesostructure
from torchmeso.transport.tracer import Geometry

PAIRS = 1 << 20
"""Pairs of base and mesostructure triangles cut at once."""

MEMORY_LIMIT = 12 << 30


class _Boxes(NamedTuple):
    low: Tensor  # (n, 2)
    high: Tensor  # (n, 2)


def displace(mesh: Mesh, meso: Mesostructure, *, max_edge: float | None = None) -> Geometry:
    """Return the triangles of `meso` laid over `mesh`, in world space.

    Args:
        mesh: the base surface (z = 0 of the slab lies on it).
        meso: one tile; it repeats over all texture coordinates the mesh uses.
        max_edge: split mesostructure triangles until no edge is longer (tile units): inside one prism the mapping
            bends a slanted triangle slightly, smaller pieces follow it. None leaves them as they are.

    Raises:
        SizeError: the result would not fit in memory.
    """
    tile = meso.geometry if max_edge is None else refine(meso.geometry, max_edge)
    corner = tile.vertices.double()[tile.faces]  # (M, 3, 3): u, v, z
    uv = mesh.uv.double()[mesh.faces]  # (F, 3, 2)
    jacobian = (uv[:, 1] - uv[:, 0])[:, :1] * (uv[:, 2] - uv[:, 0])[:, 1:]
    jacobian = jacobian - (uv[:, 1] - uv[:, 0])[:, 1:] * (uv[:, 2] - uv[:, 0])[:, :1]
    usable = (jacobian[:, 0].abs() > 1e-14).nonzero()[:, 0]
    _check_size(mesh, tile)

    vertices, parts, places = [], [], []
    for face, triangle, shift in _pairs(uv, usable, corner):
        moved = corner[triangle].clone()
        moved[..., :2] += shift[:, None]
        pieces, source = _cut_to(uv[face], moved)
        barycentric = prisms.barycentric(pieces[..., :2], uv[face][source][:, None].expand(-1, 3, 3, 2))
        world = prisms.to_world(mesh, face[source][:, None].expand(-1, 3), barycentric, pieces[..., 2])
        vertices.append(world.float())
        parts.append(tile.part[triangle[source]])
        places.append(pieces[..., :2].float())
    count = sum(len(v) for v in vertices)
    return Geometry(
        vertices=torch.cat(vertices).reshape(-1, 3) if count else torch.zeros(0, 3),
        faces=torch.arange(3 * count).reshape(-1, 3),
        part=torch.cat(parts) if count else torch.zeros(0, dtype=torch.long),
        palette=tile.palette,
        albedo_map=tile.albedo_map,
        uv=torch.cat(places).reshape(-1, 2) if count else torch.zeros(0, 2),
    )


def refine(geometry: Geometry, max_edge: float) -> Geometry:
    """Return the same surface with every triangle that has an edge longer than `max_edge` cut into four, repeatedly."""
    corner, part = geometry.vertices[geometry.faces], geometry.part
    while True:
        longest = (corner.roll(-1, 1) - corner).norm(dim=-1).amax(1)
        long = longest > max_edge
        if not bool(long.any()):
            break
        a, b, c = corner[long].unbind(1)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        quarter = [torch.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
        corner = torch.cat([corner[~long], *quarter])
        part = torch.cat([part[~long], part[long].repeat(4)])
    faces = torch.arange(3 * len(corner)).reshape(-1, 3)
    return replace(geometry, vertices=corner.reshape(-1, 3), faces=faces, part=part)


def _check_size(mesh: Mesh, tile: Geometry) -> None:
    p = mesh.uv.double()[mesh.faces]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    tiles = float((e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]).abs().sum()) / 2
    needed = (tiles * len(tile.faces) * 2 + 4 * len(mesh.faces)) * 3 * 40.0
    check_memory("displace", needed, MEMORY_LIMIT, "take fewer tiles or a coarser mesostructure")


def _pairs(uv: Tensor, usable: Tensor, corner: Tensor) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield (base faces, mesostructure triangles, integer shifts) whose boxes overlap, a batch at a time."""
    low, high = corner[..., :2].amin(1), corner[..., :2].amax(1)
    tile = _Boxes(low.amin(0), high.amax(0))
    base = _Boxes(uv[usable].amin(1), uv[usable].amax(1))
    # Copies of the tile that touch a base triangle's box: shift + tile box overlaps it.
    first = (base.low - tile.high).ceil().long()
    last = (base.high - tile.low).floor().long()
    n = (last - first + 1).clamp(min=0)
    copies = n[:, 0] * n[:, 1]
    owner = torch.repeat_interleave(copies)
    k = torch.arange(len(owner)) - (copies.cumsum(0) - copies)[owner]
    shift = torch.stack([first[owner, 0] + k % n[owner, 0], first[owner, 1] + k // n[owner, 0]], -1).double()
    step = max(1, (1 << 25) // max(len(corner), 1))
    pending: list[tuple[Tensor, Tensor, Tensor]] = []
    size = 0
    for start in range(0, len(owner), step):
        own, move = owner[start : start + step], shift[start : start + step]
        box_low, box_high = (base.low[own] - move)[:, None], (base.high[own] - move)[:, None]
        overlap = ((low <= box_high) & (high >= box_low)).all(-1)
        pair, triangle = overlap.nonzero().unbind(1)
        pending.append((usable[own[pair]], triangle, move[pair]))
        size += len(pair)
        if size >= PAIRS:
            yield from _batches(pending)
            pending, size = [], 0
    if size:
        yield from _batches(pending)


def _batches(pending: list[tuple[Tensor, Tensor, Tensor]]) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    face, triangle, shift = (torch.cat(x) for x in zip(*pending, strict=True))
    for start in range(0, len(face), PAIRS):
        part = slice(start, start + PAIRS)
        yield face[part], triangle[part], shift[part]


def _cut_to(
    base: Float[Tensor, "m 3 2"], triangles: Float[Tensor, "m 3 3"]
) -> tuple[Float[Tensor, "n 3 3"], Int[Tensor, "n"]]:
    """Return the parts of `triangles` (u, v, z) over their base UV triangle, and which pair each comes from."""
    polygons = Polygons(triangles, torch.full((len(triangles),), 3))
    alive = torch.arange(len(triangles))
    e1, e2 = base[:, 1] - base[:, 0], base[:, 2] - base[:, 0]
    side = torch.sign(e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0])
    for k in range(3):
        a, b = base[alive, k], base[alive, (k + 1) % 3]
        edge = (b - a) * side[alive, None]
        offset = polygons.points[..., :2] - a[:, None]
        distance = edge[:, None, 0] * offset[..., 1] - edge[:, None, 1] * offset[..., 0]
        polygons = clip.cut(polygons, distance)
        keep = (polygons.corners >= 3).nonzero()[:, 0]
        polygons, alive = Polygons(polygons.points[keep], polygons.corners[keep]), alive[keep]
    pieces, source = clip.fan(polygons)
    area = torch.linalg.cross(pieces[:, 1] - pieces[:, 0], pieces[:, 2] - pieces[:, 0]).norm(dim=-1)
    solid = (area > 1e-18).nonzero()[:, 0]
    return pieces[solid], alive[source[solid]]
