"""Convex polygons against half-spaces, many at once.

Polygons are padded arrays with a count of corners. A cut point is computed from the corner inside towards the
corner outside, so two polygons that share an edge are cut at the same place, bit for bit.

Test: tests/geometry/test_clip.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor


class Polygons(NamedTuple):
    """Convex polygons with up to K corners of D coordinates.

    Attributes:
        points: (m, K, D); corners beyond the count are meaningless.
        count: (m,) corners; below 3 a polygon is empty.
    """

    points: Float[Tensor, "m K D"]
    corners: Int[Tensor, "m"]


def cut(polygons: Polygons, distance: Float[Tensor, "m K"]) -> Polygons:
    """Return what is left of each polygon where `distance`, linear over it, is not negative.

    Args:
        polygons: the polygons.
        distance: (m, K) signed distance of each corner from the cutting plane, any positive multiple.

    Returns:
        polygons with one more possible corner; every coordinate is interpolated linearly at cut points.
    """
    points, corners = polygons
    m, size, _ = points.shape
    slot = torch.arange(size)
    valid = slot < corners[:, None]
    following = torch.where(slot + 1 < corners[:, None], slot + 1, 0)
    ahead = points.gather(1, following[..., None].expand_as(points))
    distance_ahead = distance.gather(1, following)
    inside = (distance >= 0) & valid
    inside_ahead = distance_ahead >= 0
    crosses = (inside != inside_ahead) & valid

    # From the corner inside to the one outside, whichever way the edge runs.
    near = torch.where(inside[..., None], points, ahead)
    far = torch.where(inside[..., None], ahead, points)
    d_near = torch.where(inside, distance, distance_ahead)
    d_far = torch.where(inside, distance_ahead, distance)
    share = d_near / torch.where(crosses, d_near - d_far, 1)
    met = near + share[..., None] * (far - near)

    # Each corner is followed by the cut point of its edge; those that remain move to the front.
    both = torch.stack([points, met], 2).flatten(1, 2)
    keep = torch.stack([inside, crosses], 2).flatten(1)
    order = torch.argsort((~keep).to(torch.uint8), dim=1, stable=True)[:, : size + 1]
    kept = both.gather(1, order[..., None].expand(m, order.shape[1], points.shape[2]))
    return Polygons(kept, keep.sum(1))


def fan(polygons: Polygons) -> tuple[Float[Tensor, "n 3 D"], Int[Tensor, "n"]]:
    """Return the triangles of all polygons, as fans around their first corner, and the polygon each comes from."""
    points, corners = polygons
    triangles, source = [], []
    for k in range(1, points.shape[1] - 1):
        which = (corners > k + 1).nonzero()[:, 0]
        triangles.append(points[which][:, [0, k, k + 1]])
        source.append(which)
    return torch.cat(triangles), torch.cat(source)
