"""Real spherical harmonics: the basis, its products over the hemisphere, rotation of coefficient vectors.

A function f on the sphere is f(w) = sum_i c_i y_i(w), i = l^2 + l + m, l = 0..degree, m = -l..l. The basis is
orthonormal over the sphere; m > 0 goes with cos(m phi), m < 0 with sin(|m| phi), without the Condon-Shortley
phase. It is a polynomial in x, y, z by the Cartesian recurrence

    y_lm = P_l^|m|(z) * (Re | Im) (x + i y)^|m|

with P normalised and free of powers of sin(theta), so nothing divides by zero at the pole.

A rotation acts on a coefficient vector as Z(alpha) J^T Z(beta) J Z(gamma): three diagonal rotations about z
and the constant matrix J of a quarter turn about x. No matrix of a rotation is ever formed.

Kernel: kernels_cl/algebra/spherical_harmonics.cl          Test: tests/algebra/test_spherical_harmonics.py
"""

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Float32, Int
from torch import Tensor

from torchmeso.backends import BackendChoice, opencl
from torchmeso.errors import BackendError, ConfigError, ShapeError, check_range

BLOCK = 8192
"""Directions at a time: their basis stays in a core's cache."""

PER_ITEM = 64
"""Directions of a work-item: as in the kernel."""

MAX_DEGREE = 20
"""Highest degree; the recurrence is tested to here in float32 and float64."""


def size(degree: int) -> int:
    """Return the number of coefficients up to `degree`: (degree + 1)^2.

    Raises:
        ConfigError: degree is not in 0..20.
    """
    check_range("spherical harmonics: degree", degree, 0, MAX_DEGREE)
    return (degree + 1) ** 2


def degree_of(coefficients: int) -> int:
    """Return the degree of a vector of 1, 4, 9, 16, ... coefficients.

    Raises:
        ConfigError: another number, or more than degree 20.
    """
    degree = math.isqrt(max(coefficients, 1)) - 1
    if (degree + 1) ** 2 != coefficients or degree > MAX_DEGREE:
        raise ConfigError(
            f"spherical harmonics: expected a square number of coefficients up to {size(MAX_DEGREE)} "
            f"(1, 4, 9, 16, ...), got {coefficients}"
        )
    return degree


def basis(w: Float[Tensor, "*batch 3"], degree: int, *, backend: BackendChoice = "torch") -> Float[Tensor, "*batch n"]:
    """Return the basis functions y_i(w), i = l^2 + l + m, for unit directions w.

    Args:
        w: unit directions; float32 on opencl.
        degree: highest l, at most 20.
        backend: torch is differentiable and runs in float64.

    Raises:
        BackendError: w wants a gradient or is not float32, on opencl.
        ConfigError: degree is not in 0..20.
        ShapeError: the last axis of w is not 3.
    """
    n = size(degree)
    if w.shape[-1:] != (3,):
        raise ShapeError(f"spherical harmonics: expected directions (..., 3), got {tuple(w.shape)}")
    flat = w.reshape(-1, 3)
    if opencl.resolve(backend) == "opencl":
        return _basis_opencl(flat, degree).reshape(*w.shape[:-1], n)
    if w.requires_grad:
        return torch.stack(_rows(flat, degree), -1).reshape(*w.shape[:-1], n)
    out = w.new_empty(len(flat), n)
    for part, place in zip(flat.split(BLOCK), out.split(BLOCK), strict=True):
        torch.stack(_rows(part, degree), -1, out=place)
    return out.reshape(*w.shape[:-1], n)


