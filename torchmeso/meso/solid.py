"""What is solid in a tile of triangles: the points that an odd number of one body's surfaces lies above.

Triangle soups are not to be trusted: bodies overlap, some are wound inwards, blades are sheets without an inside. So
every connected part is asked for itself, whatever its winding: a part without a free edge, the tile's borders being
joined, divides space, and a ray that goes up from inside it passes it an odd number of times (the top of the slab lies
above everything, so a height field needs no underside). Free edges at the bottom of the slab are let pass. Parts with
other free edges are sheets. Five rays vote, so that one which slips through an edge decides nothing.

A body that overlaps its own copy in the next tile is not told from a hollow one.

Test: tests/meso/test_solid.py
"""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchmeso.geometry.directions import from_angles
from torchmeso.geometry.rays import RayScene
from torchmeso.transport.tracer import Geometry

VOTES, TILT_DEG = 5, 17.0
"""Rays that go up from a point, and how far the last leans."""

MOST_SURFACES = 256
"""Surfaces a ray may pass."""

BEYOND = 1e-5
"""A ray goes on this far (tile units) behind a surface that it passes."""

GRID = 1 << 20
"""Positions are joined on a grid of this many steps per tile."""


def bodies(geometry: Geometry, h: float) -> Int[Tensor, "F"]:
    """Return the number of the body that each triangle of a tile belongs to, -1 for sheets."""
    steps = (geometry.vertices.double() * GRID).round().long()
    key = torch.cat([steps[:, :2] % GRID, steps[:, 2:]], 1).numpy()
    _, joined = np.unique(key, axis=0, return_inverse=True)
    corner = joined.reshape(-1)[geometry.faces.numpy()]
    ends = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]], corner[:, [2, 0]]])
    n = int(joined.max()) + 1
    graph = coo_matrix((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(n, n))
    _, part = connected_components(graph, directed=False)
    _, edge, count = np.unique(np.sort(ends, 1), axis=0, return_inverse=True, return_counts=True)
    free = (count % 2 == 1)[edge.reshape(-1)] & (ends[:, 0] != ends[:, 1])
    height = np.zeros(n)
    height[joined.reshape(-1)] = geometry.vertices[:, 2].numpy()
    free &= ~((height[ends] <= -h + 1e-4).all(1))
    of_face = part[corner[:, 0]]
    sheet = np.zeros(part.max() + 1, bool)
    sheet[part[ends[free, 0]]] = True
    return torch.from_numpy(np.where(sheet[of_face], -1, of_face)).long()


def inside(scene: RayScene, body: Int[Tensor, "F"], place: Float[Tensor, "n 3"], *, start: float) -> Bool[Tensor, "n"]:
    """Return which points lie inside a body.

    Args:
        scene: the tile and its copies around.
        body: of each triangle of the scene, see `bodies`.
        place: points of the unit cell.
        start: rays begin this far from their points, tile units: on a surface is outside.
    """
    votes = torch.zeros(len(place))
    for k in range(VOTES):
        theta = torch.tensor(math.radians(TILT_DEG) * (k + 1) / VOTES)
        up = from_angles(theta, torch.tensor(2.4 * k + 0.3)).expand(len(place), 3)
        votes += _within(scene, body, place, up, start)
    return votes > VOTES / 2


def _within(scene: RayScene, body: Tensor, place: Tensor, up: Tensor, start: float) -> Bool[Tensor, "n"]:
    """Return which rays pass some body an odd number of times."""
    active, passed = torch.arange(len(place)), torch.full((len(place),), start)
    rays, bodies = [], []
    for _ in range(MOST_SURFACES):
        found = scene.first_hit(place[active] + passed[active, None] * up[active], up[active])
        struck = found.face >= 0
        active, of = active[struck], body[found.face[struck]]
        if not len(active):
            break
        passed[active] += found.t[struck] + BEYOND
        rays.append(active[of >= 0])
        bodies.append(of[of >= 0])
    odd = torch.zeros(len(place), dtype=torch.bool)
    if rays:
        width = int(body.max()) + 1
        pairs, times = (torch.cat(rays) * max(width, 1) + torch.cat(bodies)).unique(return_counts=True)
        odd[pairs[times % 2 == 1] // max(width, 1)] = True
    return odd
