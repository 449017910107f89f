"""Which fragments are seen when surfaces carry a mesostructure: intervals and the depth-interval test.

wang2005mdf, section 4.1. A ray is inside a closed component from an opening face (winding 0 -> 1) to a closing
one (1 -> 0). With d_f = s_f D(uv_f, wo) and d_b = s_b D(uv_b, -wo) it meets the mesostructure when

    d_f + d_b <= t_b - t_f,

and passes through otherwise. The number of times the eye lies inside a component is read off exactly from its
unbalanced faces, so two faces that swap places at a silhouette edge make an empty interval, not a wrong one.
Open surfaces are single opaque layers.

Exact skip: an interval at least as long as the largest possible d_f + d_b hits without asking for d_b. The thin
rest decides the silhouette and is asked closely (`distance`); where a deep one is met, the table says (`evaluate`).

Test: tests/render/test_silhouette.py
"""

from typing import Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.data.mdf import MIN_COS
from torchmeso.geometry import frames, shell
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.shell import BOTTOM
from torchmeso.render import curved_silhouette, gdm_trace
from torchmeso.render.rasterize import Layers
from torchmeso.render.scene import PlacedShell, Points, Scene, World, interpolate, rays

Silhouette = Literal["none", "paper", "curved"]


class Intervals(NamedTuple):
    """Stretches of rays inside closed components; fragment numbers, -1 = none.

    Attributes:
        pixel: (n,).
        front: (n,) fragment that opens; -1: the eye is inside.
        back: (n,) fragment that closes; -1: nothing does.
    """

    pixel: Int[Tensor, "n"]
    front: Int[Tensor, "n"]
    back: Int[Tensor, "n"]


class Candidates(NamedTuple):
    """What could be seen: intervals that hit, and open surfaces; several per pixel, in no special order.

    Attributes:
        pixel: (n,).
        fragment: (n,) the front fragment; -1: the eye is inside.
        back: (n,) the fragment that closes the interval; -1 for open surfaces, and where nothing does.
        t: (n,) depth of the front fragment on the base surface.
        depth: (n,) t + d_f: where the mesostructure is met.
        prism: (n,) of all shells, where a GDM is met; -1 elsewhere.
        place: (n, 3) texture coordinates where a GDM is met.
        floor: (n,) whether it is met at the bottom of its shell.
    """

    pixel: Int[Tensor, "n"]
    fragment: Int[Tensor, "n"]
    back: Int[Tensor, "n"]
    t: Float[Tensor, "n"]
    depth: Float[Tensor, "n"]
    prism: Int[Tensor, "n"]
    place: Float[Tensor, "n 3"]
    floor: Bool[Tensor, "n"]

    def select(self, which: Tensor) -> "Candidates":
        """Return the candidates `which` (numbers or a mask)."""
        return Candidates(*(x[which] for x in self))


class Counts(NamedTuple):
    """What the test did: intervals in all, those passed by their length alone, those that miss, eye inside."""

    intervals: int
    skipped: int
    carved: int
    inside: int


