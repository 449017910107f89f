"""Constrained least squares: of all vectors that fit samples best, the one whose energy stays under a bound.

leung2007tileable, appendix: minimise |beta - Y c|^2 + lambda (c.c - E) with the smallest lambda >= 0 that leaves
c.c <= E. With the thin SVD Y = U S V^T and g = U^T beta the solution is

    c = V w / (s^2 + lambda),   w = s g,   and   q(lambda) = c.c = sum of w^2 / (s^2 + lambda)^2

falls with lambda: q = E is the secular equation. Y^T Y is never formed; its condition is that of Y squared, 1.3e10
for 36 coefficients and the 81 directions of UBO2003. 1 / sqrt(q) is concave in lambda, so Newton's method on
it climbs from any lower bound to the root and never passes it.

Test: tests/algebra/test_secular.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import ConfigError

WORST_CONDITION = 1e7
"""Of Y: what float32 samples (6e-8) can still tell apart."""

STEPS = 60
"""Of Newton's method; 12 is the most that was seen."""


class Factors(NamedTuple):
    """Y and its thin singular value decomposition, float64.

    Attributes:
        matrix: (sample, n) Y.
        left: (sample, n) U.
        values: (n,) s, largest first; 0 where the samples cannot tell (`regularise`).
        right: (n, n) V, columns.
    """

    matrix: Float[Tensor, "sample n"]
    left: Float[Tensor, "sample n"]
    values: Float[Tensor, "n"]
    right: Float[Tensor, "n n"]


class Solution(NamedTuple):
    """Coefficients and the multiplier that bounds their energy.

    Attributes:
        c: (..., n).
        multiplier: (...) lambda >= 0; 0 where plain least squares keeps the bound.
    """

    c: Float[Tensor, "*batch n"]
    multiplier: Float[Tensor, "*batch"]


def factorise(Y: Float[Tensor, "sample n"], what: str, *, regularise: bool = False) -> Factors:
    """Return the factors of Y.

    Args:
        Y: basis functions at the samples.
        what: names the samples in a refusal: "light: ubo81".
        regularise: leave out what the samples cannot tell apart (minimum norm) instead of refusing.

    Raises:
        ConfigError: the samples cannot tell the coefficients apart: fewer than those, or a condition beyond 1e7.
    """
    samples, n = Y.shape
    U, s, Vh = torch.linalg.svd(Y.double(), full_matrices=False)
    known = int((s > s[0] / WORST_CONDITION).sum())
    if known < n and not regularise:
        raise ConfigError(
            f"{what}: expected directions that tell {n} coefficients apart, got {samples} that tell {known}; "
            f"use fewer coefficients, or regularise"
        )
    values = torch.zeros(n, dtype=torch.float64)
    values[:known] = s[:known]
    left = torch.zeros(samples, n, dtype=torch.float64)
    left[:, :known] = U[:, :known]
    right = torch.zeros(n, n, dtype=torch.float64)
    right[:, :known] = Vh.mT[:, :known]
    return Factors(Y.double(), left, values, right)


def solve(
    factors: Factors,
    samples: Float[Tensor, "*batch sample"],
    energy: Float[Tensor, "*#batch"] | None = None,
) -> Solution:
    """Return least-squares coefficients of `samples` with c.c <= energy; any energy where it is None.

    Computed in the dtype of the samples: float64 is the reference, float32 is within 1e-4 of it at 36 coefficients.

    Args:
        factors: of the basis at the directions of the samples.
        samples: (..., sample) values, finite.
        energy: (...) bound E >= 0; 0 gives c = 0 and an infinite multiplier.
    """
    dtype = samples.dtype
    s = factors.values.to(dtype)
    w = (samples @ factors.left.to(dtype)) * s
    s2 = torch.where(s > 0, s * s, 1)
    if energy is None:
        multiplier = torch.zeros_like(w[..., 0])
    else:
        multiplier = _multiplier(w, s2, energy.to(dtype).expand(w.shape[:-1]))
    c = (w / (s2 + multiplier.unsqueeze(-1))) @ factors.right.to(dtype).mT
    return Solution(c, multiplier)


def _multiplier(
    w: Float[Tensor, "*batch n"], s2: Float[Tensor, "n"], energy: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch"]:
    """Return the least lambda >= 0 with q(lambda) <= energy, by Newton's method on 1 / sqrt(q) from below."""
    tolerance = 8 * torch.finfo(w.dtype).eps
    bound = energy.clamp(min=torch.finfo(w.dtype).tiny)
    # Each term alone is less than the whole: |w| / (s^2 + lambda) <= sqrt(E).
    multiplier = (w.abs() / bound.sqrt().unsqueeze(-1) - s2).amax(-1).clamp(min=0)
    for _ in range(STEPS):
        share = 1 / (s2 + multiplier.unsqueeze(-1))
        term = (w * share).square()
        q = term.sum(-1)
        active = q > bound * (1 + tolerance)
        if not bool(active.any()):
            break
        slope = (term * share).sum(-1)
        step = q / slope * ((q / bound).sqrt() - 1)
        multiplier = torch.where(active, multiplier + step, multiplier)
    return torch.where((energy > 0) | (w == 0).all(-1), multiplier, torch.inf)
