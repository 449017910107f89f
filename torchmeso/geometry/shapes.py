"""Built-in meshes at chosen triangle counts: plane, cylinder, sphere, torus, torus knot.

Each is a map (a, b) in [0, 1]^2 -> world, sampled on a regular grid; `tiles` says how often the mesostructure
repeats along a (= u) and b (= v). All but the plane are closed.

Test: tests/geometry/test_shapes.py
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.errors import check_range
from torchmeso.geometry.directions import dot, normalize
from torchmeso.geometry.mesh import Mesh, dress

Tiles = tuple[float, float]


def plane(*, size: tuple[float, float] = (2.0, 2.0), tiles: Tiles = (4, 4), triangles: int = 2) -> Mesh:
    """Return a rectangle of `size` in the xz plane, normal +y, u along +x and v along -z."""
    _check_sizes(width=size[0], depth=size[1])
    n_a, n_b = _segments(triangles, aspect=size[0] / size[1], least=(1, 1))

    def point(a: Tensor, b: Tensor) -> Tensor:
        return torch.stack([(a - 0.5) * size[0], torch.zeros_like(a), (0.5 - b) * size[1]], -1)

    return _from_grid("plane", point, n_a, n_b, tiles)


def cylinder(*, radius: float = 1.0, height: float = 2.0, tiles: Tiles = (8, 3), triangles: int = 2048) -> Mesh:
    """Return a closed cylinder around the y axis; its caps carry the texture at the scale of the side."""
    _check_sizes(radius=radius, height=height)
    n_a, n_b = _segments(triangles, aspect=2 * math.pi * radius / height, least=(8, 1))

    def side(a: Tensor, b: Tensor) -> Tensor:
        angle = 2 * math.pi * a
        return torch.stack([radius * angle.sin(), (b - 0.5) * height, radius * angle.cos()], -1)

    vertices, uv, faces = _grid(side, n_a, n_b, tiles, wrap=(True, False))
    scale = 0.5 * (tiles[0] / (2 * math.pi * radius) + tiles[1] / height)
    for b, turn in ((0, -1.0), (n_b, 1.0)):
        rim = vertices[torch.arange(n_a + 1) * (n_b + 1) + b]
        first = len(vertices)
        centre = torch.tensor([[0.0, float(rim[0, 1]), 0.0]], dtype=torch.float64)
        vertices = torch.cat([vertices, rim, centre])
        cap_uv = torch.stack([rim[:, 0], -turn * rim[:, 2]], -1) * scale
        uv = torch.cat([uv, cap_uv, torch.zeros(1, 2, dtype=torch.float64)])
        k = torch.arange(n_a)
        fan = torch.stack([first + k, first + k + 1, torch.full((n_a,), first + n_a + 1)], -1)
        faces = torch.cat([faces, fan if turn > 0 else fan.flip(1)])
    return dress(vertices.float(), faces, uv.float(), name="cylinder")


def sphere(*, radius: float = 1.0, tiles: Tiles = (12, 6), triangles: int = 5000) -> Mesh:
    """Return a closed sphere around the origin with its poles on the y axis."""
    _check_sizes(radius=radius)
    n_a, n_b = _segments(triangles, aspect=2.0, least=(8, 4))

    def point(a: Tensor, b: Tensor) -> Tensor:
        angle, polar = 2 * math.pi * a, math.pi * (1 - b)
        ring = torch.where((b == 0) | (b == 1), 0.0, polar.sin())  # both poles are one position
        return radius * torch.stack([ring * angle.sin(), polar.cos(), ring * angle.cos()], -1)

    return _from_grid("sphere", point, n_a, n_b, tiles, wrap=(True, False))


def torus(*, radius: float = 1.0, tube: float = 0.4, tiles: Tiles = (8, 3), triangles: int = 3200) -> Mesh:
    """Return a closed torus around the y axis; u runs along the tube, v around it."""
    _check_sizes(radius=radius, tube=tube)
    n_a, n_b = _segments(triangles, aspect=radius / tube, least=(8, 6))

    def point(a: Tensor, b: Tensor) -> Tensor:
        along, around = 2 * math.pi * a, 2 * math.pi * b
        ring = radius + tube * around.cos()
        return torch.stack([ring * along.sin(), tube * around.sin(), ring * along.cos()], -1)

    return _from_grid("torus", point, n_a, n_b, tiles, wrap=(True, True))


def torus_knot(
    *,
    p: int = 2,
    q: int = 3,
    radius: float = 1.0,
    swing: float = 0.45,
    tube: float = 0.2,
    tiles: Tiles = (40, 4),
    triangles: int = 11952,
) -> Mesh:
    """Return a closed (p, q) torus knot; 11,952 triangles are 332 x 18 quads, as in wang2005mdf, Table 2."""
    _check_sizes(radius=radius, tube=tube)
    check_range("shape.p", p, 1, 100)
    check_range("shape.q", q, 0, 100)
    check_range("shape.swing", swing, 0, 1e9)
    curve = _knot(p, q, radius, swing)
    length = float((curve(torch.linspace(0, 1, 2001, dtype=torch.float64)).diff(dim=0)).norm(dim=-1).sum())
    n_a, n_b = _segments(triangles, aspect=length / (2 * math.pi * tube), least=(16, 6))

    def point(a: Tensor, b: Tensor) -> Tensor:
        centre = curve(a)
        along = normalize(curve(a + 1e-5) - curve(a - 1e-5))
        outwards = centre * torch.tensor([1.0, 1.0, 0.0], dtype=centre.dtype)
        side = normalize(outwards - dot(outwards, along).unsqueeze(-1) * along)
        up = torch.linalg.cross(side, along)
        around = (2 * math.pi * b).unsqueeze(-1)
        return centre + tube * (side * around.cos() + up * around.sin())

    return _from_grid("torus_knot", point, n_a, n_b, tiles, wrap=(True, True))


def _check_sizes(**sizes: float) -> None:
    for name, size in sizes.items():
        check_range(f"shape.{name}", size, 1e-9, 1e9)


SHAPES: dict[str, Callable[..., Mesh]] = {
    "plane": plane,
    "cylinder": cylinder,
    "sphere": sphere,
    "torus": torus,
    "torus_knot": torus_knot,
}


def _knot(p: int, q: int, radius: float, swing: float) -> Callable[[Tensor], Tensor]:
    def curve(a: Tensor) -> Tensor:
        t = 2 * math.pi * a
        ring = radius + swing * (q * t).cos()
        return torch.stack([ring * (p * t).cos(), ring * (p * t).sin(), swing * (q * t).sin()], -1)

    return curve


def _segments(triangles: int, *, aspect: float, least: tuple[int, int]) -> tuple[int, int]:
    """Return n_a x n_b quads with 2 n_a n_b close to `triangles` and n_a / n_b close to `aspect`.

    An exact factorisation is taken where one lies within a third of the aspect.
    """
    check_range("triangles", triangles, 2 * least[0] * least[1], 2e8)
    quads = triangles / 2
    ideal = math.sqrt(quads * aspect)
    near = range(max(least[0], int(ideal * 0.75)), int(ideal * 1.33) + 1)
    exact = [n for n in near if triangles % (2 * n) == 0 and triangles // (2 * n) >= least[1]]
    n_a = min(exact, key=lambda n: abs(math.log(n / ideal))) if exact else round(ideal)
    n_a = max(least[0], n_a)
    return n_a, max(least[1], round(quads / n_a))


def _from_grid(
    name: str,
    point: Callable[[Tensor, Tensor], Tensor],
    n_a: int,
    n_b: int,
    tiles: Tiles,
    wrap: tuple[bool, bool] = (False, False),
) -> Mesh:
    vertices, uv, faces = _grid(point, n_a, n_b, tiles, wrap)
    return dress(vertices.float(), faces, uv.float(), name=name)


def _grid(
    point: Callable[[Tensor, Tensor], Tensor], n_a: int, n_b: int, tiles: Tiles, wrap: tuple[bool, bool]
) -> tuple[Float[Tensor, "V 3"], Float[Tensor, "V 2"], Int[Tensor, "F 3"]]:
    """Sample `point` on (n_a + 1) x (n_b + 1) vertices; a wrapped axis ends on its first row, bit for bit.

    Quads that touch a pole keep only the triangle that has area.
    """
    a, b = torch.meshgrid(
        torch.arange(n_a + 1, dtype=torch.float64) / n_a,
        torch.arange(n_b + 1, dtype=torch.float64) / n_b,
        indexing="ij",
    )
    where_a = a.clone()
    where_b = b.clone()
    if wrap[0]:
        where_a[-1] = 0
    if wrap[1]:
        where_b[:, -1] = 0
    vertices = point(where_a, where_b).reshape(-1, 3)
    uv = torch.stack([a * tiles[0], b * tiles[1]], -1).reshape(-1, 2)
    number = torch.arange((n_a + 1) * (n_b + 1)).reshape(n_a + 1, n_b + 1)
    p00, p10, p11, p01 = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = torch.stack([torch.stack([p00, p10, p11], -1), torch.stack([p00, p11, p01], -1)], 2).reshape(-1, 3)
    p = vertices[faces].float()
    flat = (p[:, 0] == p[:, 1]).all(-1) | (p[:, 1] == p[:, 2]).all(-1) | (p[:, 2] == p[:, 0]).all(-1)
    return vertices, uv, faces[~flat]