def find_intervals(layers: Layers, world: World) -> tuple[Intervals, Int[Tensor, "m"]]:
    """Return the intervals of all closed components, and the fragments of open surfaces."""
    face = layers.triangles.face[layers.triangle]
    component = world.component[face]
    closed = world.closed[component]
    fragment = closed.nonzero()[:, 0]
    single = (~closed).nonzero()[:, 0]
    if len(fragment) == 0:
        return Intervals(fragment, fragment, fragment), single

    # Fragments of one component along one ray, near to far, stand together.
    group = layers.pixel[fragment] * len(world.closed) + component[fragment]
    if len(world.closed) > 1:
        group, order = torch.sort(group, stable=True)
        fragment = fragment[order]
    front = layers.triangles.front[layers.triangle[fragment]]
    step = torch.where(front, 1, -1)
    starts = torch.ones_like(front)
    starts[1:] = group[1:] != group[:-1]
    run = starts.cumsum(0) - 1
    count = step.cumsum(0)
    total = torch.zeros(int(run[-1]) + 1, dtype=torch.long).index_add_(0, run, step)
    before_run = total.cumsum(0) - total
    # A closed surface has as many fronts as backs along a ray, but for the fronts behind the eye.
    around_eye = (-total).clamp(min=0)
    after = count - before_run[run] + around_eye[run]
    before = after - step
    opens, closes = (before <= 0) & (after > 0), (before > 0) & (after <= 0)

    # Within a run openings and closings take turns: each closing belongs to the event before it.
    event = (opens | closes).nonzero()[:, 0]
    is_open, event_run = opens[event], run[event]
    same_as_next = torch.zeros_like(is_open)
    same_as_next[:-1] = event_run[1:] == event_run[:-1]
    first, second = event[:-1], event[1:]
    paired = is_open[:-1] & same_as_next[:-1]
    unopened = ~is_open
    unopened[1:] &= ~paired
    unclosed = is_open & ~same_as_next
    none = torch.full((len(event),), -1)
    fronts = torch.cat([fragment[first[paired]], none[unopened], fragment[event[unclosed]]])
    backs = torch.cat([fragment[second[paired]], fragment[event[unopened]], none[unclosed]])
    pixel = layers.pixel[torch.maximum(fronts, backs)]
    return Intervals(pixel, fronts, backs), single


def find_candidates(
    scene: Scene, world: World, camera: Camera, layers: Layers, silhouette: Silhouette, *, depths: bool = True
) -> tuple[Candidates, Counts]:
    """Return everything a ray may end on, after the silhouette test.

    Args:
        scene: materials.
        world: the scene's meshes.
        camera: the view.
        layers: what it sees.
        silhouette: with "none" the mesostructure has no depth and every interval hits at its front; "paper" is the
            depth-interval test; "curved" the march of `curved_silhouette`.
        depths: whether it matters where a ray ends; a light only wants to know whether it does, and is spared the
            look-ups of everything that hits anyway.
    """
    found, single = find_intervals(layers, world)
    entries, single = _entries(scene, world, layers, single)
    if depths:
        found, single = _opaque(scene, world, layers, found, single, silhouette)
    has_front, has_back = found.front >= 0, found.back >= 0
    t_front = torch.where(has_front, layers.t[found.front.clamp(min=0)] if len(layers.t) else 0, 0.0)
    near = camera.near * rays(camera, found.pixel, layers.t.dtype)[2]
    t_front = torch.where(has_front, t_front, near)
    t_back = torch.where(has_back, layers.t[found.back.clamp(min=0)] if len(layers.t) else 0, torch.inf)
    ends = _Ends(scene, world, camera, layers, found, t_front, t_back, depths)
    if silhouette == "none":
        verdict = _Verdict(torch.ones_like(has_front), torch.zeros_like(t_front), 0)
    else:
        verdict = _test_paper(ends) if silhouette == "paper" else _test_curved(ends)
    hit, d_front, skipped = verdict
    counts = Counts(len(hit), skipped, int((~hit).sum()), int((hit & ~has_front).sum()))

    t_single = layers.t[single]
    d_single = torch.zeros_like(t_single)
    if silhouette != "none" and depths and len(single):
        facing = layers.triangles.front[layers.triangle[single]]
        d_single[facing] = _look(ends, single[facing], towards=True).depth(bottom=True)
    pixel = torch.cat([found.pixel[hit], layers.pixel[single]])
    fragment = torch.cat([found.front[hit], single])
    back = torch.cat([found.back[hit], torch.full_like(single, -1)])
    t = torch.cat([t_front[hit], t_single])
    depth = torch.cat([t_front[hit] + d_front[hit], t_single + d_single])
    nowhere = torch.full((len(pixel), 3), torch.nan, dtype=depth.dtype)
    plain = Candidates(pixel, fragment, back, t, depth, torch.full_like(back, -1), nowhere, back < -1)
    if world.shells and depths:
        within = _from_within(scene, world, camera, layers.t.dtype)
        plain = Candidates(*(torch.cat([a, b]) for a, b in zip(plain, within, strict=True)))
    if len(entries):
        met = _meet_gdms(scene, world, camera, layers, entries)
        counts = counts._replace(carved=counts.carved + len(entries) - len(met.pixel))
        plain = Candidates(*(torch.cat([a, b]) for a, b in zip(plain, met, strict=True)))
    return plain, counts


