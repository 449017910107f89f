"""Values between scattered directions: the least rough function through those that are known.

With p(w) = (x, y) / (1 + z), the parabolic map of the hemisphere to the unit disc, the function is

    f(w) = c + sum_j a_j |p(w) - p(w_j)|,   sum_j a_j = 0,   f(w_j) = f_j:

kriging whose variogram is linear, the best guess for values that differ by as much as a random walk over the disc. It
is linear in the values, exact at what is known, gives constants back, and needs no triangulation, no count of
neighbours and no exponent. Smoother kernels (thin plates, cubes) win on smooth materials and overshoot on others; this
one is nearer to held-out pictures than nearest, inverse-distance and barycentric interpolation, but for views of brick,
where parallax leaves nothing better than a mean of neighbours and it is level with the best of them. For view weights
`guess` is therefore half of it and half such a mean (rows `compress.held_out`).

Renderers cannot solve for every pixel. `finer` tabulates the guess once on rings twice as dense, so that linear
interpolation (`geometry.hemisphere`) is nearest to it: a few more kilobytes for what has no texels.

Test: tests/geometry/test_kriging.py
"""

from functools import lru_cache
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.geometry import hemisphere
from torchmeso.geometry.hemisphere import DirectionSet

DENSE = 512
"""Directions of a set that is fine enough as it is."""

NEAREST = 4
"""Directions that are averaged by their distance."""


def weights(known: Float[Tensor, "known 3"], asked: Float[Tensor, "asked 3"]) -> Float[Tensor, "asked known"]:
    """Return float64 weights W with f(asked_i) = sum_j W_ij f_j; rows sum to 1, some weights are slightly negative.

    Args:
        known: (n, 3) unit directions of the upper hemisphere, at least one.
        asked: (m, 3) unit directions of the upper hemisphere.
    """
    # Directions listed twice, as on a ring at the pole, share their weight.
    p, twin, count = torch.unique(_parabolic(known.double()), dim=0, return_inverse=True, return_counts=True)
    q = _parabolic(asked.double())
    n = len(p)
    system = torch.ones(n + 1, n + 1, dtype=torch.float64)
    system[:n, :n] = -torch.cdist(p, p, compute_mode="donot_use_mm_for_euclid_dist")
    system[n, n] = 0
    target = torch.ones(n + 1, len(q), dtype=torch.float64)
    target[:n] = -torch.cdist(p, q, compute_mode="donot_use_mm_for_euclid_dist")
    return (torch.linalg.solve(system, target)[:n] / count[:, None])[twin].mT.contiguous()


@lru_cache(maxsize=16)
def finer(directions: DirectionSet) -> tuple[DirectionSet, Float[Tensor, "node direction"]]:
    """Return a set of twice the rings and azimuths that has all of `directions`, the pole too, and the weights to it.

    weights @ table is the table on the finer set, float64: exact where the directions are, and elsewhere such that
    linear interpolation of it is nearest to `guess` (least squares over the hemisphere). A set of more than `DENSE`
    directions is returned as it is.
    """
    if len(directions) > DENSE:
        return directions, torch.eye(len(directions), dtype=torch.float64)
    fine = _doubled(directions)
    between = _doubled(fine)
    known, nodes, asked = (x.directions(torch.float64) for x in (directions, fine, between))
    found = guess(known, nodes)
    free = torch.cdist(nodes, known, compute_mode="donot_use_mm_for_euclid_dist").amin(1) > 1e-9
    taps = hemisphere.interpolate(fine, asked)
    hats = torch.zeros(len(asked), len(nodes), dtype=torch.float64).scatter_add_(1, taps.node, taps.weight)
    share = hemisphere.solid_angles(between)[:, None] * hats[:, free]
    rest = guess(known, asked) - hats[:, ~free] @ found[~free]
    found[free] = torch.linalg.solve(share.mT @ hats[:, free], share.mT @ rest)
    return fine, found


def guess(known: Float[Tensor, "known 3"], asked: Float[Tensor, "asked 3"]) -> Float[Tensor, "asked known"]:
    """Return float64 weights of the mean of two guesses: kriging, and inverse squared distances of the four nearest.

    Their errors are not the same: the first follows what changes slowly, the second averages what does not.
    """
    away = torch.cdist(asked.double(), known.double(), compute_mode="donot_use_mm_for_euclid_dist").clamp(min=1e-9)
    away, near = away.topk(min(NEAREST, len(known)), largest=False)
    share = (away[:, :1] / away).square()
    mean = torch.zeros(len(asked), len(known), dtype=torch.float64)
    mean.scatter_(1, near, share / share.sum(1, keepdim=True))
    return (weights(known, asked) + mean) / 2


def _doubled(directions: DirectionSet) -> DirectionSet:
    rings = list(zip(directions.theta_deg, directions.count, directions.phi0_deg, strict=True))
    if directions.needs_pole:
        rings = [(0.0, 1, 0.0), *rings]
    between = [((a + b) / 2, 2 * max(m, n), phi0) for (a, m, _), (b, n, phi0) in pairwise(rings)]
    doubled = [(theta, 2 * n if theta else 1, phi0) for theta, n, phi0 in rings]
    return hemisphere.from_rings(*zip(*sorted(doubled + between), strict=True))


def _parabolic(w: Tensor) -> Tensor:
    place = w[:, :2] / (1 + w[:, 2:])
    return (place * 1e12).round() / 1e12  # the same for the same direction, whatever its last bits
