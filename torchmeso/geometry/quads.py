"""Meshes of quads: turned the same way round, split into smaller ones, and cut into triangles that know their quad.

A quad's sides run from its first vertex on, anticlockwise as seen from outside; places in it are (a, b) in [0, 1]^2,
a along its first side, b along its last one backwards: (0, 0), (1, 0), (1, 1), (0, 1) are its vertices.

Test: tests/geometry/test_quads.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.errors import GeometryError, check_range, check_shape

SIDES = 4


class QuadMesh(NamedTuple):
    """Quads.

    Attributes:
        vertices: (V, 3) float64.
        quads: (Q, 4) vertices, anticlockwise as seen from outside.
    """

    vertices: Float[Tensor, "V 3"]
    quads: Int[Tensor, "Q 4"]


class Patches(NamedTuple):
    """A surface of triangles, each of which lies in one quad.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) anticlockwise as seen from outside.
        cell: (F,) quad of each triangle.
        place: (F, 3, 2) where each corner lies in it, float64.
        quads: (Q, 4) numbers of the quads' corners; those that share two of them meet there.
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    cell: Int[Tensor, "F"]
    place: Float[Tensor, "F 3 2"]
    quads: Int[Tensor, "Q 4"]


class Edges(NamedTuple):
    """Sides of faces that share two vertices.

    Attributes:
        number: (F, K) of the edge at each side.
        beside: (F, K) the side beyond it, face * K + side; -1 at a border.
        along: (F, K) whether both run through their vertices in the same order: then one of them is turned over.
    """

    number: Int[Tensor, "F K"]
    beside: Int[Tensor, "F K"]
    along: Bool[Tensor, "F K"]


def edges(faces: Int[Tensor, "F K"]) -> Edges:
    """Return which sides of faces meet.

    Raises:
        GeometryError: an edge has more than two faces.
    """
    ends = torch.stack([faces, faces.roll(-1, 1)], -1).flatten(0, 1)
    _, edge, count = ends.sort(1).values.unique(dim=0, return_inverse=True, return_counts=True)
    order = edge.argsort(stable=True)
    first = torch.cat([count.new_zeros(1), count.cumsum(0)[:-1]])
    if bool((count > 2).any()):
        face = int(order[first[count > 2][0]]) // faces.shape[1]
        raise GeometryError(f"faces: expected at most two at an edge, got more beside face {face}; take them apart")
    one, other = order[first[count == 2]], order[first[count == 2] + 1]
    beside = torch.full((len(ends),), -1)
    beside[one], beside[other] = other, one
    along = torch.zeros(len(ends), dtype=torch.bool)
    along[one] = along[other] = ends[one, 0] == ends[other, 0]
    return Edges(edge.reshape(faces.shape), beside.reshape(faces.shape), along.reshape(faces.shape))


def mended(mesh: QuadMesh) -> tuple[QuadMesh, int]:
    """Return the quads all turned the same way round, closed bodies outwards, and how many were turned over.

    Raises:
        GeometryError: the surface has one side only, an edge has more than two quads, or a quad lacks four corners.
    """
    check_shape("vertices", mesh.vertices, (-1, 3))
    check_shape("quads", mesh.quads, (-1, SIDES))
    ordered = mesh.quads.sort(1).values
    flat = (ordered[:, 1:] == ordered[:, :-1]).any(1)
    if bool(flat.any()):
        face = int(flat.nonzero()[0])
        raise GeometryError(
            f"quads: expected four different corners, got {mesh.quads[face].tolist()} at face {face}; make it a quad"
        )
    if not bool(mesh.vertices.isfinite().all()):
        raise GeometryError("quads: expected finite positions, got NaN or infinity")
    found = edges(mesh.quads)
    body, turned = _sides(found)
    quads = torch.where(turned[:, None], mesh.quads.flip(1), mesh.quads)
    border = torch.zeros(int(body.max()) + 1 if len(body) else 0, dtype=torch.bool)
    border[body[(found.beside < 0).any(1)]] = True
    volume = torch.zeros(len(border), dtype=torch.float64).index_add_(0, body, _volume(mesh.vertices.double(), quads))
    # Of a body with borders most quads were right; a closed one has an inside.
    count = torch.zeros(len(border), dtype=torch.long).index_add_(0, body, turned.long())
    all_ = body.bincount(minlength=len(border))
    other_way = torch.where(border, 2 * count > all_, volume < 0)[body]
    quads = torch.where(other_way[:, None], quads.flip(1), quads)
    # Begun where they were, so that a mesh in order stays as it is.
    first = (quads == mesh.quads[:, :1]).int().argmax(1)
    quads = quads.gather(1, (torch.arange(SIDES) + first[:, None]) % SIDES)
    return QuadMesh(mesh.vertices, quads), int((turned != other_way).sum())


