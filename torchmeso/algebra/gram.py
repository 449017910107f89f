"""Principal components of a tall matrix that is read in blocks of rows, by the Gram matrix of its short side.

G = sum over blocks of B^T B, each block's product in float32 and the sum in float64. Right for singular
values down to about 1e-3 of the largest; below that use float64 blocks (`accurate=True`), good to 1e-7.

Test: tests/algebra/test_gram.py
"""

from collections.abc import Iterable
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor


class RightBasis(NamedTuple):
    """Right singular vectors of a matrix, largest first.

    Attributes:
        vectors: (n, rank) float64, orthonormal columns; each column's sum is not negative.
        values: (n,) float64, all singular values.
    """

    vectors: Float[Tensor, "n rank"]
    values: Float[Tensor, "n"]


def gram(blocks: Iterable[Tensor], n: int, *, accurate: bool = False) -> Float[Tensor, "n n"]:
    """Return the float64 Gram matrix of all rows of all blocks.

    Args:
        blocks: the matrix, (rows, n) at a time; any number of rows.
        n: columns.
        accurate: multiply in float64 too: four times slower, for small singular values.
    """
    total = torch.zeros(n, n, dtype=torch.float64)
    for block in blocks:
        for part in block.split(65536):  # float32 sums stay short
            rows = part.double() if accurate else part.float()
            total += (rows.mT @ rows).double()
    return (total + total.mT) / 2


def right_basis(gram_matrix: Float[Tensor, "n n"], rank: int) -> RightBasis:
    """Return the `rank` leading right singular vectors from a Gram matrix.

    Signs are fixed (each vector's sum >= 0), so that equal input gives equal bits.
    """
    values, vectors = torch.linalg.eigh(gram_matrix)
    vectors = vectors.flip(1)[:, :rank]
    sign = torch.where(vectors.sum(0) < 0, -1.0, 1.0).to(vectors.dtype)
    return RightBasis(vectors * sign, values.flip(0).clamp(min=0).sqrt())
