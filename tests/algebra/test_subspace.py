import pytest
import torch

from tests.tolerances import SUBSPACE
from torchmeso.algebra import subspace


def matrices(m, n, decay, rng):
    """(2, m, n) float32 whose singular values fall like k ** -decay."""
    k = min(m, n)
    U = torch.linalg.qr(torch.randn(2, m, k, dtype=torch.float64, generator=rng))[0]
    V = torch.linalg.qr(torch.randn(2, n, k, dtype=torch.float64, generator=rng))[0]
    return (U * torch.arange(1, k + 1) ** -decay @ V.mT).float()


@pytest.mark.parametrize("decay", [1.0, 2.0, 3.0])
@pytest.mark.parametrize(("m", "n"), [(300, 200), (90, 260)])
def test_the_error_is_nearly_the_least(m, n, decay, rng):
    B = matrices(m, n, decay, rng)
    US, V = subspace.factor(lambda: B.split(37, 1), m, n, 2, 12)
    assert (US.shape, V.shape) == ((2, m, 12), (2, n, 12))
    error = (B.double() - US.double() @ V.double().mT).square().sum((1, 2)).sqrt()
    least = torch.linalg.svdvals(B.double())[:, 12:].square().sum(1).sqrt()
    assert bool((error <= least * (1 + SUBSPACE)).all())
    torch.testing.assert_close(V.mT @ V, torch.eye(12).expand(2, 12, 12), rtol=0, atol=2e-6)
    norms = US.norm(dim=1)
    assert bool((norms.diff(dim=1) <= 0).all())
    torch.testing.assert_close(norms, torch.linalg.svdvals(B)[:, :12], rtol=1e-3, atol=0)


@pytest.mark.parametrize(("m", "n"), [(40, 24), (24, 40), (1, 5), (5, 1)])
def test_full_rank_is_exact(m, n, rng):
    B = torch.randn(2, m, n, generator=rng)
    US, V = subspace.factor(lambda: B.split(7, 1), m, n, 2, min(m, n))
    torch.testing.assert_close(US @ V.mT, B, rtol=0, atol=1e-5)


def test_how_rows_are_cut_hardly_matters_and_equal_input_gives_equal_bits(rng):
    B = matrices(100, 60, 2.0, rng)
    first, again, other = (subspace.factor(lambda s=s: B.split(s, 1), 100, 60, 2, 5) for s in (100, 100, 9))
    assert all(torch.equal(x, y) for x, y in zip(first, again, strict=True))
    torch.testing.assert_close(first[0] @ first[1].mT, other[0] @ other[1].mT, rtol=0, atol=1e-6)


def test_matrices_of_lower_rank_and_none():
    B = torch.zeros(2, 30, 20)
    B[0] = torch.outer(torch.arange(30.0), torch.arange(20.0))
    US, V = subspace.factor(lambda: [B], 30, 20, 2, 4)
    torch.testing.assert_close(US @ V.mT, B, rtol=1e-5, atol=1e-4)
