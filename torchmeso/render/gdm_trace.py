"""Rays through a shell dressed with a generalised displacement map: the slow, exact formula.

wang2004gdm, section 3.2: in object space a ray passes prisms one after the other; in texture space its way through each
is taken as straight, and one look-up tells whether material lies on it. Further look-ups (`queries`) go on from where
the one before says that nothing is yet, and end closer to the material.

A table decides by the majority of its samples, and may let a ray pass that then begins its way through the next prism
inside of material. Such a ray met it in the prism before, where the minority told of it.

Test: tests/render/test_gdm_trace.py
"""

from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.data.gdm import Gdm
from torchmeso.geometry import shell_walk
from torchmeso.geometry.shell import BOTTOM, Shell
from torchmeso.geometry.shell_walk import Tetrahedra

MOST_STEPS = 4096
"""Tetrahedra that a ray may pass."""

TIE = 1e-6
"""Tile units: material that lies at the very end of a way is met."""

SHORT = 1e-5
"""Ways in texture space, tile units, that rounding makes or leaves out: past an edge or a corner."""

BLOCK = 1 << 15
"""Rays that are followed together: their columns stay in the cache."""


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

    def part(self, first: int, count: int) -> "Entries":
        """Return `count` rays from `first` on."""
        own = slice(first, first + count)
        place = None if self.place is None else self.place[own]
        return Entries(self.origin[own], self.direction[own], self.tet[own], self.corner[own], place)


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
    through = shell_walk.prepare(shell)
    parts = [
        _trace(through, gdm, entries.part(at, BLOCK), queries, floor)
        for at in range(0, max(len(entries.tet), 1), BLOCK)
    ]
    if len(parts) == 1:
        return parts[0]
    names = [f.name for f in fields(Traced)]
    return Traced(**{name: torch.cat([getattr(part, name) for part in parts]) for name in names})


def _trace(through: Tetrahedra, gdm: Gdm | None, entries: Entries, queries: int, floor: bool) -> Traced:
    n = len(entries.tet)
    rays, face, enters = shell_walk.enter(through, *entries[:4])
    share = face.shares()
    start, start_t = through.place(entries.tet, face, share), (share * face.t).sum(0)
    t, place = start_t.clone(), start.clone()
    within = entries.corner < 0
    if entries.place is not None:
        start_t[within], start[within] = 0, entries.place[within].double()
    hit, direction = torch.zeros(n, dtype=torch.bool), torch.zeros(n, 3, dtype=torch.float64)
    prism, passed_by, prisms = entries.tet // 3, torch.zeros(n, dtype=torch.long), torch.zeros(n, dtype=torch.long)
    overlooked = _Overlooked(torch.full((n,), torch.inf, dtype=torch.float64), place.clone(), prism.clone())
    shut = (~enters).nonzero()[:, 0]
    passed_by[shut] = through.neighbour[4 * entries.tet[shut] + (6 - face.corner[:, shut].sum(0))]
    # Columns of the rays that are on their way: `ray` is their number in the lists above.
    ray = enters.nonzero()[:, 0]
    rays, face, tet = rays.select(ray), face.select(ray), entries.tet[ray]
    for _ in range(MOST_STEPS):
        if not len(ray):
            break
        out, face = shell_walk.leave(through, rays, tet, face)
        ahead = through.neighbour[4 * tet + out]
        now = ((ahead < 0) | (ahead // 3 != tet // 3)).nonzero()[:, 0]
        own, at_face, before = ray[now], face.select(now), tet[now]
        share = at_face.shares()
        at_t, at_place = (share * at_face.t).sum(0), through.place(before, at_face, share)
        way = at_place - start[own]
        length = way.norm(dim=-1)
        v = way / length.clamp(min=1e-30)[:, None]
        prisms[own] += length > SHORT
        direction[own] = torch.where(length[:, None] > 0, v, direction[own])
        met, d, near, sunk = _meet(gdm, start[own], v, length, queries)
        per_length = (at_t - start_t[own]) / length.clamp(min=1e-30)
        gone = ~met & (ahead[now] < 0)
        goes = ~(met | gone)
        ends = (~goes).nonzero()[:, 0]
        last = own[ends]
        hit[last], prism[last] = met[ends], before[ends] // 3
        passed_by[last] = torch.where(met[ends], 0, ahead[now][ends])
        t[last] = torch.where(met, start_t[own] + d * per_length, at_t)[ends]
        place[last] = torch.where(met[:, None], start[own] + d[:, None] * v, at_place)[ends]
        earlier = own[sunk & overlooked.t[own].isfinite()]
        t[earlier], place[earlier], prism[earlier] = (x[earlier] for x in overlooked)
        # The others go on, in texture coordinates of the prism they come into.
        onward, within = own[goes], (near <= length)[goes]
        passing = torch.where(within, near[goes], 0)
        overlooked.t[onward] = torch.where(within, start_t[onward] + passing * per_length[goes], torch.inf)
        overlooked.place[onward] = start[onward] + passing[:, None] * v[goes]
        overlooked.prism[onward] = before[goes] // 3
        behind = shell_walk.go_on(through, tet, out, face)
        following = ahead[now][goes]
        start[onward] = through.place(following, behind.select(now[goes]), share[:, goes])
        start_t[onward] = at_t[goes]
        face, tet = behind, ahead
        if not goes.all():
            stays = torch.ones(len(ray), dtype=torch.bool)
            stays[now] = goes
            left = stays.nonzero()[:, 0]
            ray, tet, rays, face = ray[left], tet[left], rays.select(left), face.select(left)
    if floor:
        hit |= passed_by == BOTTOM
    return Traced(hit=hit, t=t, place=place, direction=direction, prism=prism, through=passed_by, prisms=prisms)


class _Overlooked(NamedTuple):
    """What rays may have met in the prism before: (n,) t, inf where nothing; (n, 3) place; (n,) prism."""

    t: Tensor
    place: Tensor
    prism: Tensor


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
