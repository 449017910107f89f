"""Displacement images of many laser positions, merged into one per view, and those into an MDF.

wang2005mdf, section 3.2: D_v = sum of w_i D_{v,l_i} / sum of w_i over the positions from which the laser reached the
point. The weight is the volume of the tetrahedron of the laser's source s, the camera c and two points p, q of the
laser line through the centre of the turntable,

    w = |(p - s) . ((q - s) x (c - s))| / 6,

greatest where sheet and line of sight cross at right angles. Values far from the weighted median of their pixel are
interreflections that no threshold caught: they are left out.

Test: tests/capture/test_merge.py          Reference: tests/reference/merge.py
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from torchmeso.data.mdf import MIN_COS, Mdf
from torchmeso.errors import ConfigError, ShapeError, check_range, check_shape
from torchmeso.geometry.hemisphere import DirectionSet


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Merged:
    """One view's displacements.

    Attributes:
        distance: (H, W) D, in the unit of what was merged; 0 where not valid.
        valid: (H, W) true where at least one position saw the point.
        count: (H, W) positions whose values went in.
        rejected: (H, W) positions whose values were left out as too far from the others.
    """

    distance: Float[Tensor, "H W"]
    valid: Bool[Tensor, "H W"]
    count: Shaped[Tensor, "H W"]
    rejected: Shaped[Tensor, "H W"]


def tetrahedron_weight(
    source: Float[Tensor, "*batch 3"],
    camera: Float[Tensor, "*batch 3"],
    p: Float[Tensor, "*batch 3"],
    q: Float[Tensor, "*batch 3"],
) -> Float[Tensor, "*batch"]:
    """Return the volume of the tetrahedron of laser source, camera, and two points of the line through the centre."""
    return ((p - source) * torch.linalg.cross(q - source, camera - source)).sum(-1).abs() / 6


def merge(
    distance: Float[Tensor, "laser H W"],
    valid: Bool[Tensor, "laser H W"],
    weight: Float[Tensor, "laser"],
    *,
    tolerance: float,
) -> Merged:
    """Return the weighted mean of the positions that saw each point, outliers left out.

    Args:
        distance: (laser, H, W) D of each position; anything where not valid.
        valid: (laser, H, W) where the position saw the point.
        weight: (laser) >= 0; positions of weight 0 see nothing.
        tolerance: a value farther than this from the weighted median of its pixel is left out, unit of `distance`.

    Raises:
        ShapeError: sizes do not match, or no positions.
        ConfigError: a negative weight or a tolerance that is not positive.
    """
    check_shape("distance", distance, (-1, -1, -1))
    check_shape("valid", valid, tuple(distance.shape))
    check_shape("weight", weight, (len(distance),))
    if not len(distance):
        raise ShapeError("distance: expected at least one laser position, got none")
    if not bool((weight.isfinite() & (weight >= 0)).all()):
        raise ConfigError(f"weight: expected finite values >= 0, got {weight.tolist()}")
    check_range("merge.tolerance", tolerance, 1e-12, 1e12)
    w = torch.where(valid, weight.to(distance)[:, None, None], 0)
    # Weights are compared with each other only: 1 is the largest.
    w = w / weight.max().clamp(min=1e-30).to(distance)
    d = torch.where(w > 0, distance, 0)
    middle = _weighted_median(d, w)
    near = (w > 0) & ((d - middle).abs() <= tolerance)
    w_near = torch.where(near, w, 0).double()
    total = w_near.sum(0)
    seen = total > 0
    mean = (w_near * d.double()).sum(0) / total.clamp(min=1e-30)
    return Merged(
        distance=torch.where(seen, mean, 0).to(distance),
        valid=seen,
        count=near.sum(0),
        rejected=((w > 0) & ~near).sum(0),
    )


def _weighted_median(d: Tensor, w: Tensor) -> Tensor:
    """Return, per pixel, the value at which half of the weight is reached; 0 without weight."""
    ranked, order = torch.where(w > 0, d, torch.inf).sort(0)
    sums = w.gather(0, order).cumsum(0)
    at = (sums >= 0.5 * sums[-1:]).to(torch.uint8).argmax(0, keepdim=True)
    middle = ranked.gather(0, at).squeeze(0)
    return torch.where(middle.isfinite(), middle, 0)


def to_mdf(
    distance: Float[Tensor, "view H W"], valid: Bool[Tensor, "view H W"], directions: DirectionSet, h: float
) -> Mdf:
    """Return the MDF of merged displacements; points that no position saw are marked as no hit.

    Args:
        distance: (view, H, W) D along -wo in tile units, row 0 on top (v near 1).
        valid: (view, H, W) where it was measured.
        directions: the view directions.
        h: slab depth in tile units; drops beyond 0 and h by noise are clamped.

    Raises:
        ShapeError: sizes do not match.
    """
    check_shape("distance", distance, (len(directions), -1, -1))
    check_shape("valid", valid, tuple(distance.shape))
    check_range("mdf.h", h, 1e-6, 1e3)
    cosine = directions.directions(torch.float64)[:, 2].clamp(min=MIN_COS)
    drop = (distance.double() * cosine[:, None, None] / h).clamp(0, 1)
    codes = torch.where(valid, (drop * 255).round(), 0).to(torch.uint8)
    return Mdf(delta=codes, no_hit=None if bool(valid.all()) else ~valid, directions=directions, h=h)


def fill(
    distance: Float[Tensor, "H W"], valid: Bool[Tensor, "H W"]
) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """Return `distance` with its holes filled from around them, and which pixels were filled.

    Each round gives the pixels beside known ones the mean of their known neighbours; the texture repeats, so the
    border is no border. Only on request: what is filled was not measured.

    Raises:
        ShapeError: no pixel is valid.
    """
    check_shape("valid", valid, tuple(distance.shape))
    if not bool(valid.any()):
        raise ShapeError("holes: expected at least one measured point, got none")
    value, known = torch.where(valid, distance, 0), valid
    while not bool(known.all()):
        around = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x]
        count = torch.stack([known.roll(s, (0, 1)) for s in around]).sum(0)
        total = torch.stack([torch.where(known, value, 0).roll(s, (0, 1)) for s in around]).sum(0)
        new = ~known & (count > 0)
        value = torch.where(new, total / count.clamp(min=1), value)
        known = known | new
    return value, ~valid
