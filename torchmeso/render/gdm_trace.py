"""Rays through a shell dressed with a generalised displacement map: the slow, exact formula.

wang2004gdm, section 3.2: in object space a ray passes prisms one after the other; in texture space its way through each
is taken as straight, and one look-up tells whether material lies on it. Further look-ups (`queries`) go on from where
the one before says that nothing is yet, and end closer to the material.

A table decides by the majority of its samples, and may let a ray pass that then begins its way through the next prism
inside of material. Such a ray met it in the prism before, where the minority told of it.

Test: tests/render/test_gdm_trace.py
"""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.data.gdm import Gdm
from torchmeso.geometry.frames import around
from torchmeso.geometry.shell import BOTTOM, OUTWARD, Shell, left_of

MOST_STEPS = 4096
"""Tetrahedra that a ray may pass."""

NUDGES = (1e-9, 1e-7, 1e-5, 1e-3, 0.0)
"""A ray beside the face it comes in by is moved by these shares of the way to its middle, one after the other."""

TIE = 1e-6
"""Tile units: material that lies at the very end of a way is met."""

SHORT = 1e-5
"""Ways in texture space, tile units, that rounding makes or leaves out: past an edge or a corner."""

INTO = OUTWARD.flip(1)
"""Corners of the face a ray came in through, counter-clockwise seen by the ray."""


class Entries(NamedTuple):
    """Where rays come into a shell.

    Attributes:
        origin: (n, 3) float64.
        direction: (n, 3) unit.
        tet: (n,) tetrahedron behind the face.
        corner: (n,) its corner opposite the face; -1: the ray begins inside of the tetrahedron.
        place: (n, 3) texture coordinates of rays that begin inside; None where none does.
    """

    origin: Float[Tensor, "n 3"]
    direction: Float[Tensor, "n 3"]
    tet: Int[Tensor, "n"]
    corner: Int[Tensor, "n"]
    place: Float[Tensor, "n 3"] | None = None


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Traced:
    """What rays met.

    Attributes:
        hit: (n,) whether there is material.
        t: (n,) distance: of the material, or of where the ray left the shell.
        place: (n, 3) texture coordinates there.
        direction: (n, 3) unit direction of the last way in texture space.
        prism: (n,) the last prism.
        through: (n,) what the ray left through: BOTTOM, TOP, BORDER; 0 where it hit.
        prisms: (n,) prisms passed, those not counted in which the way is shorter than `SHORT`.
    """

    hit: Bool[Tensor, "n"]
    t: Float[Tensor, "n"]
    place: Float[Tensor, "n 3"]
    direction: Float[Tensor, "n 3"]
    prism: Int[Tensor, "n"]
    through: Int[Tensor, "n"]
    prisms: Int[Tensor, "n"]