def _entries(scene: Scene, world: World, layers: Layers, single: Tensor) -> tuple[Tensor, Tensor]:
    """Return the fragments by which rays come into shells, and the rest: of shells, floors seen from below."""
    if not world.shells:
        return single[:0], single
    face = layers.triangles.face[layers.triangle[single]]
    dressed = torch.tensor([m.gdm is not None for m in scene.surfaces])[world.owner[face]]
    front = layers.triangles.front[layers.triangle[single]]
    enters = world.entry[face] >= 0
    return single[enters & front], single[~dressed | (front & ~enters)]


def _from_within(scene: Scene, world: World, camera: Camera, dtype: torch.dtype) -> Candidates:
    """Return what all rays meet whose eye is inside of shells; in a parallel view every eye is taken to be outside."""
    pixel = torch.arange(camera.width * camera.height)
    origin, direction, _ = rays(camera, pixel, torch.float64)
    origin, nothing = origin.expand(len(pixel), 3), torch.full_like(pixel, -1)
    found = []
    for placed in world.shells if camera.projection == "perspective" else ():
        for tet, place in zip(*shell.around(placed.shell, camera.eye), strict=True):
            entries = gdm_trace.Entries(origin, direction, tet.expand(len(pixel)), nothing, place.expand(len(pixel), 3))
            found.append(_met(scene, placed, entries, pixel, nothing, torch.zeros(len(pixel), dtype=dtype)))
    empty = torch.zeros(0, dtype=dtype)
    none = Candidates(pixel[:0], pixel[:0], pixel[:0], empty, empty, pixel[:0], empty[:, None].expand(0, 3), empty > 0)
    return Candidates(*(torch.cat(x) for x in zip(none, *found, strict=True)))


def _met(
    scene: Scene, placed: PlacedShell, entries: gdm_trace.Entries, pixel: Tensor, fragment: Tensor, t: Tensor
) -> Candidates:
    """Return where rays of one shell meet material."""
    dressing = scene.surfaces[placed.surface]
    traced = gdm_trace.trace(
        placed.shell, dressing.gdm, entries, queries=dressing.shell.queries, floor=dressing.shell.base == "solid"
    )
    depth = torch.maximum(traced.t.to(t.dtype), t)
    return Candidates(
        pixel, fragment, torch.full_like(pixel, -1), t, depth, traced.prism + placed.first_tet // 3,
        traced.place.to(t.dtype), traced.through == BOTTOM,
    ).select(traced.hit)  # fmt: skip


def _meet_gdms(scene: Scene, world: World, camera: Camera, layers: Layers, fragment: Tensor) -> Candidates:
    """Return where rays meet material, that come into shells at `fragment`."""
    found = []
    entry = world.entry[layers.triangles.face[layers.triangle[fragment]]]
    owner = world.owner[layers.triangles.face[layers.triangle[fragment]]]
    for placed in world.shells:
        mine = (owner == placed.surface).nonzero()[:, 0]
        if len(mine) == 0:
            continue
        own = fragment[mine]
        origin, direction, _ = rays(camera, layers.pixel[own], torch.float64)
        tet, corner = entry[mine] // 4 - placed.first_tet, entry[mine] % 4
        entries = gdm_trace.Entries(origin.expand(len(own), 3), direction, tet, corner)
        found.append(_met(scene, placed, entries, layers.pixel[own], own, layers.t[own]))
    return Candidates(*(torch.cat(x) for x in zip(*found, strict=True)))


def _opaque(
    scene: Scene, world: World, layers: Layers, found: Intervals, single: Tensor, silhouette: Silhouette
) -> tuple[Intervals, Tensor]:
    """Take bodies whose surface has no depth as opaque: every front face stops a ray, whatever is behind it."""
    plain = torch.tensor([silhouette == "none" or m.mdf is None for m in scene.surfaces])
    face = layers.triangles.face[layers.triangle]
    closed = world.closed[world.component[face]]
    front = layers.triangles.front[layers.triangle]
    single = torch.cat([single, (plain[world.owner[face]] & closed & front).nonzero()[:, 0]]).sort().values
    if len(found.front) == 0:
        return found, single
    kept = (found.front < 0) | ~plain[world.owner[face[found.front.clamp(min=0)]]]
    return Intervals(*(x[kept] for x in found)), single


