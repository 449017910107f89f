"""The shell around a mesh: one prism per triangle, cut into tetrahedra that rays walk through.

wang2004gdm, section 3.1 and Fig. 3: every triangle is extruded along its vertex normals, and every fin between two
prisms is two triangles. Here a fin's diagonal begins at the bottom of the corner with the lower number, so both of its
prisms cut it alike, and such diagonals always cut a prism into three tetrahedra:

    (a0 b0 c0 c1)  (a0 b1 b0 c1)  (a0 a1 b1 c1)        for corners a < b < c, 0 = bottom, 1 = top.

A ray then needs no planes, no rule for concave and convex fins, and no tolerance: seen along the ray, a vertex lies to
the left or to the right of another (`left_of`), the same whichever tetrahedron asks, so a ray that goes into a
tetrahedron comes out of it, and out of one of its other faces into the neighbour. Nothing can leak between them.

Where prisms would turn inside out, because the surface bends more sharply than the shell is deep, columns are shorter.

Test: tests/geometry/test_shell.py
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.errors import GeometryError, check_range
from torchmeso.geometry import components
from torchmeso.geometry.mesh import Mesh

BOTTOM, TOP, BORDER = -1, -2, -3
"""What lies behind a face of a tetrahedron without a neighbour: the base, the open air, the border of an open mesh."""

OUTWARD = torch.tensor([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
"""Corners of the face opposite each corner of a tetrahedron, counter-clockwise seen from outside."""

COLUMN = torch.tensor([[0, 1, 2, 2], [0, 1, 1, 2], [0, 0, 1, 2]])
END = torch.tensor([[0, 0, 0, 1], [0, 1, 0, 1], [0, 1, 1, 1]])
"""Corners of a prism's tetrahedra: columns in the order of their numbers, and which end."""

SHRINK, SHORTEST = 0.85, 1e-3
"""Columns of prisms inside out are shortened by this factor until they are not, or as short as that."""

LEAST_VOLUME = 0.02
"""Of a tetrahedron over that in a straight prism; below it a prism counts as inside out."""

Side = Literal["inward", "outward"]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Shell:
    """Prisms as tetrahedra; those of prism k have the numbers 3 k to 3 k + 2.

    Attributes:
        vertices: (2 C, 3) float64 world positions: bottom and top of each column.
        tets: (T, 4) vertices, positively oriented.
        uvz: (T, 4, 3) float64 texture coordinates of the corners; z in tile units, -h at the bottom, 0 at the top.
        neighbour: (T, 4) tetrahedron behind the face opposite each corner, or BOTTOM, TOP, BORDER.
        face: (F',) triangle of the mesh that each prism stands on.
        kept: (C,) share of its length that each column keeps.
    """

    vertices: Float[Tensor, "N 3"]
    tets: Int[Tensor, "T 4"]
    uvz: Float[Tensor, "T 4 3"]
    neighbour: Int[Tensor, "T 4"]
    face: Int[Tensor, "F"]
    kept: Float[Tensor, "C"]


class Boundary(NamedTuple):
    """Faces of tetrahedra through which rays come into a shell.

    Attributes:
        faces: (B, 3) vertices, counter-clockwise seen from outside.
        tet: (B,) the tetrahedron behind each.
        corner: (B,) its corner opposite the face.
        kind: (B,) BOTTOM, TOP or BORDER.
    """

    faces: Int[Tensor, "B 3"]
    tet: Int[Tensor, "B"]
    corner: Int[Tensor, "B"]
    kind: Int[Tensor, "B"]