def trace(shell: Shell, gdm: Gdm | None, entries: Entries, *, queries: int = 1, floor: bool = True) -> Traced:
    """Follow rays from where they come into the shell until they hit or leave.

    Args:
        shell: the prisms.
        gdm: the material; None walks through to the end.
        entries: the rays.
        queries: look-ups per prism; 1 is the paper's.
        floor: whether the bottom of the shell is solid.

    Returns:
        what they met, in the order of the rays.
    """
    n = len(entries.tet)
    axes = around(entries.direction.double())
    rays = _Rays(entries.origin.double(), torch.stack([axes.t, axes.b, axes.n], 1))
    tet, corner = entries.tet.clone(), entries.corner.clone()
    within = corner < 0
    corner[within] = _behind(shell, _Rays(rays.origin[within], rays.axes[within]), tet[within])
    rays, enters = _into_face(shell, rays, tet, corner)
    share = _shares(shell, rays, tet, corner)
    start_t, start = share.t.clone(), share.place.clone()
    if entries.place is not None:
        start_t[within], start[within] = 0, entries.place[within].double()
    hit, t = torch.zeros(n, dtype=torch.bool), share.t.clone()
    place, direction = share.place.clone(), torch.zeros(n, 3, dtype=torch.float64)
    prism, through, prisms = tet // 3, torch.zeros(n, dtype=torch.long), torch.zeros(n, dtype=torch.long)
    overlooked = _Overlooked(torch.full((n,), torch.inf, dtype=torch.float64), place.clone(), prism.clone())
    active = enters.nonzero()[:, 0]
    through[~enters] = shell.neighbour[tet, corner][~enters]
    for _ in range(MOST_STEPS):
        if not len(active):
            break
        own = _Rays(rays.origin[active], rays.axes[active])
        out = _leave(shell, own, tet[active], corner[active])
        ahead = shell.neighbour[tet[active], out]
        at = _shares(shell, own, tet[active], out)
        leaves = (ahead < 0) | (ahead // 3 != prism[active])
        ray, now = active[leaves], leaves.nonzero()[:, 0]
        way = at.place[now] - start[ray]
        length = way.norm(dim=-1)
        v = way / length.clamp(min=1e-30)[:, None]
        prisms[ray] += length > SHORT
        direction[ray] = torch.where(length[:, None] > 0, v, direction[ray])
        met, d, near, sunk = _meet(gdm, start[ray], v, length, queries)
        per_length = (at.t[now] - start_t[ray]) / length.clamp(min=1e-30)
        t[ray] = torch.where(met, start_t[ray] + d * per_length, at.t[now])
        place[ray] = torch.where(met[:, None], start[ray] + d[:, None] * v, at.place[now])
        hit[ray] = met
        before = ray[sunk & overlooked.t[ray].isfinite()]
        t[before], place[before], prism[before] = (x[before] for x in overlooked)
        passed = torch.where(near <= length, start_t[ray] + near.clamp(max=1e30) * per_length, torch.inf)
        overlooked.t[ray], overlooked.prism[ray] = passed, prism[ray]
        overlooked.place[ray] = start[ray] + torch.where(near <= length, near, 0)[:, None] * v
        gone = ~met & (ahead[now] < 0)
        through[ray[gone]] = ahead[now][gone]
        done = torch.zeros(len(active), dtype=torch.bool)
        done[now] = met | gone
        # The others go on, in texture coordinates of the prism they come into.
        goes = (~done).nonzero()[:, 0]
        onward, following = active[goes], ahead[goes]
        corner[onward] = _facing(shell, following, tet[onward])
        tet[onward] = following
        crossing = leaves[goes]
        fresh = onward[crossing]
        entered = _shares(shell, _Rays(rays.origin[fresh], rays.axes[fresh]), tet[fresh], corner[fresh])
        start[fresh], start_t[fresh] = entered.place, entered.t
        prism[fresh] = tet[fresh] // 3
        active = onward
    if floor:
        hit |= through == BOTTOM
    return Traced(hit=hit, t=t, place=place, direction=direction, prism=prism, through=through, prisms=prisms)


class _Overlooked(NamedTuple):
    """What rays may have met in the prism before: (n,) t, inf where nothing; (n, 3) place; (n,) prism."""

    t: Tensor
    place: Tensor
    prism: Tensor


class _Rays(NamedTuple):
    origin: Tensor  # (n, 3)
    axes: Tensor  # (n, 3, 3): two across the ray, and the ray


class _Share(NamedTuple):
    t: Tensor  # (n,)
    place: Tensor  # (n, 3)


def _seen(shell: Shell, rays: _Rays, vertex: Tensor) -> Tensor:
    """Return vertices (n, k) as seen along rays: across, up, and how far along."""
    way = shell.vertices[vertex] - rays.origin[:, None]
    return (rays.axes[:, None] * way[:, :, None]).sum(-1)


def _into_face(shell: Shell, rays: _Rays, tet: Tensor, corner: Tensor) -> tuple[_Rays, Bool[Tensor, "n"]]:
    """Return rays moved into the faces they come in by, and which come in: a face seen on edge lets none in.

    What says by which face a ray comes in rounds otherwise than what is seen along it; a walk that begins beside its
    face would not find out. The ways are of the order of rounding, and longer only as long as they do not suffice.
    """
    vertex = shell.tets[tet].gather(1, INTO[corner])
    origin, enters = rays.origin.clone(), torch.zeros(len(tet), dtype=torch.bool)
    active = torch.arange(len(tet))
    for step in NUDGES:
        own = _Rays(origin[active], rays.axes[active])
        p = _seen(shell, own, vertex[active])[..., :2]
        ids = vertex[active]
        within = left_of(p, p.roll(-1, 1), ids, ids.roll(-1, 1)).all(1)
        enters[active[within]] = True
        active, p = active[~within], p[~within]
        if not len(active):
            break
        way = p.mean(1) * step
        origin[active] += (way[:, :, None] * rays.axes[active, :2]).sum(1)
    return _Rays(origin, rays.axes), enters


def _behind(shell: Shell, rays: _Rays, tet: Tensor) -> Tensor:
    """Return the corner of `tet` opposite the face by which rays would have come in that begin inside of it."""
    found = torch.zeros_like(tet)
    for corner in range(4):
        vertex = shell.tets[tet][:, INTO[corner]]
        p = _seen(shell, rays, vertex)[..., :2]
        inside = left_of(p, p.roll(-1, 1), vertex, vertex.roll(-1, 1)).all(1)
        found[inside] = corner
    return found


def _shares(shell: Shell, rays: _Rays, tet: Tensor, corner: Tensor) -> _Share:
    """Return where rays pass the face of a tetrahedron opposite `corner`."""
    local = OUTWARD[corner]
    vertex = shell.tets[tet].gather(1, local)
    p = _seen(shell, rays, vertex)
    x, y = p[..., 0], p[..., 1]
    following, last = [1, 2, 0], [2, 0, 1]
    area = x[:, following] * y[:, last] - y[:, following] * x[:, last]
    total = area.sum(1, keepdim=True)
    # A face seen on edge has no inside: its middle is as good as any place.
    flat = total.abs() < 1e-30
    weight = torch.where(flat, 1 / 3, area / torch.where(flat, 1, total)).clamp(0, 1)
    weight = weight / weight.sum(1, keepdim=True)
    uvz = shell.uvz[tet].gather(1, local[..., None].expand(-1, -1, 3))
    return _Share((weight * p[..., 2]).sum(1), (weight[..., None] * uvz).sum(1))


def _leave(shell: Shell, rays: _Rays, tet: Tensor, corner: Tensor) -> Tensor:
    """Return the corner opposite the face that rays leave a tetrahedron through, given the one they came in by."""
    base = INTO[corner]
    vertex = shell.tets[tet]
    tip = vertex.gather(1, corner[:, None])
    rim = vertex.gather(1, base)
    p, q = _seen(shell, rays, tip)[..., :2], _seen(shell, rays, rim)[..., :2]
    left = left_of(p.expand_as(q), q, tip.expand_as(rim), rim)
    between = left & ~left.roll(-1, 1)  # the ray passes between this corner of the rim and the next, seen from the tip
    # All on one side: the ray meets the tip itself, and any way out is as good as another.
    which = torch.where(between.any(1), between.int().argmax(1), 0)
    return base.gather(1, ((which + 2) % 3)[:, None])[:, 0]


def _facing(shell: Shell, tet: Tensor, before: Tensor) -> Tensor:
    """Return the corner of `tet` whose face lies towards its neighbour `before`."""
    return (shell.neighbour[tet] == before[:, None]).int().argmax(1)


def _meet(
    gdm: Gdm | None, start: Tensor, v: Tensor, length: Tensor, queries: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return whether material lies on straight ways in texture space, and how far along.

    Also how far along it lies by those samples that tell of it, and whether the ways begin inside of it.
    """
    met, d = torch.zeros(len(start), dtype=torch.bool), torch.zeros(len(start), dtype=torch.float64)
    near, sunk = torch.full_like(d, torch.inf), torch.zeros_like(met)
    if gdm is None or not len(start):
        return met, length, near, sunk
    active, asked = torch.arange(len(start)), 0
    while len(active):
        found = gdm.evaluate(start[active] + d[active, None] * v[active], v[active])
        reach = d[active] + found.distance
        near[active] = d[active] + found.near
        asked += 1
        beyond = reach > length[active] + TIE
        last = (found.distance < gdm.voxel) | (asked >= queries)
        stops = ~found.left & ~beyond & last
        met[active[stops]] = True
        if asked == 1:
            sunk = met & (found.distance <= 0)
        # Asked again a voxel before the material, where the table is at its best; and where the table ends before the
        # way does, from there on, whatever the number of queries.
        step = torch.where(found.left | last, found.distance, found.distance - gdm.voxel)
        d[active] = torch.minimum(d[active] + step, length[active])
        # A way that leaves the slab is over; one that is longer than the table knows goes on.
        on = ~found.left | (found.distance >= 0.9999 * gdm.cap)
        active = active[~stops & ~beyond & on & (found.distance > 1e-9)]
    return met, d, near, sunk
