"""Texel addresses: texture coordinates -> the four texels around them, and their weights.

u runs right and v up, texel centres at (i + 0.5) / N, the texture repeats with period 1; arrays store row 0
at the top (v near 1). This is the one place that turns v into a row.

A quilted texture repeats after more than a side of its exemplar (`data.quilting_map`): each of the four texels is
looked up through the map by itself, so that filtering goes over seams as over any other texels. A table need not have
the exemplar's size: the place of a finer table's texel inside a texel of the map is kept, so one map serves BTF, MDF
and relief. Levels of a pyramid have texels larger than those of the map, and patches do not begin on their borders:
each of the four texels around a point then says where its patch came from, and the exemplar's level is read at the
point itself, moved there. Inside a patch all four say the same.

Kernel: kernels_cl/common/address.clh          Test: tests/data/test_address.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.data.quilting_map import QuiltingMap


class Taps(NamedTuple):
    """The four texels of a bilinear look-up.

    Attributes:
        texel: (..., 4) number, row * width + column.
        weight: (..., 4) in [0, 1], sums to 1.
    """

    texel: Int[Tensor, "*batch 4"]
    weight: Float[Tensor, "*batch 4"]


def bilinear(uv: Float[Tensor, "*batch 2"], height: int, width: int, quilting: QuiltingMap | None = None) -> Taps:
    """Return the four texels around `uv` in a repeating height x width texture, or in one that is quilted from it.

    Order: (top left, top right, bottom left, bottom right). Differentiable in `uv` through the weights.
    """
    if quilting is not None:
        return _quilted(uv, height, width, quilting)
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
    return Taps(texel, _weights(fx, fy))


def of_level(uv: Float[Tensor, "n 2"], height: int, width: int, level: int, quilting: QuiltingMap | None) -> Taps:
    """Return the same in a level of a pyramid, `height` x `width`; sixteen texels in the coarse ones of a quilted one.

    Texels of a coarse level stop at the exemplar's border: what lies behind it belongs to no patch.
    """
    if quilting is None or level == 0:
        return bilinear(uv, height, width, quilting)
    found = _through_map(uv, height, width, quilting)
    step = torch.arange(2)
    y = found.row - 0.5 + (found.fy.unsqueeze(-1) - step)[..., :, None]
    x = found.column - 0.5 + (found.fx.unsqueeze(-1) - step)[..., None, :]
    taps = _held(y, x, height, width)
    weight = taps.weight * found.weight.unflatten(-1, (2, 2)).unsqueeze(-1)
    return Taps(taps.texel.flatten(-3), weight.flatten(-3))


def texel_centres(height: int, width: int, dtype: torch.dtype = torch.float32) -> Float[Tensor, "height width 2"]:
    """Return the texture coordinates of every texel centre, row 0 (v near 1) first."""
    u = (torch.arange(width, dtype=dtype) + 0.5) / width
    v = 1 - (torch.arange(height, dtype=dtype) + 0.5) / height
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1)


def _quilted(uv: Tensor, height: int, width: int, quilting: QuiltingMap) -> Taps:
    """Return the four texels of a quilted texture."""
    found = _through_map(uv, height, width, quilting)
    row, column = found.row.long().clamp(max=height - 1), found.column.long().clamp(max=width - 1)
    return Taps((row * width + column).flatten(-2), found.weight)


def _held(y: Tensor, x: Tensor, height: int, width: int) -> Taps:
    """Return the four texels around a place in rows and columns, held at the border."""
    top, left = y.detach().floor(), x.detach().floor()
    up, down = (k.long().clamp(0, height - 1) * width for k in (top, top + 1))
    west, east = (k.long().clamp(0, width - 1) for k in (left, left + 1))
    texel = torch.stack([up + west, up + east, down + west, down + east], -1)
    return Taps(texel, _weights(x - left, y - top))


def _weights(fx: Tensor, fy: Tensor) -> Float[Tensor, "*batch 4"]:
    return torch.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], -1)


class _Through(NamedTuple):
    """What a map says of the four texels around a point.

    Attributes:
        row: (..., 2, 2) places of their middles in the table, in rows from its top.
        column: (..., 2, 2) in columns.
        fx: (...) place of the point between their middles.
        fy: (...).
        weight: (..., 4).
    """

    row: Tensor
    column: Tensor
    fx: Tensor
    fy: Tensor
    weight: Tensor


def _through_map(uv: Tensor, height: int, width: int, quilting: QuiltingMap) -> _Through:
    """Look the four texels around `uv` up; `height` x `width` is a table over the exemplar, of any size."""
    uv = uv / uv.new_tensor(quilting.periods)
    uv = uv - uv.detach().floor()
    x = uv[..., 0] * (width * quilting.periods[0]) - 0.5
    y = (1 - uv[..., 1]) * (height * quilting.periods[1]) - 0.5
    left, top = x.detach().floor(), y.detach().floor()
    fx, fy = x - left, y - top
    (rows, columns), (map_rows, map_columns) = quilting.source, quilting.texels
    row, deep = _in_map(top, rows / height, map_rows)
    column, along = _in_map(left, columns / width, map_columns)
    texel = quilting.index.long()[row[..., :, None], column[..., None, :]]
    at_row = (texel // columns + deep[..., :, None]) * (height / rows)
    at_column = (texel % columns + along[..., None, :]) * (width / columns)
    return _Through(at_row, at_column, fx, fy, _weights(fx, fy))


def _in_map(first: Float[Tensor, "*batch"], step: float, size: int) -> tuple[Tensor, Tensor]:
    """Return row or column in the map, and the place in it, of the middles of a table's texels `first` and the next."""
    middle = (torch.stack([first, first + 1], -1) + 0.5) * step
    middle = torch.where(middle < 0, middle + size, torch.where(middle >= size, middle - size, middle))
    whole = middle.floor().clamp(0, size - 1)
    return whole.long(), (middle - whole).clamp(0, 1)  # outside where the map is smaller than a coarse table's texel
