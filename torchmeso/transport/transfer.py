"""Macro-scale transfer by rays: shadows between bodies and light that they pass on.

Rays leave every vertex in the same evenly spread directions w_r. What stands in the way takes distant light away, and
what it reflects comes in its place:

    M(p) = I - sum_blocked s y(w_r) y(w_r)^T  +  sum_blocked s y(w_r) b(q_r)^T,     s = 4 pi / rays

b(q)^T e is the radiance that a diffuse surface sends back from q: albedo / pi times its irradiance, of which each
bounce adds one more. Written as the identity less what is blocked, M is exact where nothing is, whatever the rays. Rays
below the horizon of a vertex are not cast (`data.transfer`).

Test: tests/transport/test_transfer.py
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.algebra import spherical_harmonics
from torchmeso.data.transfer import Transfer
from torchmeso.errors import check_memory, check_range, check_shape
from torchmeso.geometry.rays import RayScene, offset

MEMORY_LIMIT = 6 << 30

AT_ONCE = 1 << 19
"""Rays cast at once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TransferOptions:
    """How light is followed to the vertices.

    Attributes:
        degree: of light and of what arrives, 0 to 10.
        rays: from each vertex, over the whole sphere; 16 to 65,536.
        bounces: reflections between bodies; 0 = shadows alone.
    """

    degree: int = 5
    rays: int = 4096
    bounces: int = 1

    def __post_init__(self) -> None:
        """Raise ConfigError for a value out of range."""
        check_range("transfer.degree", self.degree, 0, 10)
        check_range("transfer.rays", self.rays, 16, 65536)
        check_range("transfer.bounces", self.bounces, 0, 64)


class Bodies(NamedTuple):
    """All bodies of a scene as one.

    Attributes:
        vertices: (V, 3).
        faces: (F, 3).
        normals: (V, 3) unit, away from the bodies.
        albedo: (V, 3) share of light that is passed on.
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    normals: Float[Tensor, "V 3"]
    albedo: Float[Tensor, "V 3"]


class _Blocked(NamedTuple):
    """Rays that something stands in the way of: from which vertex, which direction, where they end."""

    vertex: Tensor
    ray: Tensor
    face: Tensor
    share: Tensor


def bake(
    bodies: Bodies, options: TransferOptions | None = None, progress: Callable[[float], None] = lambda _: None
) -> Transfer:
    """Return the transfer of distant light to the vertices of `bodies`.

    Raises:
        GeometryError: there is no triangle.
        SizeError: the matrices would need more memory than the limit.
        ShapeError: the arrays of the bodies do not match.
    """
    options = options or TransferOptions()
    count, n = len(bodies.vertices), spherical_harmonics.size(options.degree)
    for name, x in zip(("normals", "albedo"), bodies[2:], strict=True):
        check_shape(f"transfer: {name}", x, (count, 3))
    colours = 1 if options.bounces == 0 or bool((bodies.albedo == bodies.albedo[:, :1]).all()) else 3
    needed = 8.0 * count * n * n * (colours + 1) + 9.0 * count * options.rays
    check_memory("transfer", needed, MEMORY_LIMIT, "lower its degree, its rays, or the vertices")
    w = spread(options.rays)
    y = spherical_harmonics.basis(w, options.degree)
    blocked = _cast(bodies, w, progress)
    per_ray = 4 * math.pi / options.rays
    direct = torch.eye(n, dtype=torch.float64) - per_ray * _outer(blocked, y, count)
    M = direct[:, None].repeat(1, colours, 1, 1)
    for _ in range(options.bounces):
        sent = _sent(M, bodies, options.degree)
        M = direct[:, None] + per_ray * _returned(blocked, y, sent, bodies.faces, count)
    return Transfer(matrices=M.float())


def spread(count: int) -> Float[Tensor, "ray 3"]:
    """Return evenly spread directions on a spiral of equal turns (golden angle), float64."""
    k = torch.arange(count, dtype=torch.float64) + 0.5
    z, phi = 1 - 2 * k / count, k * (math.pi * (3 - math.sqrt(5)))
    r = (1 - z.square()).sqrt()
    return torch.stack([r * phi.cos(), r * phi.sin(), z], -1)


def _cast(bodies: Bodies, w: Tensor, progress: Callable[[float], None]) -> _Blocked:
    scene = RayScene(bodies.vertices, bodies.faces)
    size = float((bodies.vertices.amax(0) - bodies.vertices.amin(0)).max()) + float(bodies.vertices.abs().max())
    found = []
    for part in torch.arange(len(bodies.vertices)).split(max(AT_ONCE // len(w), 1)):
        progress(float(part[0]) / len(bodies.vertices))
        vertex, ray = (bodies.normals[part].double() @ w.mT > 0).nonzero().unbind(1)
        vertex = part[vertex]
        origin = offset(bodies.vertices[vertex], bodies.normals[vertex], size)
        hits = scene.first_hit(origin, w[ray])
        met = hits.face >= 0
        found.append(_Blocked(vertex[met], ray[met], hits.face[met], hits.barycentric[met]))
    progress(1.0)
    return _Blocked(*(torch.cat(x) for x in zip(*found, strict=True)))


def _outer(blocked: _Blocked, y: Tensor, count: int) -> Float[Tensor, "V n n"]:
    """Return the sum of y y^T over the blocked rays of each vertex."""
    n = y.shape[1]
    row, column = torch.triu_indices(n, n)
    products = (y[:, row] * y[:, column]).float()
    total = torch.zeros(count, n, n, dtype=torch.float64)
    for part in torch.arange(count).split(4096):
        mine = (blocked.vertex >= part[0]) & (blocked.vertex <= part[-1])
        is_blocked = torch.zeros(len(part), len(y))
        is_blocked[blocked.vertex[mine] - part[0], blocked.ray[mine]] = 1
        upper = (is_blocked @ products).double()
        total[part[:, None], row, column] = upper
        total[part[:, None], column, row] = upper
    return total


def _sent(M: Tensor, bodies: Bodies, degree: int) -> Float[Tensor, "V C n"]:
    """Return b: of every harmonic of distant light the radiance that each vertex sends back, as a diffuse surface."""
    around = spherical_harmonics.cosine_lobe(degree) * spherical_harmonics.basis(bodies.normals.double(), degree)
    albedo = bodies.albedo.double()[:, : M.shape[1]] / math.pi
    return albedo[..., None] * torch.einsum("vi,vcij->vcj", around, M)


def _returned(blocked: _Blocked, y: Tensor, sent: Tensor, faces: Tensor, count: int) -> Float[Tensor, "V C n n"]:
    """Return the sum of y b^T over the blocked rays of each vertex."""
    colours, n = sent.shape[1:]
    total = torch.zeros(count, colours, n, n, dtype=torch.float64)
    for part in torch.arange(len(blocked.vertex)).split(1 << 16):
        corner = faces[blocked.face[part]]
        b = (sent[corner] * blocked.share[part].double()[..., None, None]).sum(1)
        start, index = blocked.vertex[part].unique_consecutive(return_inverse=True)
        bounds = torch.searchsorted(index, torch.arange(len(start) + 1)).tolist()
        from_ray = y[blocked.ray[part]]
        for vertex, low, high in zip(start.tolist(), bounds, bounds[1:], strict=False):
            total[vertex] += torch.einsum("ri,rcj->cij", from_ray[low:high], b[low:high])
    return total
