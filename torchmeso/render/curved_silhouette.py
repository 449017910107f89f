"""A silhouette test that follows the curve of the surface between the two ends of an interval.

The test of wang2005mdf takes the surface for a plane at each end, so on a cylinder it sees twice the true
penetration: a flat sheet of depth h is carved by h / 2 only. Here the depth of the ray below the surface and
the place above it in the texture are followed from the front to the back, and the ray is marched through
the relief of the mesostructure (D seen from straight above).

With the lengths along the ray x = t / L in [0, 1], the mean curvature kappa = (cos_f + cos_b) / L from the
interpolated normals, the sagitta of the flat facets under the curved surface they stand for, and the half angle
psi between the ends, sin(psi) = (cos_f + cos_b) / 2, as seen from the centre of the osculating circle,

    q(x)     = 2 (bulge_f (1 - x) + bulge_b x) + kappa L^2 x (1 - x)
    depth(x) = q / (1 + sqrt(1 - kappa q))                               below the circle
    g(x)     = (atan(tan(psi) (2 x - 1)) / psi + 1) / 2                  share of the arc above the ray
    uv'(g)   = L psi / (sin(psi) cos(psi)) ((1 - g) rate_f + g rate_b)

What the texture coordinates of the back disagree by is spread over the arc; where they disagree by more
than `SEAM` tiles there is a seam in between and each half keeps its own end. Where the normals turn much faster
along the ray than on either facet, the interval cuts a crease (the rim of a cylinder): each side is then a plane.

Test: tests/render/test_curved_silhouette.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.geometry import frames
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.directions import dot, normalize
from torchmeso.render.rasterize import Layers, barycentric
from torchmeso.render.scene import DistanceFunction, World, interpolate, rays

STEPS = 128
"""Points along an interval at which the ray is compared with the relief."""

SEAM = 0.2
"""Tiles by which both ends may disagree before a seam is assumed between them."""

CREASE = 4.0
"""Times the facets' own curvature from which a turn of the normals counts as a crease."""

CHUNK = 4096
"""Intervals handled at once."""


class End(NamedTuple):
    """One end of each interval; signs are such that both ends of a convex body are alike.

    Attributes:
        uv: (n, 2).
        rate: (n, 2) tiles of texture per world length along the ray.
        scale: (n,) texture scale.
        cosine: (n,) between the ray and the interpolated normal, positive where it goes in (front) or out (back).
        slope: (n,) the same with the facet's own normal.
        curvature: (n,) turn of the interpolated normal per world length along the ray.
        bulge: (n,) height of the curved surface over its facet, world units.
    """

    uv: Float[Tensor, "n 2"]
    rate: Float[Tensor, "n 2"]
    scale: Float[Tensor, "n"]
    cosine: Float[Tensor, "n"]
    slope: Float[Tensor, "n"]
    curvature: Float[Tensor, "n"]
    bulge: Float[Tensor, "n"]

    def select(self, which: Tensor) -> "End":
        """Return the ends `which`."""
        return End(*(x[which] for x in self))


class Meeting(NamedTuple):
    """Where rays meet the mesostructure.

    Attributes:
        hit: (n,) whether they do.
        marched: (n,) false where the ray goes below the slab, so that it hits without a march unless there are holes.
        at: (n,) distance from the front, world units; meaningless where not marched or no hit.
    """

    hit: Bool[Tensor, "n"]
    marched: Bool[Tensor, "n"]
    at: Float[Tensor, "n"]


def end(world: World, camera: Camera, layers: Layers, fragment: Int[Tensor, "n"], *, front: bool) -> End:
    """Return the ends of intervals at the fronts or backs `fragment`."""
    points = interpolate(world, layers, camera, fragment)
    direction = rays(camera, layers.pixel[fragment], layers.t.dtype)[1]
    local = frames.to_local(points.frame, direction)
    turn = -1.0 if front else 1.0

    corner = world.faces[layers.triangles.face[layers.triangle[fragment]]]
    p, normals = world.vertices[corner], world.normals[corner]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    facet = normalize(torch.linalg.cross(e1, e2))
    slope = dot(facet, direction)
    along = direction - slope.unsqueeze(-1) * facet

    # Barycentric coordinates per world length along the ray, and the way to the facet's border on both sides.
    a, b, c = dot(e1, e1), dot(e1, e2), dot(e2, e2)
    r1, r2 = dot(e1, along), dot(e2, along)
    area = (a * c - b * b).clamp(min=1e-30)
    rate_1, rate_2 = (r1 * c - r2 * b) / area, (a * r2 - b * r1) / area
    change = torch.stack([-rate_1 - rate_2, rate_1, rate_2], -1)
    share = barycentric(layers, camera, fragment)
    forward = torch.where(change < 0, share / (-change).clamp(min=1e-20), torch.inf).amin(-1)
    backward = torch.where(change > 0, share / change.clamp(min=1e-20), torch.inf).amin(-1)
    curvature = dot((change.unsqueeze(-1) * normals).sum(1), direction)
    bulge = 0.5 * curvature.clamp(min=0) * forward * backward
    bulge = torch.where(bulge.isfinite(), bulge, 0.0)
    return End(
        points.uv, local[:, :2] / points.scale.unsqueeze(-1), points.scale, turn * local[:, 2], turn * slope,
        curvature, bulge,
    )  # fmt: skip