def _sides(found: Edges) -> tuple[Int[Tensor, "Q"], Bool[Tensor, "Q"]]:
    """Return the body of each quad, and whether it is turned over beside the body's first."""
    near, along = found.beside.tolist(), found.along.tolist()
    body, turned, bodies = [-1] * len(near), [False] * len(near), 0
    for start in range(len(near)):
        if body[start] >= 0:
            continue
        body[start], waiting = bodies, [start]
        bodies += 1
        for face in waiting:
            for side, there in enumerate(near[face]):
                other, wanted = there // SIDES, turned[face] != along[face][side]
                if there < 0:
                    continue
                if body[other] < 0:
                    body[other], turned[other] = body[face], wanted
                    waiting.append(other)
                elif turned[other] != wanted:
                    raise GeometryError(
                        f"quads: expected a surface with two sides, got one that comes back turned over at face "
                        f"{other}; cut it there"
                    )
    return torch.tensor(body, dtype=torch.long), torch.tensor(turned, dtype=torch.bool)


def _volume(vertices: Tensor, quads: Tensor) -> Float[Tensor, "Q"]:
    p = vertices[quads]
    return sum((p[:, 0] * torch.linalg.cross(p[:, k], p[:, k + 1])).sum(-1) / 6 for k in (1, 2))  # type: ignore[return-value]


class Split(NamedTuple):
    """Smaller quads.

    Attributes:
        mesh: the quads; those of one follow one another, row by row along b, begun as it is.
        quad: (n,) which quad each lies in.
        corner: (n, 2) place of its first corner there, in parts of the side.
    """

    mesh: QuadMesh
    quad: Int[Tensor, "n"]
    corner: Int[Tensor, "n 2"]


def split(mesh: QuadMesh, parts: int) -> Split:
    """Return each quad as `parts` x `parts` smaller ones, bilinear, of the same bits on both sides of an edge.

    Raises:
        ConfigError: `parts` is not in 1..64.
    """
    check_range("quads.parts", parts, 1, 64)
    vertices, quads, n, inner = mesh.vertices.double(), mesh.quads, parts, parts - 1
    number = edges(quads).number
    edge = int(number.max()) + 1 if len(quads) else 0
    low, high = quads.minimum(quads.roll(-1, 1)), quads.maximum(quads.roll(-1, 1))
    ends = torch.zeros(edge, 2, dtype=torch.long)
    ends[number.flatten()] = torch.stack([low, high], -1).flatten(0, 1)
    share = (torch.arange(1, n, dtype=torch.float64) / n)[:, None]
    on_edges = torch.lerp(vertices[ends[:, None, 0]], vertices[ends[:, None, 1]], share)
    b, a = torch.meshgrid(share[:, 0], share[:, 0], indexing="ij")
    weight = torch.stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b], -1).flatten(0, 1)
    inside = torch.einsum("nk,qkd->qnd", weight, vertices[quads])
    points = torch.cat([vertices, on_edges.flatten(0, 1), inside.flatten(0, 1)])
    # Numbers of the points of each quad's grid, [q, b, a].
    grid = torch.zeros(len(quads), n + 1, n + 1, dtype=torch.long)
    along = torch.arange(inner)
    for side in range(SIDES):
        upwards = quads[:, side] < quads.roll(-1, 1)[:, side]
        step = torch.where(upwards[:, None], along, inner - 1 - along)
        own = len(vertices) + number[:, side, None] * inner + step
        if side == 0:
            grid[:, 0, 1:n] = own
        elif side == 1:
            grid[:, 1:n, n] = own
        elif side == 2:
            grid[:, n, 1:n] = own.flip(1)
        else:
            grid[:, 1:n, 0] = own.flip(1)
    grid[:, 0, 0], grid[:, 0, n], grid[:, n, n], grid[:, n, 0] = quads.unbind(1)
    count = torch.arange(len(quads) * inner**2).reshape(len(quads), inner, inner)
    grid[:, 1:n, 1:n] = len(vertices) + edge * inner + count
    small = torch.stack([grid[:, :-1, :-1], grid[:, :-1, 1:], grid[:, 1:, 1:], grid[:, 1:, :-1]], -1)
    b_, a_ = torch.meshgrid(torch.arange(n), torch.arange(n), indexing="ij")
    corner = torch.stack([a_, b_], -1).reshape(-1, 2).repeat(len(quads), 1)
    made = QuadMesh(points, small.reshape(-1, SIDES))
    return Split(made, torch.arange(len(quads)).repeat_interleave(n * n), corner)


def patches(mesh: QuadMesh, parts: int = 1) -> Patches:
    """Return quads as triangles, two for each of the `parts` x `parts` smaller quads of each.

    Raises:
        ConfigError: `parts` is not in 1..64.
    """
    fine = split(mesh, parts)
    corner = torch.tensor([[0, 0], [1, 0], [1, 1], [0, 1]])
    place = (fine.corner[:, None] + corner) / torch.tensor(parts, dtype=torch.float64)
    p = fine.mesh.vertices[fine.mesh.quads]
    # Along the shorter diagonal: folds of bent quads stay small.
    turn = ((p[:, 1] - p[:, 3]).norm(dim=-1) < (p[:, 0] - p[:, 2]).norm(dim=-1)).long()
    which = (torch.tensor([[0, 1, 2], [0, 2, 3]]) + turn[:, None, None]) % SIDES
    faces = fine.mesh.quads[:, None].expand(-1, 2, -1).gather(2, which)
    places = place[:, None].expand(-1, 2, -1, -1).gather(2, which[..., None].expand(-1, -1, -1, 2))
    cell = fine.quad.repeat_interleave(2)
    return Patches(fine.mesh.vertices, faces.flatten(0, 1), cell, places.flatten(0, 1), mesh.quads)