def _basis_opencl(w: Float[Tensor, "k 3"], degree: int) -> Float[Tensor, "k n"]:
    if w.dtype != torch.float32:
        raise BackendError(f"spherical harmonics: expected float32 on opencl, got {w.dtype}; use backend='torch'")
    out = torch.empty(len(w), size(degree))
    if not len(w):
        return out
    source = opencl.aligned(w)
    device, device_out = opencl.buffer(source), opencl.buffer(out)
    run = opencl.kernel("algebra/spherical_harmonics.cl", "basis")
    groups = -(-len(w) // PER_ITEM)
    run(opencl.queue(), (groups,), (1,), _steps(degree), np.int32(degree), device, np.int32(len(w)), device_out)
    opencl.read([(device_out, out)])
    return out


@lru_cache(maxsize=8)
def _steps(degree: int) -> "opencl.Buffer":
    return opencl.upload(recurrence(degree))


def recurrence(degree: int) -> Float32[np.ndarray, "number"]:
    """Return the numbers of the recurrence as kernels read them: for each m P_m^m, then two factors for each l > m."""
    numbers: list[float] = []
    for m in range(degree + 1):
        numbers.append(_sectoral(m))
        for l in range(m + 1, degree + 1):
            a, b = _step(l, m)
            numbers += [a, -a * b]
    return np.array(numbers, np.float32)


def _rows(w: Float[Tensor, "k 3"], degree: int) -> list[Float[Tensor, "k"]]:
    """Return the basis, one contiguous row per function."""
    x, y, z = (a.contiguous() for a in w.unbind(-1))
    rows: list[Tensor] = [z] * size(degree)
    cosine, sine = torch.ones_like(z), torch.zeros_like(z)
    for m in range(degree + 1):
        if m:
            cosine, sine = x * cosine - y * sine, x * sine + y * cosine
        before, last = None, torch.full_like(z, _sectoral(m))
        for l in range(m, degree + 1):
            if l > m:
                a, b = _step(l, m)
                now = a * z * last if before is None else torch.addcmul(before * (-a * b), z, last, value=a)
                before, last = last, now
            centre = l * l + l
            rows[centre + m] = last * cosine
            if m:
                rows[centre - m] = last * sine
    return rows


def _sectoral(m: int) -> float:
    """Return P_m^m: sqrt((2m + 1) / 4 pi * (2m - 1)!! / (2m)!!), times sqrt(2) for the real basis where m > 0."""
    product = math.prod((2 * k - 1) / (2 * k) for k in range(1, m + 1))
    return math.sqrt((2 * m + 1) / (4 * math.pi) * product * (2 if m else 1))


def _step(l: int, m: int) -> tuple[float, float]:
    """Return a, b of P_l^m = a (z P_(l-1)^m - b P_(l-2)^m)."""
    a = math.sqrt((4 * l * l - 1) / (l * l - m * m))
    return a, math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1))


@lru_cache(maxsize=8)
def hemisphere_matrix(degree: int) -> Float[Tensor, "n n"]:
    """Return A, A_ij = integral of y_i y_j over the upper hemisphere, in float64 (leung2007tileable, eq. 2).

    By Gauss-Legendre in z and equal steps in phi, exact for polynomials of these degrees.
    """
    w, weight = _quadrature(degree, 0.0)
    y = basis(w, degree)
    A = y.mT @ (weight[:, None] * y)
    return (A + A.mT) / 2


def cosine_lobe(degree: int) -> Float[Tensor, "n"]:
    """Return h_l, repeated for every m: the integral of max(cos, 0) y_j around n is h_l y_j(n); float64."""
    A = hemisphere_matrix(max(degree, 1))
    # cos theta is a multiple of y_2 = y_(1, 0); of these integrals only those with m = 0 are not 0.
    zonal = A[2, [l * l + l for l in range(degree + 1)]] * math.sqrt(4 * math.pi / 3)
    at_pole = torch.tensor([math.sqrt((2 * l + 1) / (4 * math.pi)) for l in range(degree + 1)], dtype=torch.float64)
    each = zonal / at_pole
    return torch.cat([each[l].expand(2 * l + 1) for l in range(degree + 1)])


def project(
    f: Float[Tensor, "*batch sample"], w: Float[Tensor, "sample 3"], solid_angle: Float[Tensor, "sample"], degree: int
) -> Float[Tensor, "*batch n"]:
    """Return c_i = sum of f(w) y_i(w) d omega: the `sphere_projection` of samples that cover the sphere."""
    return f @ (solid_angle[:, None] * basis(w, degree)).to(f.dtype)


def rotate(
    c: Float[Tensor, "*#batch n"], rotation: Float[Tensor, "*#batch 3 3"], *, backend: BackendChoice = "torch"
) -> Float[Tensor, "*batch n"]:
    """Return the coefficients of the turned function, f'(w) = f(R^T w): a lobe along w then lies along R w.

    Args:
        c: coefficients up to any degree <= 20.
        rotation: orthonormal, determinant +1. A left-handed frame is a rotation after `mirror_y`.
        backend: torch is differentiable and runs in float64.

    Raises:
        BackendError: c wants a gradient or is not float32, on opencl.
        ConfigError: the number of coefficients is not a square.
        ShapeError: `rotation` is not (..., 3, 3).
    """
    degree = degree_of(c.shape[-1])
    if rotation.shape[-2:] != (3, 3):
        raise ShapeError(f"spherical harmonics: expected rotations (..., 3, 3), got {tuple(rotation.shape)}")
    if opencl.resolve(backend) == "opencl":
        return _rotate_opencl(c, rotation, degree)
    alpha, beta, gamma = _euler(rotation.to(c.dtype))
    J = _quarter_turn(degree).to(c.dtype)
    turned = _turn_z(c, gamma) @ J.mT
    return _turn_z(_turn_z(turned, beta) @ J, alpha)


