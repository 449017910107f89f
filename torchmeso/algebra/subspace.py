"""Leading singular vectors of matrices that are read in blocks of rows and never held: subspace iteration.

halko2011finding, algorithm 4.4: P = orth(B Q), Q = orth(B^T P), in turn; each product is one pass over the rows, and
B is then P (B^T P)^T. Both sides are made orthonormal between passes (float64), so that small singular values are not
squared away in float32 products; those below 1e-7 of the largest need float64 blocks. Exact, but for rounding, where
the rank reaches the short side; the error is within 1e-5 of the least one where singular values fall like 1/k or
faster, within 5e-4 where they fall like its root.

Test: tests/algebra/test_subspace.py
"""

from collections.abc import Callable, Iterable
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

OVERSAMPLING = 8
"""Directions that are carried along besides twice the rank, and dropped at the end."""

ROUNDS = 3
"""Turns of the iteration; each takes two passes."""


Remember = Callable[[str, tuple[int, ...], Callable[[], Tensor]], Tensor]
"""Called with the name and shape of what a pass gives, and the pass; returns what it gave, now or in an earlier run."""


def anew(name: str, shape: tuple[int, ...], made: Callable[[], Tensor]) -> Tensor:
    """Remember nothing."""
    return made()


def factor(
    blocks: Callable[[], Iterable[Float[Tensor, "batch _ n"]]],
    m: int,
    n: int,
    batch: int,
    rank: int,
    *,
    remember: Remember = anew,
) -> tuple[Float[Tensor, "batch m rank"], Float[Tensor, "batch n rank"]]:
    """Return (US, V) with B ~ US V^T for each of `batch` matrices of m x n, largest component first.

    Args:
        blocks: starts a pass: (batch, rows, n) at a time, all m rows in order, 2 * `ROUNDS` times; float64 blocks are
            multiplied in float64.
        m: rows.
        n: columns.
        batch: matrices that are read side by side.
        rank: columns of the factors, 1 to min(m, n).
        remember: keeps what each pass gives, for a run that goes on from there.

    Returns:
        In the dtype of the blocks; V has orthonormal columns. The random start is the same every time, so equal input
        gives equal bits.
    """
    kept = min(2 * rank + OVERSAMPLING, m, n)
    rng = torch.Generator().manual_seed(0)
    Z = torch.randn(batch, n, kept, generator=rng, dtype=torch.float64)
    P = Z.new_zeros(batch, m, kept)
    for turn in range(ROUNDS):
        P = remember(f"P{turn}", (batch, m, kept), partial(_ahead, blocks, Z))
        Z = remember(f"Z{turn}", (batch, n, kept), partial(_back, blocks, P, n))
    V, S, R = torch.linalg.svd(Z, full_matrices=False)
    V, S, R = V[..., :rank], S[..., :rank], R[:, :rank]
    sign = torch.where(V.sum(1, keepdim=True) < 0, -1.0, 1.0).double()
    US = P.double() @ (R.mT * (S[:, None] * sign))
    return US.to(P.dtype), (V * sign).to(P.dtype)


def _ahead(blocks: Callable[[], Iterable[Tensor]], Z: Tensor) -> Tensor:
    """Return P = orth(B orth(Z)), in the dtype of the blocks: one pass."""
    Q = _orthonormal(Z)
    Y = torch.cat([block @ Q.to(block.dtype) for block in blocks()], 1)
    return _orthonormal(Y).to(Y.dtype)


def _back(blocks: Callable[[], Iterable[Tensor]], P: Tensor, n: int) -> Tensor:
    """Return B^T P, float64: one pass."""
    Z, start = torch.zeros(len(P), n, P.shape[2], dtype=torch.float64), 0
    for block in blocks():
        stop = start + block.shape[1]
        Z += (block.mT @ P[:, start:stop]).double()
        start = stop
    return Z


def _orthonormal(columns: Tensor) -> Tensor:
    return torch.linalg.qr(columns.double())[0]
