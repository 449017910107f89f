"""Connected components of a triangle mesh: which are closed, and which way they face.

Silhouettes are formed per closed component, so these facts decide what a mesh can show. Vertices that were
split for texture seams or creases are one position here. A component is closed when every directed edge is
cancelled by its reverse: the rule also holds where more than two faces meet at an edge.

Test: tests/geometry/test_components.py
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor


class Components(NamedTuple):
    """Components of a mesh, numbered from 0.

    Attributes:
        of_face: (F,) component of each face.
        closed: (C,) whether the component bounds a volume.
        volume: (C,) signed volume, positive where faces look outwards; meaningless where not closed.
    """

    of_face: Int[Tensor, "F"]
    closed: Bool[Tensor, "C"]
    volume: Float[Tensor, "C"]


def weld(vertices: Float[Tensor, "V 3"]) -> Int[Tensor, "V"]:
    """Return for each vertex the number of its position; exactly equal positions share one."""
    positions = np.ascontiguousarray(vertices.detach().numpy() + 0.0)  # -0.0 and 0.0 are one position
    order = np.lexsort(positions.T)
    ordered = positions[order]
    starts = np.ones(len(order), dtype=bool)
    starts[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.cumsum(starts) - 1
    return torch.from_numpy(number)


def find(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Components:
    """Return the components of a mesh, connected through shared edges."""
    n_face = len(faces)
    if n_face == 0:
        empty = torch.zeros(0)
        return Components(torch.zeros(0, dtype=torch.long), empty.bool(), empty.double())
    corner = weld(vertices)[faces]
    tail, head = corner.flatten(), corner.roll(-1, 1).flatten()
    low, high = torch.minimum(tail, head), torch.maximum(tail, head)
    _, edge = torch.unique(low * (corner.max() + 1) + high, return_inverse=True)
    n_edge = int(edge.max()) + 1

    # Faces are connected through edges: components of the bipartite graph of both.
    face = torch.arange(n_face).repeat_interleave(3)
    links = (np.ones(3 * n_face, dtype=np.int8), (face.numpy(), (n_face + edge).numpy()))
    size = n_face + n_edge
    count, label = connected_components(coo_matrix(links, shape=(size, size)), directed=False)
    of_face = torch.from_numpy(label[:n_face]).long()

    balance = torch.zeros(n_edge, dtype=torch.long).index_add_(0, edge, torch.sign(head - tail))
    unbalanced = torch.zeros(count, dtype=torch.bool)
    unbalanced[of_face[face[balance[edge] != 0]]] = True
    return Components(of_face, ~unbalanced, _signed_volume(vertices, faces, of_face, count))


def twins(found: Components, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Bool[Tensor, "F"]:
    """Return the second faces of components in which every face lies back to back on another: sheets with two sides.

    Such a component bounds nothing, and which side of it is nearer would be left to rounding.
    """
    corner = weld(vertices)[faces]
    smallest = corner.argmin(1, keepdim=True)
    turned = corner.gather(1, (smallest + torch.arange(3)) % 3)  # the same face may begin at any of its corners
    backwards = turned[:, 1] > turned[:, 2]
    _, place = torch.unique(corner.sort(1).values, dim=0, return_inverse=True)
    side = torch.where(backwards, -1, 1)
    count = int(place.max()) + 1 if len(place) else 0
    unpaired = torch.zeros(count, dtype=torch.long).index_add_(0, place, side) != 0
    bounding = torch.zeros(len(found.closed), dtype=torch.bool)
    bounding[found.of_face[unpaired[place]]] = True
    first = torch.full((count,), len(faces)).scatter_reduce_(0, place, torch.arange(len(faces)), "amin")
    return ~bounding[found.of_face] & (backwards != backwards[first[place]])


def _signed_volume(vertices: Tensor, faces: Tensor, of_face: Tensor, count: int) -> Tensor:
    """Return the float64 volume of each component, summed about its own first vertex against cancellation."""
    p = vertices.double()[faces]
    first = torch.full((count,), len(faces), dtype=torch.long).scatter_reduce_(
        0, of_face, torch.arange(len(faces)), "amin"
    )
    a, b, c = (p - p[first[of_face], :1]).unbind(1)
    six = (a * torch.linalg.cross(b, c)).sum(-1)
    return torch.zeros(count, dtype=torch.float64).index_add_(0, of_face, six / 6)


def inside_out(components: Components, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Bool[Tensor, "C"]:
    """Return which closed components face inwards without being a cavity of a larger one.

    A cavity (negative volume, its box inside the box of another closed component) is left as it is.
    """
    count = len(components.closed)
    p = vertices.double()[faces]
    index = components.of_face[:, None].expand(-1, 3)
    low = torch.full((count, 3), torch.inf, dtype=torch.float64).scatter_reduce_(0, index, p.amin(1), "amin")
    high = torch.full((count, 3), -torch.inf, dtype=torch.float64).scatter_reduce_(0, index, p.amax(1), "amax")
    negative = components.closed & (components.volume < 0)
    outside = components.closed & (components.volume > 0)
    result = negative.clone()
    for c in negative.nonzero()[:, 0].tolist():
        contains = outside & (low <= low[c]).all(-1) & (high >= high[c]).all(-1)
        result[c] = not bool(contains.any())
    return result
