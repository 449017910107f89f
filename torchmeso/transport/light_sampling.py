"""A few directional lights in place of an environment: spherical quadtree, median cut, uniform.

`quadtree` follows the Spherical Q2-tree as leung2007tileable, section 4.2, and the abstract of wan2005spherical
describe it: the sphere is cut by curvilinear equations into twelve quadrilaterals of equal area, which are halved at
the middle again and again, all quads of a level as large as each other (gorski2005healpix). The quad that is most
important, its luminance times the fourth root of its solid angle (agarwal2003structured, section 3), is halved next,
until there are twice as many as lights; then neighbours are joined, because fixed cuts go through what belongs
together. Sums over quads are made once for all levels. What changes in one place leaves the cuts elsewhere alone.
Regions belong to the map, not to the world: a map that turns takes its lights with it, and they do not flicker.

`median_cut` (debevec2005mediancut) halves the light of rectangles of a lat-long map; `uniform` gives each texel to the
nearest of evenly spread directions. In all of them a light carries all the light of its region, so their sum is the
map's whatever their number, and stands at the region's centre of light (`uniform`: at its own direction).

Test: tests/transport/test_light_sampling.py
"""

import heapq
import math
from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.data.environment import LUMINANCE, Environment, Texels
from torchmeso.errors import check_range
from torchmeso.geometry.light import DirectionalLight

Method = Literal["quadtree", "median_cut", "uniform"]

MOST_LIGHTS = 100_000
"""Of a picture: more take longer than to trace paths."""

FINEST = 9
"""Times that a side of the twelve quads is halved at most: 3.1 million quads, 0.1 degree wide."""

MOST_JOINED = 1024
"""Lights up to which quads are joined: the table of all pairs grows with the square, and what it saves shrinks."""

BASE = 12
"""Quads of the sphere that are halved."""


def lights(environment: Environment, count: int, *, method: Method = "quadtree") -> tuple[DirectionalLight, ...]:
    """Return at most `count` lights whose irradiances sum up to the environment's.

    There are fewer where fewer texels shine; none of a black map. They turn as the environment does.

    Raises:
        ConfigError: count is not in 1..100,000.
    """
    unturned = replace(environment, rotation=torch.eye(3))
    direction, irradiance = directions(unturned.texels(), count, method=method)
    direction = direction @ environment.rotation.double().mT
    return tuple(
        DirectionalLight(direction=w, irradiance=E)
        for w, E in zip(direction.float().unbind(0), irradiance.float().unbind(0), strict=True)
    )


def directions(
    texels: Texels, count: int, *, method: Method = "quadtree"
) -> tuple[Float[Tensor, "light 3"], Float[Tensor, "light 3"]]:
    """Return directions towards the lights, unit, world, and their irradiances, float64.

    Raises:
        ConfigError: count is not in 1..100,000.
    """
    check_range("lights of an environment", count, 1, MOST_LIGHTS)
    energy = texels.solid_angle[:, None] * texels.radiance
    some = energy.amax(1) > 0
    w, energy = texels.directions[some], energy[some]
    if not len(w):
        return w, energy
    pick = {"quadtree": _quadtree, "median_cut": _median_cut, "uniform": _uniform}[method]
    return pick(w, energy, count)


def _moments(w: Tensor, energy: Tensor) -> Float[Tensor, "n 7"]:
    """Return red, green, blue, luminance, and directions times luminance."""
    luminance = energy @ energy.new_tensor(LUMINANCE)
    return torch.cat([energy, luminance[:, None], luminance[:, None] * w], 1)


