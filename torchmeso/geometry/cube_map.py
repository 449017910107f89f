"""Cube maps: directions and solid angles of their texels.

Six faces of n x n texels, +x, -x, +y, -y, +z, -z, each a square of side 2 at distance 1 from the centre. A texel's
solid angle is the exact one of its rectangle: with S(x, y) = atan2(x y, sqrt(x^2 + y^2 + 1)) at its corners,
S(x1, y1) - S(x0, y1) - S(x1, y0) + S(x0, y0), so that all of them are the sphere.

Test: tests/geometry/test_cube_map.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import check_range


class CubeMap(NamedTuple):
    """The texels of a cube map, face by face, row by row.

    Attributes:
        directions: (6 n n, 3) unit, through the centres.
        solid_angle: (6 n n), 4 pi in all.
    """

    directions: Float[Tensor, "texel 3"]
    solid_angle: Float[Tensor, "texel"]


def texels(n: int) -> CubeMap:
    """Return the texels of a cube map with n x n of them on a face, in float64.

    Raises:
        ConfigError: n is not in 1..1024.
    """
    check_range("cube map: texels along a face", n, 1, 1024)
    edge = torch.linspace(-1, 1, n + 1, dtype=torch.float64)
    x, y = torch.meshgrid(edge, edge, indexing="xy")
    corner = torch.atan2(x * y, (x * x + y * y + 1).sqrt())
    each = corner[1:, 1:] - corner[1:, :-1] - corner[:-1, 1:] + corner[:-1, :-1]
    middle = (edge[1:] + edge[:-1]) / 2
    a, b = torch.meshgrid(middle, middle, indexing="xy")
    one = torch.ones_like(a)
    faces = [
        torch.roll(torch.stack([sign * one, a, b], -1), axis, dims=-1) for axis in range(3) for sign in (1.0, -1.0)
    ]
    directions = torch.nn.functional.normalize(torch.stack(faces).reshape(-1, 3), dim=-1)
    return CubeMap(directions, each.flatten().repeat(6))
