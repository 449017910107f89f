"""Nonlinear least squares: the Levenberg-Marquardt method with a dense Jacobian, and the covariance of the answer.

    (J^T J + lambda diag(J^T J)) step = -J^T r,      covariance = s^2 (J^T J)^-1,   s^2 = |r|^2 / (m - n)

marquardt1963algorithm. Jacobians come from forward differentiation, so residuals are any torch function.

Test: tests/algebra/test_levenberg.py
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import ShapeError


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Minimum:
    """Where the sum of squares is least.

    Attributes:
        x: (n) parameters.
        residuals: (m) there.
        covariance: (n, n) of the parameters, from the spread of the residuals; inf where they do not fix them.
    """

    x: Float[Tensor, "n"]
    residuals: Float[Tensor, "m"]
    covariance: Float[Tensor, "n n"]


def minimise(
    residuals: Callable[[Tensor], Tensor], x: Float[Tensor, "n"], *, max_steps: int = 100, tolerance: float = 1e-12
) -> Minimum:
    """Return the minimum of the sum of squared `residuals` that lies downhill from `x`.

    Args:
        residuals: from (n) to (m), m >= n, differentiable.
        x: (n) float64 start.
        max_steps: steps at most.
        tolerance: ends where a step moves no parameter by more than this, relative to its own size (at least 1).

    Raises:
        ShapeError: fewer residuals than parameters, or residuals that are not finite at the start.
    """
    r = residuals(x)
    if len(r) < len(x):
        raise ShapeError(f"residuals: expected at least as many as the {len(x)} parameters, got {len(r)}")
    if not bool(r.isfinite().all()):
        raise ShapeError("residuals: expected finite values at the start, got others; start nearer to the answer")
    damping, J = 1e-3, _jacobian(residuals, x)
    for _ in range(max_steps):
        normal, slope = J.T @ J, J.T @ r
        scale = normal.diagonal().clamp(min=1e-30)
        step = torch.linalg.solve(normal + damping * torch.diag(scale), -slope)
        tried = residuals(x + step)
        if bool(tried.isfinite().all()) and tried.square().sum() <= r.square().sum():
            x, r = x + step, tried
            J, damping = _jacobian(residuals, x), max(0.1 * damping, 1e-15)
        else:
            damping *= 10
        if float((step.abs() / x.abs().clamp(min=1)).max()) < tolerance or damping > 1e12:
            break
    return Minimum(x=x, residuals=r, covariance=_covariance(J, r))


def _jacobian(residuals: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    with warnings.catch_warnings():
        # torch's own forward differentiation calls a function that torch has deprecated.
        warnings.filterwarnings("ignore", message=".*torch.jit.script", category=DeprecationWarning)
        return torch.func.jacfwd(residuals)(x)


def _covariance(J: Tensor, r: Tensor) -> Tensor:
    # Columns of one length: parameters have different units.
    length = J.norm(dim=0).clamp(min=1e-30)
    _, s, vh = torch.linalg.svd(J / length, full_matrices=False)
    if float(s[-1]) < 1e-12 * float(s[0]):
        return torch.full((len(s), len(s)), torch.inf, dtype=J.dtype)
    inverse = (vh.T / s.square()) @ vh
    variance = r.square().sum() / max(len(r) - len(s), 1)
    return variance * inverse / torch.outer(length, length)
