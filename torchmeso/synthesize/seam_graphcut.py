"""Cuts of least cost through overlaps of any shape: which texels keep what lies there, and which show a patch.

kwatra2003graphcut: where neighbours p and q show different sides, A and B, the cut costs

    M(p, q) = e(p) + e(q),      e = ||A - B|| at a texel.

Some texels are held to one side: what must stay (locked by hand, or beside what lies outside of the patch), and what
nothing lies on yet. Old seams are kept per texel (leung2007tileable, section 3.2, step 2): a texel that stays costs the
error it was left with, so a patch may cover an old seam where that pays.

Costs are whole numbers, and of all cuts of least cost the one is taken that keeps least of what lies there: that set is
the same whatever way it is found, so both backends and any number of threads give the same cut.

Where both sides reach the border of the patch, each in one piece, and no old seam counts, the cut is a shortest path
along the sides of texels from one gap between them to the other. Clipped at that distance, distances are a
flow of the same value, and what has capacity left from the old side is the least set. Else it is found by
boykov2004experimental's two trees. In torch SciPy's maximum flow takes the place of both.

Kernel: kernels_cl/synthesize/seam_graphcut.cl          Test: tests/synthesize/test_seam_graphcut.py
"""

from functools import lru_cache
from typing import NamedTuple, cast

import numpy as np
import torch
from jaxtyping import Bool, Int
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from torch import Tensor

from torchmeso.backends import BackendChoice, opencl
from torchmeso.errors import ShapeError, check_shape

FREE, OLD, NEW, ABSENT = range(4)
"""What a texel is held to: nothing, what lies there, the patch; or it is not there, and joins nothing."""

STEPS = 256
"""Costs of a cut per step of codes: what rounding e to whole numbers leaves."""

MOST = (1 << 23) - 1
"""Of e; sums along paths of a million texels stay below 2^44."""

MOST_ERROR = (1 << 30) - 1
"""Of an old error."""

CORNERS = 1 << 20
"""Most corners of an overlap's texels."""


class Cut(NamedTuple):
    """Cuts of a batch.

    Attributes:
        old: (B, H, W) whether a texel keeps what lies there; absent ones do not.
        cost: (B,) of the cut, old errors that stay included.
    """

    old: Bool[Tensor, "B H W"]
    cost: Int[Tensor, "B"]


def differences(a: Int[Tensor, "*#batch C"], b: Int[Tensor, "*#batch C"]) -> Int[Tensor, "*pair"]:
    """Return e of two sides, in 1 / `STEPS` of a step of their codes."""
    return (STEPS * (a - b).square().sum(-1).double().sqrt()).round().long().clamp(max=MOST)


def cut(
    e: Int[Tensor, "B H W"],
    side: Int[Tensor, "H W"],
    *,
    errors: Int[Tensor, "H W"] | None = None,
    backend: BackendChoice = "torch",
) -> Cut:
    """Return the cuts of least cost of a batch of patches over one overlap.

    Args:
        e: how both sides differ at each texel, int64 from 0 to `MOST`.
        side: what each texel is held to: `FREE`, `OLD`, `NEW` or `ABSENT`.
        errors: what it costs a free texel to stay, int64 from 0 to `MOST_ERROR`; None = nothing.
        backend: both give the same cuts.

    Raises:
        ShapeError: shapes do not fit, there are too many texels, or values are out of range.
    """
    check_shape("e", e, (-1, -1, -1))
    height, width = e.shape[1:]
    check_shape("side", side, (height, width))
    if min(height, width) < 1 or (height + 1) * (width + 1) > CORNERS:
        raise ShapeError(f"e: expected 1 to about {CORNERS} texels, got {width} x {height}")
    errors = torch.zeros_like(side, dtype=torch.int64) if errors is None else errors
    check_shape("errors", errors, (height, width))
    for name, x, most in (("e", e, MOST), ("side", side, ABSENT), ("errors", errors, MOST_ERROR)):
        _check_whole(name, x, most)
    run = _cut_opencl if opencl.resolve(backend) == "opencl" and len(e) else _cut_torch
    return run(e, side, errors)


def _check_whole(name: str, x: Tensor, most: int) -> None:
    if x.dtype.is_floating_point:
        raise ShapeError(f"{name}: expected whole numbers, got {x.dtype}")
    low, high = (int(end) for end in x.aminmax()) if x.numel() else (0, 0)
    if low < 0 or high > most:
        raise ShapeError(f"{name}: expected numbers from 0 to {most}, got {low} to {high}")


def gaps(side: Int[Tensor, "H W"]) -> tuple[int, int] | None:
    """Return the corners of texels that a cut runs between, or None where it is no single path.

    Corners are numbered row by row, (H + 1) x (W + 1) of them. The first follows what is old, going clockwise around
    the border. Both sides have to reach the border, all pieces of each, and there one after the other.
    """
    held = side.to(torch.uint8).contiguous().numpy()
    return _gaps(held.tobytes(), *held.shape)