def _rotate_opencl(c: Tensor, rotation: Tensor, degree: int) -> Tensor:
    if c.dtype != torch.float32:
        raise BackendError(f"spherical harmonics: expected float32 on opencl, got {c.dtype}; use backend='torch'")
    batch = torch.broadcast_shapes(c.shape[:-1], rotation.shape[:-2])
    each = int(rotation[..., 0, 0].numel() > 1)
    R = rotation.float().expand(*batch, 3, 3) if each else rotation.float()
    source, turns = (opencl.aligned(x) for x in (c.expand(*batch, -1), R))
    out = torch.empty(*batch, c.shape[-1])
    count = batch.numel()
    if not count:
        return out
    device, device_turns, device_out = (opencl.buffer(x) for x in (source, turns, out))
    run = opencl.kernel("algebra/spherical_harmonics.cl", "rotate_vectors")
    J = _quarter_turn_on_device(degree)
    arguments = J, np.int32(degree), device_turns, np.int32(each), device, np.int32(count), device_out
    run(opencl.queue(), (-(-count // PER_ITEM),), (1,), *arguments)
    opencl.read([(device_out, out)])
    return out


@lru_cache(maxsize=8)
def _quarter_turn_on_device(degree: int) -> "opencl.Buffer":
    return opencl.upload(quarter_turn_blocks(degree))


def quarter_turn_blocks(degree: int) -> Float32[np.ndarray, "number"]:
    """Return what kernels need to rotate: J's blocks for l = 0, 1, ..., one behind the other."""
    J = _quarter_turn(degree).float()
    blocks = [J[l * l : (l + 1) ** 2, l * l : (l + 1) ** 2].flatten() for l in range(degree + 1)]
    return torch.cat(blocks).numpy()


def mirror_y(c: Float[Tensor, "*batch n"]) -> Float[Tensor, "*batch n"]:
    """Return the coefficients of f(x, -y, z): what a left-handed frame sees."""
    m, _ = _orders(degree_of(c.shape[-1]))
    return torch.where(m < 0, -c, c)


def _euler(R: Float[Tensor, "*batch 3 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Return alpha, beta, gamma of R = Rz(alpha) Ry(beta) Rz(gamma).

    beta and gamma are taken from Rz(-alpha) R, so that R is reproduced also where alpha is arbitrary (beta = 0, pi).
    """
    alpha = torch.atan2(R[..., 1, 2], R[..., 0, 2])
    cosine, sine = alpha.cos(), alpha.sin()
    beta = torch.atan2(cosine * R[..., 0, 2] + sine * R[..., 1, 2], R[..., 2, 2])
    gamma = torch.atan2(cosine * R[..., 1, 0] - sine * R[..., 0, 0], cosine * R[..., 1, 1] - sine * R[..., 0, 1])
    return alpha, beta, gamma


def _turn_z(c: Float[Tensor, "*#batch n"], angle: Float[Tensor, "*#batch"]) -> Float[Tensor, "*batch n"]:
    """Return c turned about z: each pair (m, -m) turns by m angle."""
    degree = degree_of(c.shape[-1])
    m, partner = _orders(degree)
    multiple = angle[..., None] * torch.arange(degree + 1, dtype=c.dtype)
    cosine = multiple.cos()[..., m.abs()]
    sine = (multiple.sin()[..., m.abs()]) * m.sign().to(c.dtype)
    return c * cosine - c[..., partner] * sine


@lru_cache(maxsize=8)
def _orders(degree: int) -> tuple[Int[Tensor, "n"], Int[Tensor, "n"]]:
    """Return the order m of every coefficient and the place of its partner -m."""
    l_and_m = [(l, m) for l in range(degree + 1) for m in range(-l, l + 1)]
    return torch.tensor([m for _, m in l_and_m]), torch.tensor([l * l + l - m for l, m in l_and_m])


@lru_cache(maxsize=8)
def _quarter_turn(degree: int) -> Float[Tensor, "n n"]:
    """Return J: coefficients of a function turned by 90 degrees about x (y -> z), in float64.

    Ry(beta) = Rx(-90) Rz(beta) Rx(90). J_ij = integral of y_i(w) y_j(Rx^T w), by a quadrature exact for them.
    """
    w, weight = _quadrature(degree, -1.0)
    x, y, z = w.unbind(-1)
    J = basis(w, degree).mT @ (weight[:, None] * basis(torch.stack([x, z, -y], -1), degree))
    degrees = torch.tensor([l for l in range(degree + 1) for _ in range(2 * l + 1)])
    return torch.where(degrees[:, None] == degrees, J, 0)


def _quadrature(degree: int, lowest: float) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point"]]:
    """Return points and weights, z in [lowest, 1], exact for products of two functions up to `degree`."""
    nodes, weights = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(degree + 1))
    z = lowest + (nodes + 1) * ((1 - lowest) / 2)
    steps = 2 * degree + 1
    phi = torch.arange(steps, dtype=torch.float64) * (2 * math.pi / steps)
    r = (1 - z * z).clamp(min=0).sqrt()[:, None]
    w = torch.stack([r * phi.cos(), r * phi.sin(), z[:, None].expand(-1, steps)], -1)
    weight = (weights * ((1 - lowest) / 2))[:, None].expand(-1, steps) * (2 * math.pi / steps)
    return w.reshape(-1, 3), weight.reshape(-1)