def nearest(candidates: Candidates, depth: Float[Tensor, "n"]) -> Int[Tensor, "m"]:
    """Return, for each pixel that has any, the candidate with the least `depth`; ties go to the first fragment."""
    order = torch.argsort(candidates.fragment, stable=True)
    order = order[torch.argsort(depth[order], stable=True)]
    order = order[torch.argsort(candidates.pixel[order], stable=True)]
    pixel = candidates.pixel[order]
    first = torch.ones(len(pixel), dtype=torch.bool)
    first[1:] = pixel[1:] != pixel[:-1]
    return order[first]


class _Ends(NamedTuple):
    """The intervals of a picture and everything that is known about their ends."""

    scene: Scene
    world: World
    camera: Camera
    layers: Layers
    found: Intervals
    t_front: Tensor
    t_back: Tensor
    depths: bool


class _Verdict(NamedTuple):
    hit: Tensor  # (n,) whether the ray ends in the interval
    d_front: Tensor  # (n,) how far behind the front
    skipped: int  # intervals that hit by their length alone


def _test_paper(ends: _Ends) -> _Verdict:
    """wang2005mdf, section 4.1: both ends say how deep they are."""
    has_front, has_back = ends.found.front >= 0, ends.found.back >= 0
    d_front, reach_front = torch.zeros_like(ends.t_front), torch.zeros_like(ends.t_front)
    d_back, reach_back = torch.zeros_like(ends.t_back), torch.zeros_like(ends.t_back)
    fronts, backs = has_front.nonzero()[:, 0], has_back.nonzero()[:, 0]
    front = _look(ends, ends.found.front[fronts], towards=True)
    back = _look(ends, ends.found.back[backs], towards=False)
    reach_front[fronts], reach_back[backs] = front.reach(), back.reach()
    thin = ends.t_back - ends.t_front < reach_front + reach_back
    # Deep intervals hit whatever the back says, and the table is good enough for where; thin ones are asked closely.
    thin_front = thin[fronts]
    wanted = torch.arange(len(fronts)) if ends.depths else thin_front.nonzero()[:, 0]
    d_front[fronts[wanted]] = front.select(wanted).depth(closely=thin_front[wanted])
    thin_back = thin[backs].nonzero()[:, 0]
    d_back[backs[thin_back]] = back.select(thin_back).depth(closely=torch.ones(len(thin_back), dtype=torch.bool))
    hit = (d_front + d_back <= ends.t_back - ends.t_front) | ~has_front  # the eye inside sees the inside
    hit |= _relief(ends.scene)[_owner(ends, ends.found.front)] < 0  # without depth a surface is opaque
    return _Verdict(hit, d_front, int((~thin).sum()))


def _test_curved(ends: _Ends) -> _Verdict:
    """Follow the ray below the curved surface (`curved_silhouette`); through holes, ask as the paper does."""
    found = ends.found
    whole = (found.front >= 0) & (found.back >= 0)
    hit, d_front = torch.ones_like(whole), torch.zeros_like(ends.t_front)
    length = ends.t_back - ends.t_front
    fronts = (found.front >= 0).nonzero()[:, 0]
    owner = _owner(ends, found.front)
    if ends.depths:
        d_front[fronts] = _look(ends, found.front[fronts], towards=True).depth()
        d_front = torch.minimum(d_front, length)
    deep = torch.zeros_like(whole)
    relief = _relief(ends.scene)
    mixed = whole & (relief[_owner(ends, found.back)] != relief[owner])
    for i, mdf in enumerate(m.mdf for m in ends.scene.surfaces):
        mine = (whole & ~mixed & (owner == i)).nonzero()[:, 0]
        if mdf is None or len(mine) == 0:
            continue
        first = curved_silhouette.end(ends.world, ends.camera, ends.layers, found.front[mine], front=True)
        last = curved_silhouette.end(ends.world, ends.camera, ends.layers, found.back[mine], front=False)
        meeting = curved_silhouette.meet(first, last, length[mine], mdf)
        hit[mine], deep[mine] = meeting.hit, ~meeting.marched
        if ends.depths:
            # On long chords the circle is too flat and the march stops late; the planar look-up never does.
            d_front[mine] = torch.where(meeting.marched, meeting.at.minimum(d_front[mine]), d_front[mine])
        if mdf.no_hit is not None:
            through = mine[~meeting.marched]
            hit[through], d_front[through], _ = _test_paper(_select(ends, through))
            deep[through] = False
    # A march needs one relief from end to end; between two materials each end answers for itself.
    between = (mixed & (relief[owner] >= 0)).nonzero()[:, 0]
    if len(between):
        hit[between], d_front[between], _ = _test_paper(_select(ends, between))
    return _Verdict(hit, d_front, int(deep.sum()))


