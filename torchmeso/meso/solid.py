"""What is solid in a tile of triangles: the points that an odd number of one body's surfaces lies above.

Triangle soups are not to be trusted: bodies overlap, some are wound inwards, blades are sheets without an inside. So
every connected part is asked for itself, whatever its winding: a part without a free edge, the tile's borders being
joined, divides space, and a ray that goes up from inside it passes it an odd number of times (the top of the slab lies
above everything, so a height field needs no underside). Free edges at the bottom of the slab are let pass. Parts with
other free edges are sheets. Five rays vote, so that one which slips through an edge decides nothing.

Surfaces that lie on each other are met once, whichever comes first, which would spoil the count where bodies touch.
So bodies that might touch are asked in several scenes, and walls that a body has twice (boxes put together) are left
out; where all of it is there twice (every triangle with its back), once counts.

A copy in the next tile is a body of its own, unless it goes on in it.

Test: tests/meso/test_solid.py
"""

import math
from typing import NamedTuple

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

MOST_SCENES = 16
"""Scenes for bodies that might touch; beyond that the rest share one."""

MOST_BODIES = 4096
"""Bodies of which it is found out who might touch whom; more share one scene."""


class Corners(NamedTuple):
    """Corners of triangles on the grid.

    Attributes:
        place: (F, 3) number of the place in the tile, its borders being joined.
        cell: (F, 3, 2) how many tiles away along u and v.
        low: (F, 3) whether it lies at the bottom of the slab.
    """

    place: Int[np.ndarray, "F 3"]
    cell: Int[np.ndarray, "F 3 2"]
    low: Bool[np.ndarray, "F 3"]


def bodies(geometry: Geometry, h: float) -> Int[Tensor, "F"]:
    """Return the number of the body that each triangle of a tile belongs to, -1 for sheets.

    Triangles that share vertices make a body, if they are closed alone (several, where they fall into closed ones that
    share no edge of two triangles); of the rest those that share such edges, at last all that touch.
    """
    corners = _corners(geometry, h)
    spots = np.concatenate([corners.place[..., None], corners.cell], 2)
    # Triangles with two corners at one place (the poles of a sphere) bound nothing.
    left = (spots != np.roll(spots, 1, 1)).any(2).all(1).nonzero()[0]
    found, n = np.full(len(corners.place), -1), 0
    for way in ("vertices", "edges", "places"):
        if not len(left):
            break
        mine = Corners(*(x[left] for x in corners))
        fine = _by_edges(mine)
        if way == "edges":
            part = fine
        else:
            part = _connected(geometry.faces.numpy()[left] if way == "vertices" else mine.place)
            part = _split(part, fine, _closed(mine, fine)[fine])
        closed = _closed(mine, part)[part]
        found[left[closed]] = part[closed] + n
        n, left = n + len(left), left[~closed]
    return torch.from_numpy(found).long()


class Solids:
    """The bodies of a tile and of the copies around it, to ask for their insides."""

    def __init__(self, geometry: Geometry, h: float):
        """Find the bodies, and build a scene for each set of them that cannot touch."""
        of_tile = bodies(geometry, h)
        closed = (of_tile >= 0).nonzero()[:, 0]
        tile = geometry.vertices[geometry.faces[closed]]
        shifts, near = _copies(tile, h * math.tan(math.radians(TILT_DEG)) + 1e-3)
        body = _apart(_corners(geometry, h), closed.numpy(), of_tile.numpy(), shifts)
        asked = near.flatten() & torch.from_numpy(body >= 0)
        corner = (tile + torch.nn.functional.pad(shifts, (0, 1))[:, None, None]).reshape(-1, 3, 3)[asked]
        body = body[asked.numpy()]
        self._scenes: list[tuple[RayScene, Tensor]] = []
        for members in _sets(corner, body):
            mine = torch.from_numpy(np.isin(body, members))
            triangles = corner[mine]
            faces = torch.arange(3 * len(triangles)).reshape(-1, 3)
            self._scenes.append((RayScene(triangles.reshape(-1, 3), faces), torch.from_numpy(body)[mine].long()))

    def inside(self, place: Float[Tensor, "n 3"], *, start: float) -> Bool[Tensor, "n"]:
        """Return which points lie inside a body.

        Args:
            place: points of the unit cell.
            start: rays begin this far from their points, tile units: on a surface is outside.
        """
        found = torch.zeros(len(place), dtype=torch.bool)
        for scene, body in self._scenes:
            votes, asked = torch.zeros(len(place)), (~found).nonzero()[:, 0]
            for k in range(VOTES):
                theta = torch.tensor(math.radians(TILT_DEG) * (k + 1) / VOTES)
                up = from_angles(theta, torch.tensor(2.4 * k + 0.3)).expand(len(asked), 3)
                votes[asked] += _within(scene, body, place[asked], up, start)
            found |= votes > VOTES / 2
        return found


