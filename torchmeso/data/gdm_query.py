"""How a generalised displacement map is asked, whatever form its samples are kept in.

wang2004gdm, section 3.1. Eight voxels around a point times four directions around a ray are samples, each of one of
three cases: a hit, `left`, or inside solid. Which case a query is is decided by weight; the samples of that case alone
are averaged. `data.gdm` says what the cases are and how distances are carried to the point.

Test: tests/data/test_gdm.py
"""

from typing import NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.data import address
from torchmeso.geometry.sphere import SphereGrid

LEVEL = 1e-12
"""Rays that climb by less per unit of way never leave the slab."""

APART = 4.0
"""Voxels between distances that are not of one surface."""

BLOCK = 1 << 12
"""Rays that are asked for together: their samples stay in the cache."""


class Query(NamedTuple):
    """What a ray meets.

    Attributes:
        distance: (...) way to the material, or to where the table ends for a ray that meets none.
        left: (...) whether it meets none until there.
        near: (...) way to the nearest surface that samples tell of, fewer than half of them where `left`; inf where
            there is none.
    """

    distance: Float[Tensor, "*batch"]
    left: Bool[Tensor, "*batch"]
    near: Float[Tensor, "*batch"]


@runtime_checkable
class Slab(Protocol):
    """What rays run through."""

    @property
    def h(self) -> float:
        """Slab depth, tile units."""
        ...

    @property
    def cap(self) -> float:
        """Longest distance, tile units."""
        ...


@runtime_checkable
class Voxels(Protocol):
    """A number for each voxel: a tensor, or what can be asked as one."""

    def __getitem__(self, voxel: Int[Tensor, "*batch"], /) -> Float[Tensor, "*batch"]:
        """Return the numbers of voxels."""
        ...


@runtime_checkable
class Sampled(Slab, Protocol):
    """Samples over voxels and directions: `data.gdm.Gdm`, or `data.gdm_svd.GdmSvd`."""

    @property
    def voxels(self) -> tuple[int, int, int]:
        """Layers, height and width."""
        ...

    @property
    def directions(self) -> SphereGrid:
        """The directions of travel."""
        ...

    @property
    def solid(self) -> Voxels:
        """1 where a voxel is inside of material."""
        ...

    def samples(
        self, voxel: Int[Tensor, "*batch 8"], node: Int[Tensor, "*batch 4"], dtype: torch.dtype
    ) -> tuple[Float[Tensor, "*batch 8 4"], Float[Tensor, "*batch 8 4"]]:
        """Return distances in tile units, any number where they are of no hit, and 1 where they are of one."""
        ...


def query(table: Sampled, place: Float[Tensor, "*batch 3"], w: Float[Tensor, "*batch 3"]) -> Query:
    """Return how far it is from `place` along `w` to material; see `Gdm.evaluate`."""
    rays = place.reshape(-1, 3)
    if len(rays) <= BLOCK:
        return _query(table, place, w)
    parts = [_query(table, *part) for part in zip(rays.split(BLOCK), w.reshape(-1, 3).split(BLOCK), strict=True)]
    return Query(*(torch.cat(x).reshape(place.shape[:-1]) for x in zip(*parts, strict=True)))


def _query(table: Sampled, place: Tensor, w: Tensor) -> Query:
    voxel, weight, away = corners(table, place)
    toward = table.directions.interpolate(w)
    solid = table.solid[voxel]
    inside = (weight * solid).sum(-1) > 0.5
    ahead = (away * w[..., None, :]).sum(-1)
    share = ((weight * (1 - solid))[..., :, None] * toward.weight[..., None, :]).flatten(-2)
    found, met = (x.flatten(-2) for x in table.samples(voxel, toward.node, share.dtype))
    hits, misses = (share * met).sum(-1), (share * (1 - met)).sum(-1)
    carried = found + ahead.unsqueeze(-1).expand(*ahead.shape, 4).flatten(-2)
    of_one, first = _of_one_surface(carried, share * met, hits, APART * voxel_side(table))
    # A ray towards corners inside solid meets something, though its neighbours that start outside may pass.
    before = weight * solid * (ahead > 0)
    blocks = before.sum(-1)
    at_corner = (before * ahead).sum(-1) / blocks.clamp(min=1e-12)
    distance, first = (torch.where(hits > 1e-6, x, at_corner) for x in (of_one, first))
    hits = hits + blocks
    end = boundary(table, place, w)
    left = ~inside & (misses >= hits)
    distance = torch.minimum(distance.clamp(min=0), end)
    near = torch.where(hits > 1e-6, torch.minimum(first.clamp(min=0), distance), torch.inf)
    return Query(torch.where(inside, 0, torch.where(left, end, distance)), left, near)


