import math

import pytest
import torch

from torchmeso.algebra import spherical_harmonics as sh
from torchmeso.errors import BackendError, ConfigError, ShapeError


def directions(n, rng, dtype=torch.float64):
    return torch.nn.functional.normalize(torch.randn(n, 3, dtype=dtype, generator=rng), dim=-1)


def rotations(n, rng):
    Q = torch.linalg.qr(torch.randn(n, 3, 3, dtype=torch.float64, generator=rng)).Q
    return Q * torch.linalg.det(Q)[:, None, None]


def by_definition(w, l, m):
    """Evaluate one function from the associated Legendre polynomial, with 50 digits."""
    mpmath = pytest.importorskip("mpmath")
    with mpmath.workdps(50):
        x, y, z = (mpmath.mpf(float(a)) for a in w)
        r = mpmath.sqrt(x * x + y * y + z * z)
        k = abs(m)
        # Derivatives of the Legendre polynomial, without the powers of sin(theta), from its coefficients.
        coefficients = [
            mpmath.mpf((-1) ** j * math.comb(l, j) * math.comb(2 * l - 2 * j, l)) / 2**l for j in range(l // 2 + 1)
        ]
        derivative = mpmath.mpf(0)
        for j, a in enumerate(coefficients):
            power = l - 2 * j
            if power >= k:
                derivative += a * math.perm(power, k) * (z / r) ** (power - k)
        norm = mpmath.sqrt((2 * l + 1) / (4 * mpmath.pi) * math.factorial(l - k) / math.factorial(l + k))
        turn = mpmath.mpc(x / r, y / r) ** k
        part = turn.real if m >= 0 else turn.imag
        return float(norm * derivative * part * (mpmath.sqrt(2) if m else 1))


@pytest.mark.parametrize(("degree", "dtype", "limit"), [(5, torch.float32, 3e-7), (20, torch.float64, 1e-13)])
def test_equals_the_definition(degree, dtype, limit, rng):
    w = torch.cat([directions(6, rng), torch.tensor([[0.0, 0, 1], [0, 0, -1], [1, 0, 0], [1e-8, 0, 1]]).double()])
    # What a float32 direction is short of unit length is not the basis' error: the nearest of many are taken.
    near = directions(20_000, rng, dtype).double()
    near = near[(near.norm(dim=-1) - 1).abs().argsort()[:6]]
    w = (w if dtype == torch.float64 else torch.cat([w[6:], near])).to(dtype)
    y = sh.basis(w, degree)
    orders = sorted({0, 1, degree // 2, degree})
    worst = max(
        abs(float(y[i, l * l + l + m]) - by_definition(w[i].double(), l, m))
        for i in range(len(w))
        for l in sorted({degree, degree // 2, 1, 0})
        for m in [*orders, *(-k for k in orders)]
        if abs(m) <= l
    )
    assert worst <= limit


def test_is_orthonormal():
    w, weight = sh._quadrature(20, -1.0)
    y = sh.basis(w, 20)
    torch.testing.assert_close(y.T @ (weight[:, None] * y), torch.eye(441).double(), rtol=0, atol=1e-13)


def test_blocks_and_gradients_change_nothing(rng):
    w = directions(sh.BLOCK + 3, rng)
    whole = sh.basis(w, 3)
    assert torch.equal(whole[-3:], sh.basis(w[-3:], 3))
    assert torch.equal(sh.basis(w[:10].requires_grad_(), 3).detach(), whole[:10])
    assert sh.basis(w[:0], 3).shape == (0, 16)
    assert sh.basis(w[:6].reshape(2, 3, 3), 3).shape == (2, 3, 16)
    torch.autograd.gradcheck(lambda x: sh.basis(x, 3), (w[:2].clone().requires_grad_(),))


def test_the_hemisphere_matrix_is_what_sampling_gives():
    """leung2007tileable, eq. (2); against a fine midpoint rule."""
    n = 400
    z = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    phi = (torch.arange(2 * n, dtype=torch.float64) + 0.5) * math.pi / n
    r = (1 - z * z).sqrt()[:, None]
    w = torch.stack([r * phi.cos(), r * phi.sin(), z[:, None].expand(-1, 2 * n)], -1).reshape(-1, 3)
    y = sh.basis(w, 4)
    A = sh.hemisphere_matrix(4)
    torch.testing.assert_close(A, y.T @ y * (2 * math.pi / len(w)), rtol=0, atol=1e-4)
    assert torch.linalg.eigvalsh(A)[[0, -1]].tolist() == pytest.approx([6.59e-6, 1], rel=1e-3)


def test_projection_finds_the_coefficients(rng):
    w, weight = sh._quadrature(6, -1.0)
    c = torch.randn(3, 36, dtype=torch.float64, generator=rng)
    torch.testing.assert_close(sh.project(c @ sh.basis(w, 5).T, w, weight, 5), c, rtol=0, atol=1e-12)


@pytest.mark.parametrize("degree", [1, 5, 20])
def test_rotation_turns_the_function(degree, rng):
    w, R = directions(50, rng), rotations(8, rng)
    R[0], R[1] = torch.eye(3), torch.diag(torch.tensor([1.0, -1, -1]))
    c = torch.randn(8, sh.size(degree), dtype=torch.float64, generator=rng)
    before = torch.stack([sh.basis(w @ R[k], degree) @ c[k] for k in range(8)])  # f(R^T w)
    after = torch.stack([sh.basis(w, degree) @ x for x in sh.rotate(c, R)])
    torch.testing.assert_close(after, before, rtol=0, atol=2e-12 if degree == 20 else 1e-13 * degree**2)


def test_rotations_are_orthogonal_and_compose(rng):
    a, b = rotations(2, rng)
    one = torch.eye(36, dtype=torch.float64)
    M = sh.rotate(one, a)
    torch.testing.assert_close(M @ M.T, one, rtol=0, atol=1e-13)
    torch.testing.assert_close(sh.rotate(sh.rotate(one, b), a), sh.rotate(one, a @ b), rtol=0, atol=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, math.pi - 1e-7, math.pi])
def test_rotations_near_the_pole_lose_nothing(angle, rng):
    tilt = torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]], dtype=torch.float64
    )
    w = directions(20, rng)
    c = torch.randn(36, dtype=torch.float64, generator=rng)
    torch.testing.assert_close(sh.basis(w, 5) @ sh.rotate(c, tilt), sh.basis(w @ tilt, 5) @ c, rtol=0, atol=1e-12)


def test_a_mirror(rng):
    w, c = directions(20, rng), torch.randn(25, dtype=torch.float64, generator=rng)
    flipped = w * torch.tensor([1.0, -1, 1], dtype=torch.float64)
    torch.testing.assert_close(sh.basis(w, 4) @ sh.mirror_y(c), sh.basis(flipped, 4) @ c, rtol=0, atol=1e-13)


@pytest.mark.parametrize("degree", [0, 1, 5, 20])
@pytest.mark.parametrize("n", [0, 1, 16, 77])
def test_opencl_is_the_formula(degree, n, rng, device):
    w = directions(2 * n, rng, torch.float32)[::2]
    found = sh.basis(w, degree, backend="opencl")
    torch.testing.assert_close(found.double(), sh.basis(w.double(), degree), rtol=0, atol=2e-6 if degree < 6 else 1e-4)


@pytest.mark.parametrize("degree", [0, 1, 5, 20])
def test_opencl_rotates_as_the_formula(degree, rng, device):
    R = rotations(37, rng)
    R[0], R[1] = torch.eye(3), torch.diag(torch.tensor([1.0, -1, -1]))
    c = torch.randn(37, sh.size(degree), generator=rng)
    exact = sh.rotate(c.double(), R)
    torch.testing.assert_close(sh.rotate(c, R.float(), backend="opencl").double(), exact, rtol=0, atol=2e-5)
    one = sh.rotate(c, R[5].float(), backend="opencl")
    torch.testing.assert_close(one.double(), sh.rotate(c.double(), R[5]), rtol=0, atol=2e-5)
    assert sh.rotate(c[:0], R[5].float(), backend="opencl").shape == (0, sh.size(degree))


@pytest.mark.errors
def test_refusals():
    with pytest.raises(BackendError, match="expected float32 on opencl"):
        sh.rotate(torch.zeros(4).double(), torch.eye(3), backend="opencl")
    with pytest.raises(BackendError, match="expected float32 on opencl"):
        sh.basis(torch.eye(3).double(), 2, backend="opencl")
    with pytest.raises(ConfigError, match="degree: expected a value from 0 to 20, got 21"):
        sh.basis(torch.eye(3), 21)
    with pytest.raises(ShapeError, match=r"expected directions \(\.\.\., 3\), got \(2, 2\)"):
        sh.basis(torch.eye(2), 1)
    with pytest.raises(ConfigError, match="expected a square number of coefficients up to 441"):
        sh.rotate(torch.zeros(5), torch.eye(3))
    with pytest.raises(ShapeError, match="expected rotations"):
        sh.rotate(torch.zeros(4), torch.eye(2))
