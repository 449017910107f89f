"""Triangulated direction sets: the three nodes around each direction, and their barycentric weights.

View-dependent texture mapping blends the three views around the viewer (kawasaki2005quilting, section 2). Two
neighbouring rings of a `DirectionSet` bound a strip of the plane (phi, theta); cross edges from the inner to the outer
ring cut it into triangles, each with its base on one ring and its tip on the other, the shorter diagonal first. In a
strip of height f = (theta - theta_in) / (theta_out - theta_in) a cross edge e stands at

    p_e(f) = (1 - f) phi_in(e) + f phi_out(e),

which grows with e, so that a bisection finds the triangle; weights are linear in f and in g, the share of the way
from p_e to p_(e+1). Rings are linear in phi from both sides and the pole is one node: C0 on the whole hemisphere,
exact at the nodes. Below the last ring its value is held.

Kernel: kernels_cl/common/triangulation.clh          Test: tests/geometry/test_triangulation.py
"""

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.geometry import hemisphere
from torchmeso.geometry.directions import to_angles
from torchmeso.geometry.hemisphere import DirectionSet

BEYOND = 1e9
"""Azimuth of the edges that fill a strip's table: no direction lies beyond it."""

TIE = 1e-9
"""Radians: diagonals that differ by less are alike, whatever was rounded."""


class Blend(NamedTuple):
    """The corners of the triangle around each direction, and their shares.

    Attributes:
        node: (..., 3) in [0, n_nodes), as `hemisphere.with_pole` orders tables.
        weight: (..., 3) in [0, 1], sums to 1.
    """

    node: Int[Tensor, "*batch 3"]
    weight: Float[Tensor, "*batch 3"]


class Strips(NamedTuple):
    """The triangles of a set; a strip holds `room` edges, a power of two, of which `triangles` + 1 are its own.

    Attributes:
        theta: (strip + 1) radians, of the rings.
        triangles: (strip) how many; the last edge is the first one, a turn later.
        phi: (strip, room, 2) radians, growing: where edges leave the inner ring, and where they reach the outer one.
        node: (strip, room, 2) of the inner and of the outer ring.
    """

    theta: Float[Tensor, "_"]
    triangles: Int[Tensor, "strip"]
    phi: Float[Tensor, "strip room 2"]
    node: Int[Tensor, "strip room 2"]


def interpolate(directions: DirectionSet, w: Float[Tensor, "*batch 3"]) -> Blend:
    """Return the three nodes around each direction `w` and their weights.

    Args:
        directions: the set.
        w: (..., 3) direction, local frame; below the last ring, also below the horizon, the ring's value is held.

    Returns:
        two of the nodes may be the same one. Differentiable in `w` but for the kinks at the edges.
    """
    table = strips(directions)
    theta, phi = to_angles(w)
    rings = table.theta.to(w.dtype)
    theta = theta.clamp(max=rings[-1])
    k = (torch.searchsorted(rings, theta.detach().contiguous(), right=True) - 1).clamp(0, len(table.triangles) - 1)
    f = ((theta - rings[k]) / (rings[k + 1] - rings[k]).clamp(min=torch.finfo(w.dtype).tiny)).clamp(0, 1)
    room = table.phi.shape[1]
    positions = table.phi.to(w.dtype).flatten(0, 1)

    def place(edge: Tensor) -> Tensor:
        inner, outer = positions[edge].unbind(-1)
        return (1 - f) * inner + f * outer

    first = k * room
    start = place(first)
    phi = phi - 2 * math.pi * ((phi - start) / (2 * math.pi)).detach().floor()
    edge, step = first, room // 2
    while step:
        edge = torch.where(place(edge + step) <= phi, edge + step, edge)
        step //= 2
    edge = torch.minimum(edge, first + table.triangles[k] - 1)
    here, there = place(edge), place(edge + 1)
    g = ((phi - here) / (there - here).clamp(min=torch.finfo(w.dtype).tiny)).clamp(0, 1)
    inner, outer = table.node.flatten(0, 1)[edge].unbind(-1)
    inner_next, outer_next = table.node.flatten(0, 1)[edge + 1].unbind(-1)
    tip_outside = inner != inner_next
    third = torch.where(tip_outside, inner_next, outer_next)
    weight = torch.stack(
        [
            torch.where(tip_outside, (1 - f) * (1 - g), 1 - f),
            torch.where(tip_outside, f, f * (1 - g)),
            torch.where(tip_outside, (1 - f) * g, f * g),
        ],
        -1,
    )
    return Blend(torch.stack([inner, outer, third], -1), weight)


@lru_cache(maxsize=64)
def strips(directions: DirectionSet) -> Strips:
    """Return the triangles of `directions`, in float64."""
    rings = hemisphere.rings(directions)
    if len(rings.theta) == 1:  # the pole alone
        pairs, theta = [(0, 0)], rings.theta.repeat(2)
    else:
        pairs, theta = [(k, k + 1) for k in range(len(rings.theta) - 1)], rings.theta
    zipped = [_zip(rings, inner, outer) for inner, outer in pairs]
    triangles = torch.tensor([len(edges) - 1 for edges in zipped])
    room = 1 << int(triangles.max()).bit_length()
    phi = torch.full((len(zipped), room, 2), BEYOND, dtype=torch.float64)
    node = torch.zeros(len(zipped), room, 2, dtype=torch.long)
    for strip, edges in enumerate(zipped):
        phi[strip, : len(edges)] = torch.tensor([edge[:2] for edge in edges], dtype=torch.float64)
        node[strip, : len(edges)] = torch.tensor([edge[2:] for edge in edges])
    return Strips(theta, triangles, phi, node)


def _zip(rings: hemisphere.Rings, inner: int, outer: int) -> list[tuple[float, float, int, int]]:
    """Return the cross edges of a strip: azimuths and nodes inside and outside, around the whole turn."""
    n_in, n_out = int(rings.size[inner]), int(rings.size[outer])
    at_in, at_out = float(rings.phi0[inner]), float(rings.phi0[outer])
    first_in, first_out = int(rings.offset[inner]), int(rings.offset[outer])
    turn = 2 * math.pi
    if n_in == 1 and float(rings.theta[inner]) == 0:  # the pole has every azimuth
        angles = [at_out + turn * j / n_out for j in range(n_out + 1)]
        return [(phi, phi, first_in, first_out + j % n_out) for j, phi in enumerate(angles)]
    nearest = round((at_in - at_out) * n_out / turn)

    def phi_in(i: int) -> float:
        return at_in + turn * i / n_in

    def phi_out(j: int) -> float:
        return at_out + turn * (nearest + j) / n_out

    edges, i, j = [], 0, 0
    while True:
        nodes = first_in + i % n_in, first_out + (nearest + j) % n_out
        edges.append((phi_in(i), phi_out(j), *nodes))
        if i == n_in and j == n_out:
            return edges
        along_in, along_out = abs(phi_in(i + 1) - phi_out(j)), abs(phi_out(j + 1) - phi_in(i))
        if j == n_out or (i < n_in and along_in < along_out - TIE):
            i += 1
        else:
            j += 1
