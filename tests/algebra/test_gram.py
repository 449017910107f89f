import torch

from tests.tolerances import FLOAT32
from torchmeso.algebra.gram import gram, right_basis


def matrix(rng, spectrum, rows=4000):
    n = len(spectrum)
    u = torch.linalg.qr(torch.randn(rows, n, dtype=torch.float64, generator=rng)).Q
    v = torch.linalg.qr(torch.randn(n, n, dtype=torch.float64, generator=rng)).Q
    return (u * spectrum) @ v.T


def test_equals_the_svd(rng):
    A = matrix(rng, torch.logspace(0, -2, 12, dtype=torch.float64))
    basis = right_basis(gram(A.split(700), 12, accurate=True), 5)
    _, s, vh = torch.linalg.svd(A, full_matrices=False)
    torch.testing.assert_close(basis.values, s, **FLOAT32)
    torch.testing.assert_close((basis.vectors.T @ vh[:5].T).abs(), torch.eye(5, dtype=torch.float64), rtol=0, atol=1e-9)


def test_blocks_do_not_matter(rng):
    A = matrix(rng, torch.linspace(1, 2, 6, dtype=torch.float64))
    whole, pieces = gram([A], 6, accurate=True), gram(A.split(13), 6, accurate=True)
    torch.testing.assert_close(whole, pieces, rtol=1e-12, atol=1e-12)


def test_float32_blocks_resolve_a_thousandth(rng):
    A = matrix(rng, torch.tensor([1.0, 1e-1, 1e-2, 1e-3], dtype=torch.float64), rows=20_000)
    values = right_basis(gram(A.float().split(4096), 4), 4).values
    torch.testing.assert_close(values, torch.linalg.svdvals(A), rtol=0.1, atol=0)  # measured 2.6e-2 at 1e-3


def test_signs_are_fixed(rng):
    A = matrix(rng, torch.linspace(1, 2, 6, dtype=torch.float64))
    assert (right_basis(gram([A], 6), 6).vectors.sum(0) >= 0).all()
    assert (right_basis(gram([-A], 6), 6).vectors.sum(0) >= 0).all()
