"""Tangent frames (t, b, n): t along +u, b along +v, z = n.

Where the texture coordinates are mirrored the frame is left-handed (sign -1), so local directions are dot
products, never a rotation.

Test: tests/geometry/test_frames.py
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.geometry.directions import dot, normalize


class Frame(NamedTuple):
    """An orthonormal frame in world space; t, b, n are (..., 3)."""

    t: Float[Tensor, "*batch 3"]
    b: Float[Tensor, "*batch 3"]
    n: Float[Tensor, "*batch 3"]


def orthonormal(n: Float[Tensor, "*batch 3"], t: Float[Tensor, "*batch 3"], sign: Float[Tensor, "*batch"]) -> Frame:
    """Return the frame with normal along `n`, `t` made perpendicular to it, and b = sign (n x t).

    Where `t` is zero or parallel to `n` (degenerate texture coordinates) any perpendicular direction is taken.
    """
    n = normalize(n)
    flat = t - dot(n, t).unsqueeze(-1) * n
    degenerate = dot(flat, flat) <= 1e-12 * dot(t, t).clamp(min=torch.finfo(t.dtype).tiny)
    t = normalize(torch.where(degenerate.unsqueeze(-1), _any_perpendicular(n), flat))
    return Frame(t, sign.unsqueeze(-1) * torch.linalg.cross(n, t), n)


def to_local(frame: Frame, w_world: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Return `w_world` in the frame's coordinates."""
    return torch.stack([dot(w_world, frame.t), dot(w_world, frame.b), dot(w_world, frame.n)], -1)


def to_world(frame: Frame, w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Return the local direction `w` in world space: the inverse of `to_local`."""
    x, y, z = w.unsqueeze(-1).unbind(-2)
    return x * frame.t + y * frame.b + z * frame.n


def around(n: Float[Tensor, "*batch 3"]) -> Frame:
    """Return some right-handed frame around the unit normal `n`."""
    return orthonormal(n, _any_perpendicular(n), torch.ones_like(n[..., 0]))


def _any_perpendicular(n: Tensor) -> Tensor:
    """Return n x the axis that `n` leans on least: never zero for a unit `n`."""
    axis = torch.nn.functional.one_hot(n.abs().argmin(-1), 3).to(n.dtype)
    return torch.linalg.cross(n, axis)