def safe_way(table: Sampled, place: Float[Tensor, "*batch 3"], w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Return how far along `w` no sample around tells of material: the least of their distances, carried to `place`.

    The conservative table: a mean may step past an edge that one of its samples sees, this does not. A corner inside
    solid counts with the way to it; 0 where one lies beside or behind, `boundary` where no sample meets anything.
    """
    voxel, _, away = corners(table, place)
    ahead = (away * w[..., None, :]).sum(-1, keepdim=True)
    found, met = table.samples(voxel, table.directions.interpolate(w).node, ahead.dtype)
    free = torch.where(met > 0.5, found + ahead, torch.inf)
    free = torch.where(table.solid[voxel].unsqueeze(-1) > 0.5, ahead, free).flatten(-2).amin(-1)
    return torch.minimum(free.clamp(min=0), boundary(table, place, w))


def approach(table: Sampled, place: Float[Tensor, "n 3"], w: Float[Tensor, "n 3"], *, queries: int) -> Query:
    """Return what rays meet, asked again on their way: an error of direction is in proportion to the distance.

    Every look-up but the last goes the safe way, or, beside a surface where there is none, half of what the mean tells
    and a voxel at most. A ray is done where material is less than a voxel away.

    Args:
        table: the samples.
        place: (n, 3) as of `query`.
        w: (n, 3) unit direction of travel.
        queries: most look-ups for a ray; 1 is `query`.
    """
    side, end = voxel_side(table), boundary(table, place, w)
    way, left, near = torch.zeros_like(end), torch.zeros_like(end, dtype=torch.bool), torch.full_like(end, torch.inf)
    ray = torch.arange(len(place))
    for k in range(queries):
        at = place[ray] + way[ray, None] * w[ray]
        found = query(table, at, w[ray])
        last = (found.distance < side) | (k + 1 == queries)
        step = torch.maximum(safe_way(table, at, w[ray]), (found.distance / 2).clamp(max=side))
        left[ray], near[ray] = found.left, way[ray] + found.near
        way[ray] = torch.minimum(way[ray] + torch.where(last, found.distance, step), end[ray])
        ray = ray[~last & (way[ray] < end[ray])]
        if not len(ray):
            break
    return Query(way, left, near)


def _of_one_surface(carried: Tensor, share: Tensor, hits: Tensor, apart: float) -> tuple[Tensor, Tensor]:
    """Return the mean of distances, twice; of two surfaces that of the larger share, and the first one's."""
    total = (share * carried).sum(-1)
    mean = total / hits.clamp(min=1e-12)
    near = share * (carried <= mean.unsqueeze(-1))
    nearer, before = near.sum(-1), (near * carried).sum(-1)
    farther = hits - nearer
    first, second = before / nearer.clamp(min=1e-12), (total - before) / farther.clamp(min=1e-12)
    two = (second - first > apart) & (nearer > 1e-6) & (farther > 1e-6)
    return torch.where(two, torch.where(nearer >= farther, first, second), mean), torch.where(two, first, mean)


def voxel_side(table: Sampled) -> float:
    """Return the longest side of a voxel, tile units."""
    layers, height, width = table.voxels
    return max(1 / width, 1 / height, table.h / (layers - 1))


def boundary(table: Slab, place: Float[Tensor, "*batch 3"], w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Return the way along `w` to the top or bottom of the slab, at most `cap`."""
    z = place[..., 2].clamp(-table.h, 0)
    climb = w[..., 2]
    way = torch.where(climb > 0, -z, -(z + table.h)) / torch.where(climb.abs() < LEVEL, 1, climb)
    return torch.where(climb.abs() < LEVEL, table.cap, way).clamp(0, table.cap)


def corners(table: Sampled, place: Float[Tensor, "*batch 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Return the eight voxels around `place`, their weights, and the ways from `place` to them, tile units."""
    layers, height, width = table.voxels
    taps = address.bilinear(place[..., :2], height, width)
    x = (place[..., 0] - place[..., 0].detach().floor()) * width - 0.5
    y = (1 - (place[..., 1] - place[..., 1].detach().floor())) * height - 0.5
    fx, fy = x - x.detach().floor(), y - y.detach().floor()
    z = ((place[..., 2] + table.h) * ((layers - 1) / table.h)).clamp(0, layers - 1)
    below = z.detach().floor().clamp(max=layers - 2)
    fz = z - below
    plane = height * width
    lower = below.long().unsqueeze(-1) * plane + taps.texel
    voxel = torch.cat([lower, lower + plane], -1)
    weight = torch.cat([taps.weight * (1 - fz).unsqueeze(-1), taps.weight * fz.unsqueeze(-1)], -1)
    step = table.h / (layers - 1)
    columns = torch.stack([-fx, 1 - fx, -fx, 1 - fx] * 2, -1) / width
    rows = torch.stack([fy, fy, fy - 1, fy - 1] * 2, -1) / height
    heights = torch.stack([-fz] * 4 + [1 - fz] * 4, -1) * step
    return voxel, weight, torch.stack([columns, rows, heights], -1)