def build(mesh: Mesh, h: float, *, side: Side = "inward") -> Shell:
    """Return the shell of depth `h` (tile units) around `mesh`.

    Vertices at one position share a column, along the mean of their normals and as long as the mean of their scales. A
    face that another one repeats carries no second prism: two in one place would have no neighbours.

    Args:
        mesh: the dressed mesh.
        h: depth of the slab.
        side: "inward": the mesh is the top of the shell; "outward": the bottom, as in the paper.

    Raises:
        ConfigError: `h` is out of range.
        GeometryError: no triangle of the mesh has an area.
    """
    check_range("shell: h", h, 0, 1e3)
    column = components.weld(mesh.vertices)
    corner = column[mesh.faces]
    a, b, c = corner.unbind(1)
    proper = (a != b) & (b != c) & (c != a)
    face = _first_of_each(corner, proper.nonzero()[:, 0])
    if not len(face):
        raise GeometryError("shell: expected at least one triangle with an area, got none")
    count = int(column.max()) + 1
    base, way = torch.zeros(count, 3, dtype=torch.float64), torch.zeros(count, 3, dtype=torch.float64)
    base[column] = mesh.vertices.double()
    shift = mesh.normals.double() * mesh.scale.double()[:, None]
    share = torch.zeros(count, dtype=torch.float64).index_add_(0, column, torch.ones(len(column), dtype=torch.float64))
    way.index_add_(0, column, shift)
    way = way / share[:, None].clamp(min=1) * h

    # Corners in the order of their columns; every other order turns the tetrahedra.
    order = corner[face].argsort(1)
    ordered = corner[face].gather(1, order)
    even = ((order[:, 1] - order[:, 0]) % 3 == 1)[:, None]
    tets = 2 * ordered[:, COLUMN] + END
    uv = mesh.uv.double()[mesh.faces[face]].gather(1, order[..., None].expand(-1, -1, 2))[:, COLUMN]
    z = ((END - 1).double() * h)[None, :, :, None].expand(len(face), 3, 4, 1)
    uvz = torch.cat([uv, z], -1)
    swapped = torch.tensor([1, 0, 2, 3])
    tets = torch.where(even[..., None], tets, tets[:, :, swapped]).reshape(-1, 4)
    uvz = torch.where(even[..., None, None], uvz, uvz[:, :, swapped]).reshape(-1, 4, 3)

    kept = _taper(base, way, tets, side)
    vertices = _columns(base, way * kept[:, None], side)
    return Shell(vertices=vertices, tets=tets, uvz=uvz, neighbour=_neighbours(tets), face=face, kept=kept)


def boundary(shell: Shell, *, base: Literal["solid", "open"] = "solid") -> Boundary:
    """Return the faces through which rays come in: tops and borders, and bottoms where the base is open.

    Kind by kind, so that what is left out of a view stands together.
    """
    kinds = [TOP, BORDER] + [BOTTOM] * (base == "open")
    tet, corner = torch.isin(shell.neighbour, torch.tensor(kinds)).nonzero().unbind(1)
    kind = shell.neighbour[tet, corner]
    order = kind.argsort(stable=True, descending=True)
    tet, corner = tet[order], corner[order]
    return Boundary(shell.tets[tet].gather(1, OUTWARD[corner]), tet, corner, kind[order])


def around(shell: Shell, point: Float[Tensor, "3"]) -> tuple[Int[Tensor, "k"], Float[Tensor, "k 3"]]:
    """Return the tetrahedra that a point lies in, and its texture coordinates there; several where a shell overlaps."""
    point = point.double()
    low, high = shell.vertices.aminmax(dim=0)
    none = torch.zeros(0, dtype=torch.long), torch.zeros(0, 3, dtype=torch.float64)
    if not bool(((point >= low) & (point <= high)).all()):
        return none
    corner = shell.vertices[shell.tets]
    near = ((corner.amin(1) <= point) & (corner.amax(1) >= point)).all(1).nonzero()[:, 0]
    if len(near) == 0:
        return none
    base = corner[near, 0]
    sides = (corner[near, 1:] - base[:, None]).mT
    proper = torch.linalg.det(sides).abs() > 1e-300
    near, base, sides = near[proper], base[proper], sides[proper]
    others = torch.linalg.solve(sides, (point - base)[..., None])[..., 0]
    share = torch.cat([1 - others.sum(1, keepdim=True), others], 1)
    inside = (share >= 0).all(1)
    return near[inside], (share[inside, :, None] * shell.uvz[near[inside]]).sum(1)


