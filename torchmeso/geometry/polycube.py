"""Quads on a mesh by its PolyCube map: a place on the surface of unit cubes for each vertex.

tarini2004polycube: cubes have their faces at half-integers, and a third texture coordinate makes places of them. Inside
a square the map is linear. A triangle whose corners lie on squares of different planes is bent around the cubes' edges:
its edges run as they would if the two squares lay flat (`_between`), through the corner where three squares meet. Large
ones are halved first, so that each piece goes around one edge or corner. Places that are off the squares (the map's
authors let them float near edges) are moved onto the nearest.

Test: tests/geometry/test_polycube.py
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchmeso.errors import GeometryError, check_range, check_shape
from torchmeso.geometry import plane_cut
from torchmeso.geometry.plane_cut import Pieces
from torchmeso.geometry.quads import Patches, edges

ON = 1e-4
"""How near to a plane a place lies on it."""

HALVINGS = 4
"""Of triangles that are bent, before they are cut at edges."""

FARTHEST = 1 << 12
"""Cubes from the origin."""


def project(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], places: Float[Tensor, "V 3"], parts: int = 1
) -> Patches:
    """Return a mesh in the squares of its PolyCube.

    Args:
        vertices: positions.
        faces: triangles.
        places: of the vertices in the space of cubes.
        parts: quads along a side of a square.

    Raises:
        ConfigError: `parts` is not in 1..64.
        GeometryError: no triangle lies flat on a square.
    """
    check_range("polycube.parts", parts, 1, 64)
    check_shape("polycube.places", places, (len(vertices), 3))
    squares = _squares(places.double(), faces)
    pieces = plane_cut.whole(torch.cat([vertices.double(), _nearest(places.double(), squares)], 1), faces)
    for _ in range(HALVINGS):
        pieces = _halved(pieces, squares)
    pieces = _bent(pieces, squares)
    low, high = (pieces.vertices[:, 3:].amin(0), pieces.vertices[:, 3:].amax(0))
    for axis in range(3):
        first, last = (int(((x[axis] - 0.5) * parts).round()) for x in (low, high))
        for line in range(first, last + 1):
            pieces = plane_cut.cut(pieces, pieces.vertices[:, 3 + axis] - (line / parts + 0.5), slack=ON / parts / 10)
    return _cells(pieces, squares, parts)


def _squares(places: Tensor, faces: Tensor) -> Int[Tensor, "n"]:
    """Return the keys of the squares of the polycube: those with flat triangles, or with a vertex inside."""
    p = places[faces]
    found = []
    share = torch.tensor([[i, j, 6 - i - j] for i in range(1, 6) for j in range(1, 6 - i)], dtype=torch.float64) / 6
    for axis in range(3):
        plane = _on_plane(p[..., axis])
        flat = plane.all(1) & ((p[..., axis] - p[:, :1, axis]).abs() < ON).all(1)
        inside = torch.einsum("nk,fkd->fnd", share, p[flat]).flatten(0, 1)
        alone = _on_plane(places[:, axis]) & (_on_plane(places).sum(1) == 1)
        found += [_key(inside, axis), _key(places[alone], axis)]
    squares = torch.cat(found).unique()
    if not len(squares):
        raise GeometryError(
            "polycube: expected triangles that lie flat on cubes with faces at half-integers, found none; is this a "
            "PolyCube map?"
        )
    return squares


def _on_plane(x: Tensor) -> Bool[Tensor, "*batch"]:
    return (x - x.floor() - 0.5).abs() < ON


def _key(p: Float[Tensor, "*batch 3"], axis: int) -> Int[Tensor, "*batch"]:
    """Return the number of the square of a plane across `axis` that lies at p."""
    cell = (p + 0.5).floor().long() + FARTHEST
    cell[..., axis] = (p[..., axis] + 0.5).round().long() + FARTHEST
    return ((axis * 2 * FARTHEST + cell[..., 0]) * 2 * FARTHEST + cell[..., 1]) * 2 * FARTHEST + cell[..., 2]


class _Square(NamedTuple):
    """Squares: the axis they lie across, and their middles."""

    axis: Int[Tensor, "n"]
    middle: Float[Tensor, "n 3"]


def _decoded(squares: Int[Tensor, "n"]) -> _Square:
    side = 2 * FARTHEST
    cell = torch.stack([squares // side**2 % side, squares // side % side, squares % side], -1).double() - FARTHEST
    axis = squares // side**3
    return _Square(axis, cell - 0.5 * torch.nn.functional.one_hot(axis, 3))


def _nearest(p: Float[Tensor, "n 3"], squares: Int[Tensor, "m"]) -> Float[Tensor, "n 3"]:
    """Return the nearest points on the squares."""
    axis, middle = _decoded(squares)
    half = 0.5 * (1 - torch.nn.functional.one_hot(axis, 3).double())
    found = []
    for some in p.split(1024):
        on = torch.maximum(torch.minimum(some[:, None], middle + half), middle - half)
        best = (on - some[:, None]).square().sum(-1).argmin(1)
        found.append(on[torch.arange(len(some)), best])
    return torch.cat(found) if found else p


def _planes(p: Float[Tensor, "n 3"], squares: Int[Tensor, "m"]) -> Bool[Tensor, "n 3"]:
    """Return whether each point lies on a square across each axis, its border included."""
    found = []
    for axis in range(3):
        near = torch.zeros(len(p), dtype=torch.bool)
        for a in (-2 * ON, 2 * ON):
            for b in (-2 * ON, 2 * ON):
                moved = p.clone()
                moved[:, (axis + 1) % 3] += a
                moved[:, (axis + 2) % 3] += b
                near |= torch.isin(_key(moved, axis), squares)
        found.append(near & _on_plane(p[:, axis]))
    return torch.stack(found, 1)


class _Between(NamedTuple):
    """How the way from one point of the squares to another runs.

    Attributes:
        flat: whether they share a plane.
        edge: share of the way at which it crosses the edge of two planes; meaningless where `flat` or `lost`.
        one: axis of the first one's plane.
        other: axis of the other's.
        lost: whether there is no such edge: they lie on parallel planes.
    """

    flat: Bool[Tensor, "n"]
    edge: Float[Tensor, "n"]
    one: Int[Tensor, "n"]
    other: Int[Tensor, "n"]
    lost: Bool[Tensor, "n"]


def _between(p: Float[Tensor, "n 3"], q: Float[Tensor, "n 3"], on_p: Tensor, on_q: Tensor) -> _Between:
    """Return the shortest way over one edge: around it both squares lie in one plane."""
    flat = (on_p & on_q & ((p - q).abs() < ON)).any(1)
    best, edge = torch.full((len(p),), torch.inf, dtype=torch.float64), torch.zeros(len(p), dtype=torch.float64)
    one, other = torch.zeros(len(p), dtype=torch.long), torch.ones(len(p), dtype=torch.long)
    for a in range(3):
        for b in range(3):
            if a == b:
                continue
            to_edge, beyond = (p[:, b] - q[:, b]).abs(), (p[:, a] - q[:, a]).abs()
            length = torch.where(on_p[:, a] & on_q[:, b], to_edge + beyond, torch.inf)
            nearer = length < best
            best = torch.where(nearer, length, best)
            edge = torch.where(nearer, to_edge / (to_edge + beyond).clamp(min=1e-12), edge)
            one, other = torch.where(nearer, a, one), torch.where(nearer, b, other)
    return _Between(flat, edge, one, other, ~flat & best.isinf())


def _along(p: Tensor, q: Tensor, way: _Between, share: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Return the point at a share of each way; where there is none that of the chord."""
    chord = torch.lerp(p, q, share[:, None])
    row = torch.arange(len(p))
    before = share < way.edge
    bent = chord.clone()
    # Up to the edge the first plane is kept and the other coordinate runs to the edge; behind it the other way round.
    bent[row, way.one] = torch.where(
        before,
        p[row, way.one],
        torch.lerp(p[row, way.one], q[row, way.one], (share - way.edge) / (1 - way.edge).clamp(min=1e-12)),
    )
    bent[row, way.other] = torch.where(
        before, torch.lerp(p[row, way.other], q[row, way.other], share / way.edge.clamp(min=1e-12)), q[row, way.other]
    )
    return torch.where((way.flat | way.lost)[:, None], chord, bent)


