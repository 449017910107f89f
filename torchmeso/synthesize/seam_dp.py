"""Seams by dynamic programming: where a patch takes over from what is there already.

kawasaki2005quilting, eq. (4) and (5): over the overlap the squared differences e of both sides are summed along paths
that go one step at a time, straight or to either side,

    E(k, l) = e(k, l) + min(E(k-1, l-1), E(k-1, l), E(k-1, l+1)),

and the cheapest path is the seam. Here `e` holds one number per texel, summed over all views: one border for all.

An overlap on the left has a seam from top to bottom, one above a seam from side to side. Where both meet in an L the
seam is one path too: up from the bottom, straight or to either side, to a texel of the corner's diagonal, and from
there to the right; no other such path is cheaper. Costs are whole numbers, and of equal paths the one farthest to the
left or the top is taken, so both backends and any number of threads give the same seam.

Kernel: kernels_cl/synthesize/seam_dp.cl          Test: tests/synthesize/test_seam_dp.py
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchmeso.backends import BackendChoice, opencl
from torchmeso.errors import ConfigError, ShapeError, check_shape

FAR = 1 << 60
"""Cost of a path that leaves the overlap; costs of seams stay below it."""


class Seam(NamedTuple):
    """Seams of a batch of patches: a patch shows where column <= x and row <= y.

    Attributes:
        column: (B, H) first column of the patch that shows in each row, as the seam on the left says.
        row: (B, W) first row that shows in each column, as the seam above says.
        cost: (B,) sum of e along the path.
    """

    column: Int[Tensor, "B H"]
    row: Int[Tensor, "B W"]
    cost: Int[Tensor, "B"]


def cut(e: Int[Tensor, "B H W"], *, left: int = 0, top: int = 0, backend: BackendChoice = "torch") -> Seam:
    """Return the cheapest seams of patches that overlap others on the left, above, or both.

    Args:
        e: squared differences in the overlap, not negative, int64; their sums stay below 2^60.
        left: columns of the overlap on the left, 0 = none.
        top: rows of the overlap above, 0 = none.
        backend: both give the same seams.

    Raises:
        ShapeError: `e` is no batch of whole numbers.
        ConfigError: an overlap is wider than the patch, or there is none.
    """
    check_shape("e", e, (-1, -1, -1))
    if e.dtype != torch.int64:
        raise ShapeError(f"e: expected whole numbers (int64), got {e.dtype}")
    if not (0 <= left <= e.shape[2] and 0 <= top <= e.shape[1] and left + top > 0):
        raise ConfigError(f"seam: expected an overlap within {e.shape[2]} x {e.shape[1]} texels, got {left} and {top}")
    run = _cut_opencl if opencl.resolve(backend) == "opencl" and len(e) else _cut_torch
    return run(e, left, top)


def shown(
    e: Int[Tensor, "H W"], *, left: int = 0, top: int = 0, right: int = 0, bottom: int = 0,
    backend: BackendChoice = "torch",
) -> Bool[Tensor, "H W"]:  # fmt: skip
    """Return which texels show a patch that overlaps others on any of its sides; arguments as for `cut`.

    Patches that close a ring, of a texture that tiles, overlap on the right and below too. Seams of opposite sides
    do not meet, as long as no overlap is wider than half a patch; at corners a texel has to be inside of both.
    """
    found = torch.ones_like(e, dtype=torch.bool)
    for side, flip in (((left, top), ()), ((right, bottom), (0, 1))):
        if any(side):
            seam = cut(e.flip(flip)[None], left=side[0], top=side[1], backend=backend)
            found &= _inside(seam, *e.shape)[0].flip(flip)
    return found


def _inside(seam: Seam, height: int, width: int) -> Bool[Tensor, "B H W"]:
    """Return which texels show the patches."""
    y, x = torch.arange(height)[:, None], torch.arange(width)
    return (x >= seam.column[:, :, None]) & (y >= seam.row[:, None, :])


def _cut_torch(e: Tensor, left: int, top: int) -> Seam:
    _, height, width = e.shape
    column, row = e.new_zeros(len(e), height), e.new_zeros(len(e), width)
    down = _cumulate(e[:, :, :left].flip(1)).flip(1) if left else e  # from the bottom
    across = _cumulate(e[:, :top].mT.flip(1)).flip(1) if top else e  # (B, W, top), from the right
    if not top or not left:
        E, path = (down, column) if left else (across, row)
        end = _first_least(E[:, 0])
        _trace(E, end, torch.zeros_like(end), path)
        return Seam(column, row, E[:, 0].amin(1))
    knee = torch.arange(min(left, top))
    whole = down[:, knee, knee] + across[:, knee, knee] - e[:, knee, knee]
    k = _first_least(whole)
    for E, path in ((down, column), (across, row)):
        _trace(E, k, k, path)
    return Seam(column, row, whole.amin(1))


def _cumulate(e: Int[Tensor, "B n across"]) -> Int[Tensor, "B n across"]:
    """Return E of eq. (5), from the first step on."""
    rows = [e[:, 0]]
    for k in range(1, e.shape[1]):
        rows.append(e[:, k] + _three(rows[-1]).amin(-1))
    return torch.stack(rows, 1)


def _three(E: Int[Tensor, "B across"]) -> Int[Tensor, "B across 3"]:
    """Return the costs of the three neighbours in the step before: left, middle, right."""
    return torch.nn.functional.pad(E, (1, 1), value=FAR).unfold(1, 3, 1)


def _first_least(x: Int[Tensor, "B n"]) -> Int[Tensor, "B"]:
    """Return the first place of the least value."""
    place = torch.arange(x.shape[1])
    return torch.where(x == x.amin(1, keepdim=True), place, x.shape[1]).amin(1)


def _trace(E: Int[Tensor, "B n across"], at: Tensor, first: Tensor, path: Int[Tensor, "B n"]) -> None:
    """Write the path from step `first` at place `at` onwards into `path`; steps before it get `at` too."""
    n, batch = E.shape[1], torch.arange(len(E))
    for k in range(n):
        if k:
            near = _three(E[:, k])[batch, at]
            at = torch.where(k > first, at + _first_least(near) - 1, at)
        path[:, k] = at


def _cut_opencl(e: Tensor, left: int, top: int) -> Seam:
    batch, height, width = e.shape
    column = torch.zeros(batch, height, dtype=torch.int32)
    row, cost = torch.zeros(batch, width, dtype=torch.int32), torch.zeros(batch, dtype=torch.int64)
    e = opencl.aligned(e)
    scratch = torch.empty(batch, height * left + width * top, dtype=torch.int64)
    column, row, cost, scratch = (opencl.aligned(x) for x in (column, row, cost, scratch))
    buffers = [opencl.buffer(x) for x in (e, scratch, column, row, cost)]
    sizes = [np.int32(n) for n in (height, width, left, top)]
    opencl.kernel("synthesize/seam_dp.cl", "cut")(opencl.queue(), (batch,), (1,), *sizes, *buffers)
    opencl.read(list(zip(buffers[2:], (column, row, cost), strict=True)))
    return Seam(column.long(), row.long(), cost)