def _owner(ends: _Ends, fragment: Tensor) -> Tensor:
    """Return the surfaces of fragments; -1 where there is none."""
    owner = torch.full_like(fragment, -1)
    there = (fragment >= 0).nonzero()[:, 0]
    owner[there] = ends.world.owner[ends.layers.triangles.face[ends.layers.triangle[fragment[there]]]]
    return owner


def _relief(scene: Scene) -> Tensor:
    """Return the number of the mesostructure of each surface, and behind them of none; -1 where there is no depth."""
    numbers: dict[int, int] = {}
    mdfs = [m.mdf for m in scene.surfaces]
    return torch.tensor([-1 if m is None else numbers.setdefault(id(m), len(numbers)) for m in [*mdfs, None]])


def _select(ends: _Ends, which: Tensor) -> _Ends:
    found = Intervals(*(x[which] for x in ends.found))
    return ends._replace(found=found, t_front=ends.t_front[which], t_back=ends.t_back[which])


class _Look(NamedTuple):
    """Surface points and the local direction they are looked at from."""

    scene: Scene
    points: Points
    w: Tensor

    def select(self, which: Tensor) -> "_Look":
        return _Look(self.scene, self.points.select(which), self.w[which])

    def reach(self) -> Tensor:
        """Return the largest s D these angles can give; inf where a table holds an entry without a hit."""
        reach = torch.zeros_like(self.points.scale)
        for i, mdf in enumerate(m.mdf for m in self.scene.surfaces):
            if mdf is not None:
                bound = self.points.scale * (mdf.delta_max * mdf.h) / self.w[:, 2].clamp(min=MIN_COS)
                bound = bound if mdf.no_hit is None else torch.inf
                reach = torch.where(self.points.owner == i, bound, reach)
        return reach

    def depth(self, *, closely: Tensor | None = None, bottom: bool = False) -> Tensor:
        """Return s D in world units, 0 without an MDF, inf where there is no hit.

        `closely` marks the points whose answer decides a silhouette; with `bottom` a ray without a hit ends at the
        bottom of the slab (open surfaces).
        """
        depth = torch.zeros_like(self.points.scale)
        for i, mdf in enumerate(m.mdf for m in self.scene.surfaces):
            mine = self.points.owner == i
            if mdf is None or not bool(mine.any()):
                continue
            for method, group in (
                (mdf.evaluate, mine if closely is None else mine & ~closely),
                (mdf.distance, torch.zeros_like(mine) if closely is None else mine & closely),
            ):
                which = group.nonzero()[:, 0]
                if len(which) == 0:
                    continue
                s, w = self.points.scale[which], self.w[which]
                D = s * method(self.points.uv[which], w)
                lowest = s * mdf.h / w[:, 2].clamp(min=MIN_COS)
                depth[which] = torch.where(D.isinf(), lowest, D) if bottom else D
        return depth


def _look(ends: _Ends, fragment: Tensor, *, towards: bool) -> _Look:
    """Return the points at `fragment`, looked at from the eye (`towards`) or from behind."""
    points = interpolate(ends.world, ends.layers, ends.camera, fragment)
    direction = rays(ends.camera, ends.layers.pixel[fragment], ends.layers.t.dtype)[1]
    return _Look(ends.scene, points, frames.to_local(points.frame, -direction if towards else direction))