def _edges(pieces: Pieces, which: Bool[Tensor, "F 3"]) -> tuple[Int[Tensor, "n 2"], Int[Tensor, "F 3"]]:
    """Return the edges of triangles at these sides, each once, and the number of each side's, -1 where none."""
    ends = torch.stack([pieces.faces, pieces.faces.roll(-1, 1)], -1).sort(-1).values
    pair, number = ends[which].unique(dim=0, return_inverse=True)
    at = torch.full(which.shape, -1)
    at[which] = number
    return pair, at


def _ways(pieces: Pieces, squares: Tensor, pair: Int[Tensor, "n 2"]) -> _Between:
    p, q = (pieces.vertices[k, 3:] for k in pair.unbind(1))
    on = _planes(pieces.vertices[:, 3:], squares)
    return _between(p, q, on[pair[:, 0]], on[pair[:, 1]])


def _halved(pieces: Pieces, squares: Tensor) -> Pieces:
    """Return triangles that are bent as four, their neighbours divided along."""
    pair, at = _edges(pieces, torch.ones_like(pieces.faces, dtype=torch.bool))
    way = _ways(pieces, squares, pair)
    bent = (~way.flat)[at].any(1)
    if not bool(bent.any()):
        return pieces
    wanted = torch.zeros(len(pair), dtype=torch.bool)
    wanted[at[bent].flatten()] = True
    number = torch.where(wanted, wanted.cumsum(0) - 1, -1)
    p, q = (pieces.vertices[k] for k in pair[wanted].unbind(1))
    chosen = _Between(*(x[wanted] for x in way))
    middle = _along(p[:, 3:], q[:, 3:], chosen, torch.full((len(p),), 0.5, dtype=torch.float64))
    points = torch.cat([(p[:, :3] + q[:, :3]) / 2, _nearest(middle, squares)], 1)
    return plane_cut.divide(pieces, number[at], points)