def left_of(
    p: Float[Tensor, "*batch 2"], q: Float[Tensor, "*batch 2"], p_id: Int[Tensor, "*batch"], q_id: Int[Tensor, "*batch"]
) -> Bool[Tensor, "*batch"]:
    """Return whether the origin lies to the left of the way from `p` to `q`; never the same for `q` to `p`.

    An origin on the line is taken to lie a little to the right of itself and by far less above: the same for all
    lines, so that a ray through a vertex or an edge finds its way as any other ray does.
    """
    area = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    across, up = (q - p).unbind(-1)
    tie = torch.where(up == 0, torch.where(across == 0, p_id < q_id, across > 0), up < 0)
    return torch.where(area == 0, tie, area > 0)


def _first_of_each(corner: Int[Tensor, "F 3"], face: Int[Tensor, "n"]) -> Int[Tensor, "m"]:
    """Return those of `face` that none before has the same corners as, in the same sense."""
    least = corner[face].argmin(1, keepdim=True)
    turned = corner[face].gather(1, (least + torch.arange(3)) % 3)
    first = np.unique(turned.numpy(), axis=0, return_index=True)[1]
    return face[torch.from_numpy(np.sort(first))]


def _columns(base: Tensor, way: Tensor, side: Side) -> Tensor:
    ends = (base - way, base) if side == "inward" else (base, base + way)
    return torch.stack(ends, 1).reshape(-1, 3)


def _taper(base: Tensor, way: Tensor, tets: Tensor, side: Side) -> Float[Tensor, "C"]:
    """Return the share of its length that each column keeps so that no tetrahedron is inside out."""
    kept = torch.ones(len(base), dtype=torch.float64)
    area = _base_area(base[tets // 2].reshape(-1, 3, 4, 3)).repeat_interleave(3)
    length = way.norm(dim=-1)
    while True:
        vertices = _columns(base, way * kept[:, None], side)
        p = vertices[tets]
        volume = torch.linalg.det(p[:, 1:] - p[:, :1])
        height = (length * kept)[tets // 2].mean(1)
        wrong = volume < LEAST_VOLUME * area * height  # of a straight prism: area * height
        columns = (tets[wrong] // 2).unique()
        columns = columns[kept[columns] > SHORTEST]
        if not len(columns):
            return kept
        kept[columns] *= SHRINK


def _base_area(corner: Float[Tensor, "F 3 4 3"]) -> Float[Tensor, "F"]:
    """Return twice the area of each prism's base; the first tetrahedron has all of its corners."""
    first = corner[:, 0, :3]
    return torch.linalg.cross(first[:, 1] - first[:, 0], first[:, 2] - first[:, 0]).norm(dim=-1)


def _neighbours(tets: Int[Tensor, "T 4"]) -> Int[Tensor, "T 4"]:
    """Return what lies behind each face; where more than two tetrahedra meet at one, all count as a border."""
    n = len(tets)
    triples = tets[:, OUTWARD].reshape(-1, 3)
    _, number, count = np.unique(np.sort(triples.numpy(), 1), axis=0, return_inverse=True, return_counts=True)
    number = torch.from_numpy(number.reshape(-1))
    order = number.argsort(stable=True)
    first = torch.from_numpy(np.concatenate([[0], count.cumsum()[:-1]]))
    pairs = torch.from_numpy(count == 2).nonzero()[:, 0]
    one, other = order[first[pairs]], order[first[pairs] + 1]
    # Faces on the same side of one another belong to a mesh that turns over: no way through.
    tops = (triples % 2).sum(1)
    found = torch.where(tops == 3, TOP, torch.where(tops == 0, BOTTOM, BORDER))
    found[one], found[other] = other // 4, one // 4
    return found.reshape(n, 4)