def _corners(geometry: Geometry, h: float) -> Corners:
    steps = (geometry.vertices.double() * GRID).round().long().numpy()
    cell = steps[:, :2] // GRID
    key = np.concatenate([steps[:, :2] - cell * GRID, steps[:, 2:]], 1)
    _, place = np.unique(key, axis=0, return_inverse=True)
    faces = geometry.faces.numpy()
    return Corners(place.reshape(-1)[faces], cell[faces], steps[faces, 2] <= (-h + 1e-4) * GRID)


def _edges(corners: Corners) -> tuple[Int[np.ndarray, "E"], Bool[np.ndarray, "E"]]:
    """Return the numbers of all edges, first those from corner 0 to 1 of each triangle; and which may be free."""
    begin, end = corners.place.T.ravel(), np.roll(corners.place, -1, 1).T.ravel()
    way = (np.roll(corners.cell, -1, 1) - corners.cell).transpose(1, 0, 2).reshape(-1, 2)
    # An edge is the same from its other end; a way of whole tiles back to its own place too.
    back = (begin > end) | ((begin == end) & ((way[:, 0] < 0) | ((way[:, 0] == 0) & (way[:, 1] < 0))))
    way = np.where(back[:, None], -way, way)
    key = np.stack([np.minimum(begin, end), np.maximum(begin, end), *way.T], 1)
    point = (begin == end) & (way == 0).all(1)
    low = (corners.low & np.roll(corners.low, -1, 1)).T.ravel()
    return np.unique(key, axis=0, return_inverse=True)[1].reshape(-1), point | low


def _closed(corners: Corners, part: Int[np.ndarray, "F"]) -> Bool[np.ndarray, "n"]:
    """Return which parts have every edge an even number of times, the bottom of the slab let pass."""
    edge, passed = _edges(corners)
    of = np.tile(part, 3)
    _, which, count = np.unique(edge * (part.max() + 1) + of, return_inverse=True, return_counts=True)
    closed = np.ones(part.max() + 1, bool)
    closed[of[(count % 2 == 1)[which.reshape(-1)] & ~passed]] = False
    return closed


def _by_edges(corners: Corners) -> Int[np.ndarray, "F"]:
    """Return the part of each triangle, joined where two share an edge that no other has."""
    edge, _ = _edges(corners)
    face = np.tile(np.arange(len(corners.place)), 3)
    order = np.argsort(edge, kind="stable")
    edge, face = edge[order], face[order]
    first = np.flatnonzero(np.r_[True, edge[1:] != edge[:-1]])
    pair = first[np.diff(np.r_[first, len(edge)]) == 2]
    n = len(corners.place)
    graph = coo_matrix((np.ones(len(pair), np.int8), (face[pair], face[pair + 1])), shape=(n, n))
    return connected_components(graph, directed=False)[1]


def _split(
    part: Int[np.ndarray, "F"], fine: Int[np.ndarray, "F"], closed: Bool[np.ndarray, "F"]
) -> Int[np.ndarray, "F"]:
    """Return `part`, split into its finer parts where all of those are closed."""
    whole = np.zeros(part.max() + 1, bool)
    whole[part[~closed]] = True
    return np.unique(np.where(whole[part], part, fine + len(whole)), return_inverse=True)[1].reshape(-1)