def _bent(pieces: Pieces, squares: Tensor) -> Pieces:
    """Return triangles cut where they go around an edge or a corner."""
    pair, at = _edges(pieces, torch.ones_like(pieces.faces, dtype=torch.bool))
    way = _ways(pieces, squares, pair)
    wanted = ~way.flat & ~way.lost
    number = torch.where(wanted, wanted.cumsum(0) - 1, -1)[at]
    p, q = (pieces.vertices[k] for k in pair[wanted].unbind(1))
    chosen = _Between(*(x[wanted] for x in way))
    met = torch.cat(
        [torch.lerp(p[:, :3], q[:, :3], chosen.edge[:, None]), _along(p[:, 3:], q[:, 3:], chosen, chosen.edge)], 1
    )
    around = number[(number >= 0).all(1)]
    centre = met[around].mean(1)
    # Three planes meet at a corner: two of the three cuts have each of its coordinates.
    centre[:, 3:] = met[around][..., 3:].median(1).values
    return plane_cut.divide(pieces, number, met, centre)


def _cells(pieces: Pieces, squares: Tensor, parts: int) -> Patches:
    """Return pieces in the quads that the squares are split into."""
    p = pieces.vertices[:, 3:][pieces.faces]
    middle = p.mean(1)
    on = _planes(pieces.vertices[:, 3:], squares)[pieces.faces]
    area = torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    common = on.all(1) & ((p - p[:, :1]).abs() < ON).all(1)
    common &= torch.stack([torch.isin(_key(middle, k), squares) for k in range(3)], 1)
    # A few whose corners share no square are taken to lie on the nearest.
    lost = ~common.any(1)
    axis = torch.where(common, 1.0 + area.abs(), 0.0).argmax(1)
    if bool(lost.any()):
        which, centre = _decoded(squares)
        near = torch.cdist(middle[lost], centre).argmin(1)
        axis[lost] = which[near]
        half = 0.499 * (1 - torch.nn.functional.one_hot(which[near], 3).double())
        middle[lost] = torch.maximum(torch.minimum(middle[lost], centre[near] + half), centre[near] - half)
    row = torch.arange(len(axis))
    level = (middle[row, axis] - 0.5).round()
    s, t = (axis + 1) % 3, (axis + 2) % 3
    first = torch.stack([((middle[row, k] - 0.5) * parts).floor() for k in (s, t)], -1)
    number = torch.stack([axis, level.long(), *first.long().unbind(1)], 1)
    cells, cell = number.unique(dim=0, return_inverse=True)
    facing = torch.zeros(len(cells), dtype=torch.float64).index_add_(0, cell, area[row, axis])
    along = torch.stack([(p.gather(2, k[:, None, None].expand(-1, 3, 1))[..., 0] - 0.5) * parts for k in (s, t)], -1)
    place = (along - first[:, None]).clamp(0, 1)
    # Seen from behind, quads begin at the same corner and run along the other axis first.
    behind = facing < 0
    place = torch.where(behind[cell, None, None], place.flip(-1), place)
    return Patches(pieces.vertices[:, :3], pieces.faces, cell, place, _quads(pieces, cell, cells, behind, parts))