def _centres(moments: Float[Tensor, "n 7"], otherwise: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Return where the light of regions has its centre; where it cancels out, `otherwise`."""
    length = moments[:, 4:].norm(dim=1, keepdim=True)
    vague = length <= 1e-9 * moments[:, 3:4]
    return torch.where(vague, otherwise, moments[:, 4:] / length.clamp(min=1e-300))


def _quadtree(w: Tensor, energy: Tensor, count: int) -> tuple[Tensor, Tensor]:
    # A cell is at most about as large as a texel of a map whose texels all shine.
    halvings = min(max(math.ceil(math.log2(max(len(w), 1) / BASE) / 2), 0) + 1, FINEST)
    levels = _sums(w, _moments(w, energy), halvings)
    sizes = [x.shape[1:3] for x in levels]
    luminance = [x[..., 3].flatten().tolist() for x in levels]
    heap: list[tuple[float, int, int]] = []

    def push(level: int, cell: int) -> None:
        light = luminance[level][cell]
        if light > 0:
            last = level == len(levels) - 1
            heapq.heappush(heap, (0.0 if last else -light * 2 ** (-level / 4), level, cell))

    for quad in range(BASE):
        push(0, quad)
    wanted = 2 * count if count <= MOST_JOINED else count
    while len(heap) < wanted and heap[0][0] < 0:
        _, level, cell = heapq.heappop(heap)
        rows, columns = sizes[level]
        quad, rest = divmod(cell, rows * columns)
        row, column = divmod(rest, columns)
        for half in (0, 1):
            if sizes[level + 1][0] == rows:
                push(level + 1, (quad * rows + row) * 2 * columns + 2 * column + half)
            else:
                push(level + 1, (quad * 2 * rows + 2 * row + half) * columns + column)
    leaves = torch.stack([levels[level].reshape(-1, 7)[cell] for _, level, cell in heap])
    middle = torch.stack([_middle(cell, *sizes[level]) for _, level, cell in heap])
    return _joined(leaves, _centres(leaves, middle), count)


def _joined(moments: Float[Tensor, "n 7"], w: Float[Tensor, "n 3"], count: int) -> tuple[Tensor, Tensor]:
    """Return lights of `count` regions: again and again the two are joined whose light suffers least from it.

    That is L1 L2 / (L1 + L2) |w1 - w2|^(1/2): the light that moves, times how much a picture changes by it. Shadows'
    edges change it by the way, what is smooth by its square; averaged over a knot's points the root fits best.
    """
    moments, w = moments.clone(), w.clone()
    alive = torch.ones(len(w), dtype=torch.bool)

    def ways(i: int) -> Tensor:
        L = moments[:, 3]
        way = (w - w[i]).norm(dim=1).sqrt() * L * L[i] / (L + L[i])
        return way.masked_fill(~alive, math.inf).index_fill(0, torch.tensor([i]), math.inf)

    if len(w) <= count:
        return w, moments[:, :3]
    table = torch.stack([ways(i) for i in range(len(w))])
    shortest, partner = table.min(1)
    for _ in range(len(w) - count):
        i = int(shortest.argmin())
        j = int(partner[i])
        moments[i] += moments[j]
        w[i] = _centres(moments[i : i + 1], w[i : i + 1])[0]
        alive[j] = False
        table[j], table[:, j] = math.inf, math.inf
        table[i] = table[:, i] = ways(i)
        stale = (partner == i) | (partner == j) | (table[:, i] < shortest)
        stale[i] = stale[j] = True
        shortest[stale], partner[stale] = table[stale].min(1)
    return w[alive], moments[alive, :3]


def _sums(w: Tensor, moments: Tensor, halvings: int) -> list[Float[Tensor, "quad row column 7"]]:
    """Return sums over the quads of every level; each level has twice as many, halved across, then down."""
    n = 1 << halvings
    quad, x, y = to_quads(w)
    column, row = ((a * n).long().clamp(0, n - 1) for a in (x, y))
    cells = moments.new_zeros(BASE * n * n, 7).index_add_(0, (quad * n + row) * n + column, moments)
    levels = [cells.reshape(BASE, n, n, 7)]
    while levels[-1].shape[2] > 1 or levels[-1].shape[1] > 1:
        square = levels[-1].shape[1] == levels[-1].shape[2]
        axis = 1 if square else 2
        levels.append(levels[-1].unflatten(axis, (-1, 2)).sum(axis + 1))
    return levels[::-1]


def _middle(cell: int, rows: int, columns: int) -> Float[Tensor, "3"]:
    quad, rest = divmod(cell, rows * columns)
    row, column = divmod(rest, columns)
    place = torch.tensor([[(column + 0.5) / columns, (row + 0.5) / rows]], dtype=torch.float64)
    return from_quads(torch.tensor([quad]), place[:, 0], place[:, 1])[0]


def to_quads(w: Float[Tensor, "n 3"]) -> tuple[Int[Tensor, "n"], Float[Tensor, "n"], Float[Tensor, "n"]]:
    """Return in which of the twelve quads unit directions lie, and where in it, in [0, 1] twice.

    gorski2005healpix, section 4 and appendix A, with +y up: a belt |y| < 2/3 where quads are squares of azimuth and
    height, and caps where four of them meet at each pole. Areas of the unit square are areas on the sphere, times pi/3.
    """
    height = w[:, 1].clamp(-1, 1)
    turn = (torch.atan2(w[:, 0], w[:, 2]) / (math.pi / 2)) % 4
    turn = torch.where(turn >= 4, 0, turn)
    falling, rising = 0.5 + turn - 0.75 * height, 0.5 + turn + 0.75 * height
    i, j = falling.floor(), rising.floor()
    belt = torch.where(i == j, i % 4 + 4, torch.where(i < j, i % 4, j % 4 + 8))
    quarter = turn.floor()
    radius = (3 * (1 - height.abs())).clamp(min=0).sqrt()
    p, m = (turn - quarter) * radius, (1 - turn + quarter) * radius
    cap, north = height.abs() > 2 / 3, height > 0
    quad = torch.where(cap, torch.where(north, quarter, quarter + 8), belt).long()
    x = torch.where(cap, torch.where(north, 1 - m, p), rising - j)
    y = torch.where(cap, torch.where(north, 1 - p, m), 1 - (falling - i))
    return quad, x.clamp(0, 1), y.clamp(0, 1)


def from_quads(quad: Int[Tensor, "n"], x: Float[Tensor, "n"], y: Float[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Return the unit directions at places of quads: the inverse of `to_quads`."""
    ring = 2 + quad // 4 - x - y
    first = 2 * (quad % 4) + (quad // 4 != 1).to(x.dtype)
    edge = torch.minimum(torch.minimum(ring, 4 - ring), torch.ones_like(ring)).clamp(min=1e-12)
    height = torch.where(
        ring < 1, 1 - edge.square() / 3, torch.where(ring > 3, edge.square() / 3 - 1, (4 - 2 * ring) / 3)
    )
    phi = math.pi / 4 * (first + (x - y) / edge)
    r = (1 - height.square()).clamp(min=0).sqrt()
    return torch.stack([r * phi.sin(), height, r * phi.cos()], -1)


def _median_cut(w: Tensor, energy: Tensor, count: int) -> tuple[Tensor, Tensor]:
    rows = min(max(math.isqrt(len(w) // 2), 1), 1024)
    columns = 2 * rows
    theta, phi = w[:, 1].clamp(-1, 1).acos(), torch.atan2(w[:, 0], -w[:, 2])
    row = (theta * (rows / math.pi)).long().clamp(0, rows - 1)
    column = ((phi / (2 * math.pi) + 0.5) * columns).long().clamp(0, columns - 1)
    grid = w.new_zeros(rows * columns, 7).index_add_(0, row * columns + column, _moments(w, energy))
    grid = grid.reshape(rows, columns, 7)
    heap = [(-float(grid[..., 3].sum()), 0, 0, rows, 0, columns)]
    while len(heap) < count and heap[0][0] < 0:
        light, _, top, bottom, left, right = heapq.heappop(heap)
        part = grid[top:bottom, left:right, 3]
        width = (right - left) * math.sin(math.pi * (top + bottom) / 2 / rows)
        across = right - left > 1 and (width >= bottom - top or bottom - top == 1)
        if not across and bottom - top == 1:
            heapq.heappush(heap, (0.0, len(heap), top, bottom, left, right))  # a texel stays whole
            continue
        running = part.sum(0 if across else 1).cumsum(0)
        cut = int((running[:-1] + light / 2).abs().argmin()) + 1
        halves = (
            [(top, bottom, left, left + cut), (top, bottom, left + cut, right)]
            if across
            else [(top, top + cut, left, right), (top + cut, bottom, left, right)]
        )
        for a, b, c, d in halves:
            some = float(grid[a:b, c:d, 3].sum())
            if some > 0:
                heapq.heappush(heap, (-some, len(heap), a, b, c, d))
    total = torch.stack([grid[a:b, c:d].sum((0, 1)) for _, _, a, b, c, d in heap])
    return _centres(total, w.new_tensor([0.0, 1.0, 0.0]).expand(len(total), 3)), total[:, :3]


def _uniform(w: Tensor, energy: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return directions on a spiral of equal turns (golden angle), with the light of the texels nearest to each."""
    k = torch.arange(count, dtype=w.dtype) + 0.5
    height, phi = 1 - 2 * k / count, k * (math.pi * (3 - math.sqrt(5)))
    r = (1 - height.square()).sqrt()
    spread = torch.stack([r * phi.cos(), height, r * phi.sin()], -1)
    nearest = torch.cat([(part @ spread.mT).argmax(1) for part in w.split(max(1, (1 << 24) // count))])
    total = w.new_zeros(count, 3).index_add_(0, nearest, energy)
    shines = total.amax(1) > 0
    return spread[shines], total[shines]
