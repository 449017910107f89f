"""Leading singular vectors of matrices that are read in blocks of rows and never held: subspace iteration.

halko2011finding, algorithm 4.4: P = orth(B Q), Q = orth(B^T P), in turn; each product is one pass over the rows, and
B is then P (B^T P)^T. Both sides are made orthonormal between passes (float64), so that small singular values are not
squared away in float32 products; those below 1e-7 of the largest need float64 blocks. Exact, but for rounding, where
the rank reaches the short side; the error is within 1e-5 of the least one where singular values fall like 1/k or
faster, within 5e-4 where they fall like its root.

Test: tests/algebra/test_subspace.py
"""

from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float
from torch import Tensor

OVERSAMPLING = 8
"""Directions that are carried along besides twice the rank, and dropped at the end."""

ROUNDS = 3
"""Turns of the iteration; each takes two passes."""


def factor(
    blocks: Callable[[], Iterable[Float[Tensor, "batch _ n"]]], m: int, n: int, batch: int, rank: int
) -> tuple[Float[Tensor, "batch m rank"], Float[Tensor, "batch n rank"]]:
    """Return (US, V) with B ~ US V^T for each of `batch` matrices of m x n, largest component first.

    Args:
        blocks: starts a pass: (batch, rows, n) at a time, all m rows in order, 2 * `ROUNDS` times; float64 blocks are
            multiplied in float64.
        m: rows.
        n: columns.
        batch: matrices that are read side by side.
        rank: columns of the factors, 1 to min(m, n).

    Returns:
        In the dtype of the blocks; V has orthonormal columns. The random start is the same every time, so equal input
        gives equal bits.
    """
    kept = min(2 * rank + OVERSAMPLING, m, n)
    rng = torch.Generator().manual_seed(0)
    P, Z = _turn(blocks, torch.randn(batch, n, kept, generator=rng, dtype=torch.float64))
    for _ in range(ROUNDS - 1):
        P, Z = _turn(blocks, Z)
    V, S, R = torch.linalg.svd(Z, full_matrices=False)
    V, S, R = V[..., :rank], S[..., :rank], R[:, :rank]
    sign = torch.where(V.sum(1, keepdim=True) < 0, -1.0, 1.0).double()
    US = P.double() @ (R.mT * (S[:, None] * sign))
    return US.to(P.dtype), (V * sign).to(P.dtype)


def _turn(blocks: Callable[[], Iterable[Tensor]], Z: Tensor) -> tuple[Tensor, Tensor]:
    """Return P = orth(B orth(Z)), in the dtype of the blocks, and B^T P, float64: two passes."""
    Q = _orthonormal(Z)
    Y = torch.cat([block @ Q.to(block.dtype) for block in blocks()], 1)
    P = _orthonormal(Y).to(Y.dtype)
    Z, start = torch.zeros_like(Q), 0
    for block in blocks():
        stop = start + block.shape[1]
        Z += (block.mT @ P[:, start:stop]).double()
        start = stop
    return P, Z


def _orthonormal(columns: Tensor) -> Tensor:
    return torch.linalg.qr(columns.double())[0]
