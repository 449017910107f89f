"""Triangle meshes cut along where a function is zero, again and again, without a crack.

The function is given at vertices and linear over each triangle that is cut. An edge is cut once, at a vertex that all
triangles beside it share (`divide`, which takes any points on edges).

Test: tests/geometry/test_plane_cut.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor


class Pieces(NamedTuple):
    """Triangles and what they are pieces of.

    Attributes:
        vertices: (V, D) positions, and whatever else is linear along edges.
        faces: (F, 3).
        source: (F,) triangle that each was at first.
    """

    vertices: Float[Tensor, "V D"]
    faces: Int[Tensor, "F 3"]
    source: Int[Tensor, "F"]


def whole(vertices: Float[Tensor, "V D"], faces: Int[Tensor, "F 3"]) -> Pieces:
    """Return triangles that are not cut yet."""
    return Pieces(vertices, faces, torch.arange(len(faces)))


def cut(
    pieces: Pieces, distance: Float[Tensor, "V"], which: Bool[Tensor, "F"] | None = None, *, slack: float = 0.0
) -> Pieces:
    """Return `pieces`, none of which lies on both sides of where `distance` is zero.

    Args:
        pieces: the triangles.
        distance: of each vertex.
        which: triangles to be cut; the others must not have an edge that is. None = all.
        slack: vertices this near are taken to lie on the cut.
    """
    vertices, faces, _ = pieces
    side = torch.where(distance.abs() <= slack, 0.0, distance).sign()
    ends = torch.stack([faces, faces.roll(-1, 1)], -1)
    crossed = side[ends].prod(-1) < 0
    if which is not None:
        crossed &= which[:, None]
    if not bool(crossed.any()):
        return pieces
    pair, number = ends[crossed].sort(-1).values.unique(dim=0, return_inverse=True)
    d = distance[pair]
    met = torch.lerp(vertices[pair[:, 0]], vertices[pair[:, 1]], (d[:, 0] / (d[:, 0] - d[:, 1]))[:, None])
    at = torch.full(faces.shape, -1)
    at[crossed] = number
    return divide(pieces, at, met)


def divide(
    pieces: Pieces, at: Int[Tensor, "F 3"], points: Float[Tensor, "n D"], centres: Float[Tensor, "m D"] | None = None
) -> Pieces:
    """Return triangles divided at points on their edges.

    Args:
        pieces: the triangles.
        at: number of the point on each edge, from a corner to the next; -1 = none.
        points: the points; triangles that share an edge share its point.
        centres: of triangles with points on all edges, in their order: they become six around it. None = four.
    """
    vertices, faces, source = pieces
    crossed, at = at >= 0, torch.where(at >= 0, at + len(vertices), -1)
    count = crossed.sum(1)
    made, from_ = [faces[count == 0]], [source[count == 0]]
    # One edge: its point and the corner across from it part the triangle.
    for k, p, own in _turned(faces, at, crossed, (False, True, False), count == 1):
        made += [torch.stack([k[:, 0], k[:, 1], p[:, 1]], 1), torch.stack([k[:, 0], p[:, 1], k[:, 2]], 1)]
        from_ += [source[own]] * 2
    # Two: the corner between them keeps a triangle, the other two a quad.
    for k, p, own in _turned(faces, at, crossed, (True, False, True), count == 2):
        made += [
            torch.stack([k[:, 0], p[:, 0], p[:, 2]], 1),
            torch.stack([p[:, 0], k[:, 1], k[:, 2]], 1),
            torch.stack([p[:, 0], k[:, 2], p[:, 2]], 1),
        ]
        from_ += [source[own]] * 3
    own = (count == 3).nonzero()[:, 0]
    k, p = faces[own], at[own]
    added = [vertices, points]
    if centres is None:
        made += [torch.stack([k[:, i], p[:, i], p[:, i - 1]], 1) for i in range(3)] + [p]
        from_ += [source[own]] * 4
    else:
        middle = len(vertices) + len(points) + torch.arange(len(own))
        made += [torch.stack([middle, k[:, i], p[:, i]], 1) for i in range(3)]
        made += [torch.stack([middle, p[:, i - 1], k[:, i]], 1) for i in range(3)]
        from_ += [source[own]] * 6
        added.append(centres)
    return Pieces(torch.cat(added), torch.cat(made), torch.cat(from_))


def _turned(
    faces: Tensor, at: Tensor, crossed: Tensor, pattern: tuple[bool, bool, bool], among: Tensor
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """Return corners and points of triangles, begun so that edges are divided as in `pattern`, and which they are."""
    found = []
    for turn in range(3):
        own = (among & (crossed.roll(-turn, 1) == torch.tensor(pattern)).all(1)).nonzero()[:, 0]
        found.append((faces[own].roll(-turn, 1), at[own].roll(-turn, 1), own))
    return found