def _copies(tile: Float[Tensor, "F 3 3"], reach: float) -> tuple[Int[Tensor, "k 2"], Bool[Tensor, "k F"]]:
    """Return the moves by whole tiles that bring a triangle within reach of the unit cell, and which they bring."""
    if not len(tile):
        return torch.zeros(0, 2, dtype=torch.long), torch.zeros(0, 0, dtype=torch.bool)
    low, high = tile[..., :2].amin(1), tile[..., :2].amax(1)
    first, last = (-(high.amax(0) + reach).floor()).long(), (1 - (low.amin(0) - reach).floor()).long()
    ranges = [torch.arange(int(a), int(b) + 1) for a, b in zip(first, last, strict=True)]
    shifts = torch.cartesian_prod(*ranges)
    near = torch.stack([((low + s <= 1 + reach) & (high + s >= -reach)).all(-1) for s in shifts])
    used = near.any(1)
    return shifts[used], near[used]


def _apart(
    corners: Corners, closed: Int[np.ndarray, "G"], of_tile: Int[np.ndarray, "F"], shifts: Int[Tensor, "k 2"]
) -> Int[np.ndarray, "kG"]:
    """Return the bodies of copies of the closed triangles, others in every copy, -1 for walls that one has twice.

    Copies are whole here, even where most of one is out of reach: cut ones would fall apart.
    """
    cell = (corners.cell[closed] + shifts.numpy()[:, None, None]).reshape(-1, 3, 2)
    if not len(cell):
        return np.zeros(0, np.int64)
    place, of = (np.tile(x, (len(shifts), *(1,) * (x.ndim - 1))) for x in (corners.place[closed], of_tile[closed]))
    cell -= cell.min((0, 1))
    width = int(cell.max()) + 1
    key = ((place * width + cell[..., 0]) * width + cell[..., 1]) * (of.max() + 1) + of[:, None]
    number = np.unique(key, return_inverse=True)[1].reshape(-1, 3)
    of = _connected(number)
    _, same, count = np.unique(np.sort(number, 1), axis=0, return_inverse=True, return_counts=True)
    twice = (count % 2 == 0)[same.reshape(-1)]
    once = np.zeros(of.max() + 1, bool)
    once[of[~twice]] = True
    return np.where(twice & once[of], -1, of)


def _connected(corner: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "F"]:
    """Return the part that each triangle belongs to by the numbers of its corners."""
    ends, n = np.concatenate([corner[:, [0, 1]], corner[:, [1, 2]]]), int(corner.max()) + 1
    graph = coo_matrix((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(n, n))
    part = connected_components(graph, directed=False)[1]
    return np.unique(part[corner[:, 0]], return_inverse=True)[1].reshape(-1)


def _sets(corner: Float[Tensor, "G 3 3"], body: Int[np.ndarray, "G"]) -> list[Int[np.ndarray, "k"]]:
    """Return sets of bodies whose boxes keep apart."""
    names, mine = np.unique(body, return_inverse=True)
    if not 1 < len(names) <= MOST_BODIES:
        return [names] if len(names) else []
    low, high = np.full((len(names), 3), np.inf), np.full((len(names), 3), -np.inf)
    np.minimum.at(low, mine, corner.amin(1).numpy())
    np.maximum.at(high, mine, corner.amax(1).numpy())
    left, found = np.arange(len(names)), []
    while len(left) and len(found) < MOST_SCENES - 1:
        chosen, free = [], np.ones(len(left), bool)
        for k in range(len(left)):
            if free[k]:
                chosen.append(left[k])
                apart = (low[left] > high[left[k]] + 2 * BEYOND) | (high[left] < low[left[k]] - 2 * BEYOND)
                free &= apart.any(1)
        found.append(names[chosen])
        left = np.setdiff1d(left, chosen)
    return [*found, names[left]] if len(left) else found


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
        rays.append(active)
        bodies.append(of)
    odd = torch.zeros(len(place), dtype=torch.bool)
    if rays:
        width = int(body.max()) + 1
        pairs, times = (torch.cat(rays) * width + torch.cat(bodies)).unique(return_counts=True)
        odd[pairs[times % 2 == 1] // width] = True
    return odd
