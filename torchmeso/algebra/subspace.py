"""Leading singular vectors of matrices that are read in blocks of rows and never held: subspace iteration.

P = orth(B Q), Q = orth(B^T P), in turn; each product is one pass over the rows. B is then P (B^T P)^T. Both sides are
made orthonormal between passes (float64), so that small singular values are not squared away in float32 products.
Exact, but for rounding, where the rank reaches the short side; else within 1e-5 of the least squared error.

Test: tests/algebra/test_subspace.py
"""

from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float
from torch import Tensor

OVERSAMPLING = 8
"""Further directions that are carried along and dropped at the end."""

ROUNDS = 3
"""Turns of the iteration; each takes two passes."""


def factor(
    blocks: Callable[[], Iterable[Float[Tensor, "batch _ n"]]], m: int, n: int, batch: int, rank: int
) -> tuple[Float[Tensor, "batch m rank"], Float[Tensor, "batch n rank"]]:
    """Return (US, V) with B ~ US V^T for each of `batch` matrices of m x n, largest component first.

    Args:
        blocks: starts a pass: (batch, rows, n) float32 at a time, all m rows in order, 2 * `ROUNDS` times.
        m: rows.
        n: columns.
        batch: matrices that are read side by side.
        rank: columns of the factors, 1 to min(m, n).

    Returns:
        float32; V has orthonormal columns. The random start is the same every time, so equal input gives equal bits.
    """
    kept = min(rank + OVERSAMPLING, m, n)
    rng = torch.Generator().manual_seed(0)
    Q = _orthonormal(torch.randn(batch, n, kept, generator=rng, dtype=torch.float64))
    for _ in range(ROUNDS):
        P = _orthonormal(torch.cat([block @ Q for block in blocks()], 1))
        Z, start = torch.zeros(batch, n, kept, dtype=torch.float64), 0
        for block in blocks():
            stop = start + block.shape[1]
            Z += (block.mT @ P[:, start:stop]).double()
            start = stop
        Q = _orthonormal(Z)
    V, S, R = torch.linalg.svd(Z, full_matrices=False)
    V, S, R = V[..., :rank], S[..., :rank], R[:, :rank]
    sign = torch.where(V.sum(1, keepdim=True) < 0, -1.0, 1.0).double()
    return (P.double() @ (R.mT * (S[:, None] * sign))).float(), (V * sign).float()


def _orthonormal(columns: Tensor) -> Tensor:
    return torch.linalg.qr(columns.double())[0].float()
