"""Rows of the suite `compress` on spherical harmonics: basis and rotation beside sphericart and e3nn.

Test: tests/bench/test_harmonics.py
"""

import math
import time
from collections.abc import Callable, Iterator
from types import ModuleType

import torch
from torch import Tensor

from torchmeso.algebra import spherical_harmonics
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import time_together

DEGREE = 5


def basis(context: Context) -> Iterator[Row]:
    """Time and error of the basis."""
    w = _directions(1_000_000, torch.float32)
    what = "basis to degree 5 of a million directions in float32, over sphericart"
    try:
        import sphericart.torch as sphericart
    except ImportError:
        yield _missing("compress.sh.vs_sphericart", what, "sphericart-torch")
    else:
        theirs = sphericart.SphericalHarmonics(DEGREE)
        calls: dict[str, Callable[[], object]] = {
            "ours": lambda: spherical_harmonics.basis(w, DEGREE, backend="opencl"),
            "torch": lambda: spherical_harmonics.basis(w, DEGREE),
            "sphericart": lambda: theirs.compute(w),
        }
        timing = time_together(calls, n=5 if context.quick else 15)
        ours, peer = timing["ours"], timing["sphericart"]
        yield Row(
            id="compress.sh.vs_sphericart", what=what, value=round(ours.wall / peer.wall, 2), unit="x", better="lower",
            goal=2.0, n=ours.n,
            peer=f"ours {ours.wall:.0f} ms, torch {timing['torch'].wall:.0f} ms, sphericart {peer.wall:.0f} ms",
        )  # fmt: skip
    for degree, dtype, goal in ((5, torch.float32, 3e-7), (20, torch.float64, 1e-13), (20, torch.float32, None)):
        name = str(dtype).removeprefix("torch.")
        yield Row(
            id=f"compress.sh.error.{degree}.{name}",
            what=f"largest error of the basis of degree {degree} in {name} against 50 digits",
            value=float(f"{_error(degree, dtype):.2g}"), unit="", better="lower", goal=goal,
        )  # fmt: skip


def rotation(context: Context) -> Iterator[Row]:
    """Time and soundness of rotations of coefficient vectors."""
    n = 10_000 if context.quick else 100_000
    generator = torch.Generator().manual_seed(3)
    R = torch.linalg.qr(torch.randn(n, 3, 3, dtype=torch.float64, generator=generator)).Q
    R = R * torch.linalg.det(R)[:, None, None]
    c = torch.randn(n, spherical_harmonics.size(DEGREE), generator=generator)
    single = R.float()
    timing = time_together(
        {
            "ours": lambda: spherical_harmonics.rotate(c, single, backend="opencl"),
            "torch": lambda: spherical_harmonics.rotate(c, single),
        },
        n=7,
    )
    ours = timing["ours"]
    what = f"e3nn over ours: rotation of {n} vectors of degree 5, each its own, float32"
    try:
        from e3nn import o3
    except ImportError:
        yield _missing("compress.rotation.vs_e3nn", what, "e3nn")
    else:
        start = time.perf_counter()
        _by_e3nn(o3, c, single)
        peer = 1e3 * (time.perf_counter() - start)
        yield Row(
            id="compress.rotation.vs_e3nn", what=what, value=round(peer / ours.wall, 1), unit="x", better="higher",
            goal=100.0, n=ours.n,
            peer=f"e3nn {peer:.0f} ms, ours {ours.wall:.1f} ms, torch {timing['torch'].wall:.0f} ms",
        )  # fmt: skip
    one = torch.eye(spherical_harmonics.size(DEGREE), dtype=torch.float64)
    M = torch.stack([spherical_harmonics.rotate(one, r).mT for r in R[:64]])
    yield Row(
        id="compress.rotation.orthogonal", what="largest entry of R R^T - 1, float64, degree 5",
        value=float(f"{(M @ M.mT - one).abs().max():.2g}"), unit="", better="lower", goal=1e-13,
    )  # fmt: skip
    both = torch.stack([spherical_harmonics.rotate(one, r).mT for r in R[:63] @ R[1:64]])
    yield Row(
        id="compress.rotation.composed", what="largest entry of R(ab) - R(a) R(b), float64, degree 5",
        value=float(f"{(both - M[:63] @ M[1:]).abs().max():.2g}"), unit="", better="lower", goal=1e-13,
    )  # fmt: skip


def _by_e3nn(o3: ModuleType, c: Tensor, R: Tensor) -> Tensor:
    angles = o3.matrix_to_angles(R)
    parts = [torch.einsum("nij,nj->ni", o3.wigner_D(l, *angles), c[:, l * l : (l + 1) ** 2]) for l in range(DEGREE + 1)]
    return torch.cat(parts, 1)


def _directions(n: int, dtype: torch.dtype) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    return torch.nn.functional.normalize(torch.randn(n, 3, dtype=dtype, generator=generator), dim=-1)


def _error(degree: int, dtype: torch.dtype) -> float:
    """Return the largest error at 24 directions, of all orders of the highest degree."""
    w = _directions(20_000, dtype)
    # Directions as near to unit length as the type has them: their own error is not the basis'.
    w = w[(w.double().norm(dim=-1) - 1).abs().argsort()[:24]]
    y = spherical_harmonics.basis(w, degree)[:, degree * degree :].double()
    exact = [[by_definition(d.tolist(), degree, m) for m in range(-degree, degree + 1)] for d in w]
    return float((y - torch.tensor(exact, dtype=torch.float64)).abs().max())


def by_definition(w: list[float], degree: int, order: int) -> float:
    """Return one harmonic from its definition by derivatives of Legendre's polynomial, with 50 digits."""
    import mpmath

    with mpmath.workdps(50):
        x, y, z = (mpmath.mpf(a) for a in w)
        r = mpmath.sqrt(x * x + y * y + z * z)
        k = abs(order)
        derivative = mpmath.mpf(0)
        for j in range(degree // 2 + 1):
            power = degree - 2 * j
            if power >= k:
                a = mpmath.mpf((-1) ** j * math.comb(degree, j) * math.comb(2 * degree - 2 * j, degree)) / 2**degree
                derivative += a * math.perm(power, k) * (z / r) ** (power - k)
        share = mpmath.mpf(math.factorial(degree - k)) / math.factorial(degree + k)
        norm = mpmath.sqrt((2 * degree + 1) / (4 * mpmath.pi) * share * (2 if order else 1))
        turn = mpmath.mpc(x / r, y / r) ** k
        return float(norm * derivative * (turn.real if order >= 0 else turn.imag))


def _missing(id: str, what: str, package: str) -> Row:
    return Row(
        id=id, what=what, value=None, unit="x", better="lower", why=f"{package} is not installed (tools/setup --peers)"
    )
