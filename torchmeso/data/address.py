"""Texel addresses: texture coordinates -> the four texels around them, and their weights.

u runs right and v up, texel centres at (i + 0.5) / N, the texture repeats with period 1; arrays store row 0
at the top (v near 1). This is the one place that turns v into a row.

Test: tests/data/test_address.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor


class Taps(NamedTuple):
    """The four texels of a bilinear look-up.

    Attributes:
        texel: (..., 4) number, row * width + column.
        weight: (..., 4) in [0, 1], sums to 1.
    """

    texel: Int[Tensor, "*batch 4"]
    weight: Float[Tensor, "*batch 4"]


def bilinear(uv: Float[Tensor, "*batch 2"], height: int, width: int) -> Taps:
    """Return the four texels around `uv` in a repeating height x width texture.

    Order: (top left, top right, bottom left, bottom right). Differentiable in `uv` through the weights.
    """
    uv = uv - uv.detach().floor()  # keeps float32 exact to a small part of a texel far from the origin
    x = uv[..., 0] * width - 0.5
    y = (1 - uv[..., 1]) * height - 0.5
    left, top = x.detach().floor(), y.detach().floor()
    fx, fy = x - left, y - top
    column, row = left.long() % width, top.long() % height
    right, bottom = (column + 1) % width, (row + 1) % height
    texel = torch.stack(
        [row * width + column, row * width + right, bottom * width + column, bottom * width + right], -1
    )
    weight = torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], -1)
    return Taps(texel, weight)


def texel_centres(height: int, width: int, dtype: torch.dtype = torch.float32) -> Float[Tensor, "height width 2"]:
    """Return the texture coordinates of every texel centre, row 0 (v near 1) first."""
    u = (torch.arange(width, dtype=dtype) + 0.5) / width
    v = 1 - (torch.arange(height, dtype=dtype) + 0.5) / height
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)
