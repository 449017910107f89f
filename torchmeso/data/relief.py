"""The relief of an MDF: the height map that its steepest views agree on, finer than its texels.

Between two azimuths of a table (24 degrees apart in grid(15, 10, 87.5)) no interpolation of distances can know
that a ray runs along a joint, and exactly there silhouettes have their notches. But the first ring, a few
degrees off the normal, sees the surface itself:

1. every view of the first ring is carried to the vertical, x = uv - tan(theta) z, and the views are joined by
   their median (what one view cannot see, the others do);
2. the map is refined with a piecewise-linear rule: where slopes turn, the lines of both sides are continued to
   their intersection, so that edges are placed inside a texel instead of being rounded over it.

A ray is then marched through the relief. Overhangs are filled: what lies under them is left to the table.

Kernel: none          Test: tests/data/test_relief.py
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso.data import address
from torchmeso.data.quilting_map import QuiltingMap

REFINEMENT = 4
"""Texels of the relief per texel of the table, along a side."""

CODES = 65535
"""Depths are multiples of h / 65535: what kernels keep in 16 bits is then the same."""

STEEPEST_STEPS, FINEST_STEPS = 16, 1024
"""A ray takes one relief texel per step, but at least 16 and at most 1024 steps through the slab."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Relief:
    """A height map with holes.

    Attributes:
        drop: (H, W) depth below the reference plane in tile units, in [0, h].
        hole: (H, W) true where there is no material, or None where there is material everywhere.
        h: slab depth in tile units.
        quilting: a larger texture made of the map's texels, or None: the map repeats.
    """

    drop: Float[Tensor, "H W"]
    hole: Bool[Tensor, "H W"] | None
    h: float
    quilting: QuiltingMap | None = None

    def depth(self, uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """Return the depth of the material straight below `uv`, in tile units; inf in holes."""
        taps = address.bilinear(uv, self.drop.shape[0], self.drop.shape[1], self.quilting)
        depth = (self.drop.flatten()[taps.texel] * taps.weight).sum(-1)
        if self.hole is None:
            return depth
        open_share = (self.hole.flatten()[taps.texel] * taps.weight).sum(-1)
        return torch.where(open_share > 0.5, torch.inf, depth)

    def march(self, uv: Float[Tensor, "n 2"], wo: Float[Tensor, "n 3"], min_cos: float) -> Float[Tensor, "n"]:
        """Return D(uv, wo): the distance along -wo from the reference plane to the relief; inf where none is met.

        Args:
            uv: (n, 2) where the ray meets the reference plane.
            wo: (n, 3) unit, local frame.
            min_cos: cosines below it are lifted to it.
        """
        cosine = wo[:, 2].clamp(min=min_cos)
        slope = torch.nn.functional.normalize(wo[:, :2], dim=-1)
        slope = slope * ((1 - cosine.square()).clamp(min=0).sqrt() / cosine).unsqueeze(-1)
        texel = 1 / max(self.drop.shape)
        steps = (self.h * slope.norm(dim=-1) / texel).clamp(STEEPEST_STEPS, FINEST_STEPS)
        step = self.h / steps

        def clearance(which: Tensor, z: Tensor) -> Tensor:
            return self.depth(uv[which] - slope[which] * z.unsqueeze(-1)) - z

        z = torch.full_like(cosine, torch.inf)
        active = torch.arange(len(uv))
        upper = torch.zeros_like(cosine)
        over = clearance(active, upper)
        z[over <= 0] = 0
        active = (over > 0).nonzero()[:, 0]
        upper, over = upper[active], over[active]
        while len(active):
            lower = torch.minimum(upper + step[active], torch.full_like(upper, self.h))
            under = clearance(active, lower)
            met = (under <= 0).nonzero()[:, 0]
            z[active[met]] = _meeting(upper[met], over[met], lower[met], under[met])
            on = ((under > 0) & (lower < self.h)).nonzero()[:, 0]
            active, upper, over = active[on], lower[on], under[on]
        return z / cosine


def from_views(
    drop: Float[Tensor, "view H W"],
    no_hit: Bool[Tensor, "view H W"] | None,
    slope: Float[Tensor, "view 2"],
    h: float,
) -> Relief:
    """Return the relief that views close to the normal agree on.

    Args:
        drop: (view, H, W) depth of what each view sees at each texel of the reference plane, tile units.
        no_hit: (view, H, W) where a view sees nothing, or None.
        slope: (view, 2) horizontal shift of a view's ray per unit of depth, wo.xy / wo.z.
        h: slab depth.
    """
    _, height, width = drop.shape
    below = address.texel_centres(height, width).reshape(-1, 2)
    filled = drop if no_hit is None else torch.where(no_hit, h, drop)
    seen = torch.stack([_to_vertical(z, s, below) for z, s in zip(filled, slope, strict=True)])
    joined = seen.median(0).values.reshape(height, width)
    hole = None
    if no_hit is not None:
        open_share = no_hit.float().mean(0) > 0.5
        hole = open_share.repeat_interleave(REFINEMENT, 0).repeat_interleave(REFINEMENT, 1)
    # A hair above the bottom of the slab, so that rounding cannot let a ray through a floor that lies there.
    codes = (refine(joined, REFINEMENT) / h * CODES).round().clamp(0, CODES - 1)
    return Relief(drop=codes * (h / CODES), hole=hole, h=h)


def refine(z: Float[Tensor, "H W"], factor: int) -> Float[Tensor, "H2 W2"]:
    """Return a repeating map with `factor` samples per texel and side; exact for planes and for their intersections."""
    return _refine_rows(_refine_rows(z, factor).T, factor).T.contiguous()


def _to_vertical(z: Tensor, slope: Tensor, below: Tensor) -> Tensor:
    """Return the depth straight below each point as one slanted view sees it: solves d = Z(uv + slope d)."""
    fine = Relief(drop=refine(z, REFINEMENT), hole=None, h=1.0)
    d = z.flatten()
    for _ in range(12):  # contracts by the relief's slope times tan(theta), damped against overshoot at walls
        d = 0.3 * d + 0.7 * fine.depth(below + slope * d.unsqueeze(-1))
    return d


def _refine_rows(z: Tensor, factor: int) -> Tensor:
    """Refine along the first axis: between two samples continue the lines of both sides where the slope turns."""
    previous, following, second = z.roll(1, 0), z.roll(-1, 0), z.roll(-2, 0)
    before, across, after = z - previous, following - z, second - following
    low, high = torch.minimum(z, following), torch.maximum(z, following)
    rows = []
    for j in range(factor):
        offset = (j + 0.5) / factor - 0.5
        f = offset % 1  # samples left of a texel's centre lie between its predecessor and itself
        line = z + across * f
        left, right = z + before * f, following - after * (1 - f)
        ridge, valley = (before < across) & (across < after), (before > across) & (across > after)
        value = torch.where(ridge, torch.maximum(left, right), torch.where(valley, torch.minimum(left, right), line))
        value = value.clamp(min=low, max=high)
        rows.append(value if offset >= 0 else value.roll(1, 0))
    return torch.stack(rows, 1).reshape(factor * z.shape[0], *z.shape[1:])


def _meeting(upper: Tensor, over: Tensor, lower: Tensor, under: Tensor) -> Tensor:
    """Return where a line from `over` (above the relief) to `under` (not above it) meets it; half way out of a hole."""
    share = torch.where(over.isinf(), 0.5, over / (over - under).clamp(min=1e-20))
    return upper + (lower - upper) * share