def meet(front: End, back: End, length: Float[Tensor, "n"], mdf: DistanceFunction) -> Meeting:
    """Return whether and where the rays of intervals of one material meet its mesostructure.

    Args:
        front: where the rays enter.
        back: where they leave.
        length: (n,) world length of the intervals.
        mdf: the mesostructure; without a straight answer below a point (a hole) nothing is met there.
    """
    # Most intervals go below the slab at their middle already: one look settles them.
    middle = _steps()[STEPS // 2 : STEPS // 2 + 1]
    kappa, crease = _bend(front, back, length)
    at_middle = _depth(front, back, length, kappa, middle)[:, 0]
    open_ = (crease | ~(at_middle > (front.scale + back.scale) / 2 * mdf.h)).nonzero()[:, 0]
    hit, marched, at = torch.ones_like(crease), torch.zeros_like(crease), torch.zeros_like(length)
    for part in open_.split(CHUNK):
        hit[part], marched[part], at[part] = _meet(front.select(part), back.select(part), length[part], mdf)
    return Meeting(hit, marched, at)


def _steps() -> Tensor:
    return (torch.arange(STEPS) + 0.5) / STEPS


def _bend(front: End, back: End, length: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean curvature along the ray, and whether the interval cuts a crease."""
    kappa = ((front.cosine + back.cosine) / length.clamp(min=1e-20)).clamp(min=0)
    limit = CREASE * torch.maximum(front.curvature, back.curvature) + 1e-3 / length.clamp(min=1e-20)
    return kappa, kappa > limit


def _meet(front: End, back: End, length: Tensor, mdf: DistanceFunction) -> Meeting:
    kappa, crease = _bend(front, back, length)
    scale = (front.scale + back.scale) / 2
    x = _steps()
    depth = _depth(front, back, length, kappa, x)
    marched = ~(crease & (length * torch.maximum(front.slope, back.slope) > scale * mdf.h))

    below = torch.zeros(len(length), STEPS, dtype=torch.bool)
    smooth = (marched & ~crease).nonzero()[:, 0]
    uv = _path(front.select(smooth), back.select(smooth), length[smooth], x)
    below[smooth] = depth[smooth] / scale[smooth, None] >= mdf.depth(uv)
    cut = (marched & crease).nonzero()[:, 0]
    below[cut] = _below_planes(front.select(cut), back.select(cut), length[cut], x, mdf)

    step = torch.argmax(below.to(torch.uint8), dim=1)
    hit = ~marched | below.any(1)
    return Meeting(hit, marched, length * x[step])


def _depth(front: End, back: End, length: Tensor, kappa: Tensor, x: Tensor) -> Tensor:
    """Return the depth of the ray below the curved surface at the steps, (n, steps)."""
    q = 2 * (front.bulge[:, None] * (1 - x) + back.bulge[:, None] * x)
    q = q + (kappa * length.square())[:, None] * (x * (1 - x))
    return q / (1 + (1 - kappa[:, None] * q).clamp(min=0).sqrt())


def _path(front: End, back: End, length: Tensor, x: Tensor) -> Tensor:
    """Return the texture coordinates above the ray at the steps, (n, steps, 2)."""
    sine = ((front.cosine + back.cosine) / 2).clamp(min=1e-3, max=0.999)
    half = torch.asin(sine)  # angle between the ends and the middle, seen from the circle's centre
    cosine = (1 - sine.square()).sqrt()
    arc = (torch.atan((sine / cosine)[:, None] * (2 * x - 1)) / half[:, None] + 1) / 2
    reach = (length * half / (sine * cosine))[:, None]
    first, last = reach * front.rate, reach * back.rate
    mean = (first + last) / 2
    gap = back.uv - front.uv - mean
    gap = gap - gap.round()
    seam = (gap.norm(dim=-1) > SEAM)[:, None, None]
    g = arc[:, :, None]
    way = first[:, None] * g + (last - first)[:, None] * (g * g / 2)
    joined = front.uv[:, None] + way + gap[:, None] * g
    apart = torch.where(g > 0.5, (back.uv - mean)[:, None] + way, front.uv[:, None] + way)
    return torch.where(seam, apart, joined)


def _below_planes(front: End, back: End, length: Tensor, x: Tensor, mdf: DistanceFunction) -> Tensor:
    """Return whether the ray is below the relief of either side of a crease at the steps, (n, steps)."""
    t = length[:, None] * x
    rest = length[:, None] - t
    uv_f = front.uv[:, None] + front.rate[:, None] * t.unsqueeze(-1)
    uv_b = back.uv[:, None] - back.rate[:, None] * rest.unsqueeze(-1)
    # The layers of both sides cross below the edge, and a ray ends on whichever it meets.
    under_front = t * front.slope[:, None] >= front.scale[:, None] * mdf.depth(uv_f)
    under_back = rest * back.slope[:, None] >= back.scale[:, None] * mdf.depth(uv_b)
    return under_front | under_back