def _quads(
    pieces: Pieces, cell: Int[Tensor, "F"], cells: Int[Tensor, "Q 4"], behind: Bool[Tensor, "Q"], parts: int
) -> Int[Tensor, "Q 4"]:
    """Return numbers of the corners of quads, given by axis, level, and place in the plane.

    Quads have an edge in common where triangles lie across it: cubes may touch along an edge, the surface does not.
    """
    axis, level, s, t = cells.unbind(1)
    row = torch.arange(len(cells))
    corner = torch.zeros(len(cells), 4, 3, dtype=torch.long)
    for k, (ds, dt) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
        corner[row, k, axis] = level * parts
        corner[row, k, (axis + 1) % 3] = s + ds
        corner[row, k, (axis + 2) % 3] = t + dt
    corner = torch.where(behind[:, None, None], corner[:, [0, 3, 2, 1]], corner)
    beside = edges(pieces.faces).beside
    one, other = cell[:, None].expand(-1, 3)[beside >= 0], cell[beside[beside >= 0] // 3]
    pair = torch.stack([one, other], 1)[one < other].unique(dim=0)
    same = (corner[pair[:, 0], :, None] == corner[pair[:, 1], None]).all(-1)  # pair, corner of one, of the other
    edge = same & (same.sum((1, 2), keepdim=True) == 2)
    which, k, j = edge.nonzero().unbind(1)
    a, b = 4 * pair[which, 0] + k, 4 * pair[which, 1] + j
    graph = coo_array((np.ones(len(a)), (a.numpy(), b.numpy())), shape=(4 * len(cells),) * 2)
    quads = torch.from_numpy(connected_components(graph, directed=False)[1]).long().reshape(-1, 4)
    return _apart(quads, cell.bincount(minlength=len(quads)))


def _apart(quads: Int[Tensor, "Q 4"], pieces: Int[Tensor, "Q"]) -> Int[Tensor, "Q 4"]:
    """Return quads no more than two of which meet at an edge: those of fewest pieces stand by themselves."""
    while True:
        ends = torch.stack([quads, quads.roll(-1, 1)], -1).flatten(0, 1).sort(1).values
        _, edge, count = ends.unique(dim=0, return_inverse=True, return_counts=True)
        crowded = (count[edge] > 2).nonzero()[:, 0] // 4
        if not len(crowded):
            return quads
        least = crowded[pieces[crowded].argmin()]
        quads = quads.clone()
        quads[least] = quads.max() + 1 + torch.arange(4)