@lru_cache(maxsize=256)
def _gaps(held_bytes: bytes, height: int, width: int) -> tuple[int, int] | None:
    """Return the same; overlaps of a grid of patches come again and again, and looking costs more than a small cut."""
    held = np.frombuffer(held_bytes, np.uint8).reshape(height, width)
    border = np.concatenate([held[0], held[:, -1], held[-1, ::-1], held[::-1, 0]])
    terminal = np.flatnonzero((border == OLD) | (border == NEW))
    before, after = border[terminal], np.roll(border[terminal], -1)
    changes = np.flatnonzero(before != after)
    if len(changes) != 2:
        return None
    for kind in (OLD, NEW):
        pieces, count = cast(tuple[np.ndarray, int], ndimage.label(held == kind))
        edge = np.concatenate([pieces[0], pieces[-1], pieces[:, 0], pieces[:, -1]])
        if len(np.unique(edge[edge > 0])) < count:
            return None
    y = np.concatenate([np.zeros(width), np.arange(height), np.full(width, height), np.arange(height, 0, -1)])
    x = np.concatenate([np.arange(width), np.full(height, width), np.arange(width, 0, -1), np.zeros(height)])
    corner = (y * (width + 1) + x).astype(int)  # before each side of the border
    first, second = corner[(terminal[changes] + 1) % len(border)].tolist()
    return (first, second) if before[changes[0]] == OLD else (second, first)


def _cut_torch(e: Tensor, side: Tensor, errors: Tensor) -> Cut:
    found = [_cut_scipy(each, side.numpy(), errors.numpy()) for each in e.numpy()]
    old = np.stack([x for x, _ in found]) if found else np.zeros(e.shape, bool)
    return Cut(torch.from_numpy(old), torch.tensor([cost for _, cost in found], dtype=torch.int64))


def _cut_scipy(e: np.ndarray, side: np.ndarray, errors: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the cut of one patch. Texels that are held are their terminal, so that nothing is without bound."""
    source, sink = e.size, e.size + 1
    node = np.where(side == OLD, source, np.where(side == NEW, sink, np.arange(e.size).reshape(e.shape)))
    there, M = side != ABSENT, lambda one, other: e[one] + e[other]
    tails, heads, rooms = [], [], []
    for one, other in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1], np.s_[1:]),
    ):
        joined = (there[one] & there[other]) & (node[one] != node[other])
        for a, b in ((one, other), (other, one)):
            tails.append(node[a][joined])
            heads.append(node[b][joined])
            rooms.append(M(a, b)[joined])
    stays = (side == FREE) & (errors > 0)
    tails.append(node[stays])
    heads.append(np.full(int(stays.sum()), sink))
    rooms.append(errors[stays])
    tail, head, room = (np.concatenate(x) for x in (tails, heads, rooms))
    direct = (tail == source) & (head == sink)  # the sides meet: paid in any case, and more than 32 bits together
    paid, kept = int(room[direct].sum()), ~direct & (tail != sink) & (head != source)
    shape = (e.size + 2, e.size + 2)
    capacity = sparse.csr_array((room[kept].astype(np.int32), (tail[kept], head[kept])), shape=shape)
    flow = csgraph.maximum_flow(capacity, source, sink)
    left = (capacity - flow.flow).tocsr()
    left.data = np.maximum(left.data, 0)
    left.eliminate_zeros()
    reached = np.zeros(e.size + 2, bool)
    reached[csgraph.breadth_first_order(left, source, return_predecessors=False)] = True
    return reached[node] & there, paid + int(flow.flow_value)


def _cut_opencl(e: Tensor, side: Tensor, errors: Tensor) -> Cut:
    batch, height, width = e.shape
    texels = (height + 2) * (width + 2)
    held, cost = _bordered(side, ABSENT, torch.uint8), _bordered(e, 0, torch.int32)
    old = opencl.aligned(torch.empty(batch, height + 2, width + 2, dtype=torch.uint8))
    value = opencl.aligned(torch.empty(batch, dtype=torch.int64))
    sizes, ends = [np.int32(height), np.int32(width)], None if bool(errors.any()) else gaps(side)
    if ends is not None:
        # Corners have the number of the texel up and left of them in the bordered grid; buckets are half a step wide.
        sizes += [np.int32(k // (width + 1) * (width + 2) + k % (width + 1)) for k in ends]
        sizes.append(np.int32(max(int(e.double().mean()).bit_length() - 1, 0)))
        scratch = [torch.empty(batch, texels, dtype=torch.int64), torch.empty(batch, 5 * texels, dtype=torch.int32)]
        parts = [held, cost, *scratch, old, value]
        name = "planar"
    else:
        scratch = [
            torch.empty(batch, n * texels, dtype=kind)
            for n, kind in ((1, torch.int64), (8, torch.int32), (2, torch.uint8))
        ]
        parts = [held, _bordered(errors, 0, torch.int32), cost, *scratch, old, value]
        name = "flow"
    parts = [opencl.aligned(x) for x in parts]
    buffers = [opencl.buffer(x) for x in parts]
    opencl.kernel("synthesize/seam_graphcut.cl", name)(opencl.queue(), (batch,), (1,), *sizes, *buffers)
    opencl.read(list(zip(buffers[-2:], parts[-2:], strict=True)))
    return Cut(parts[-2][:, 1:-1, 1:-1].bool(), parts[-1])


def _bordered(x: Tensor, value: int, dtype: torch.dtype) -> Tensor:
    """Return a picture, or a batch of them, with a border of one texel."""
    return torch.nn.functional.pad(x.to(dtype), (1, 1, 1, 1), value=value).contiguous()
