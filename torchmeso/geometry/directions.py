"""Unit directions and their two angles.

A direction without a suffix is in the local frame (t, b, n) and points away from the surface; theta is the
angle from +z (n), phi the angle from +x (t) towards +y (b), both in radians.

Test: tests/geometry/test_directions.py
"""

import torch
from jaxtyping import Float
from torch import Tensor


def from_angles(theta: Float[Tensor, "*batch"], phi: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3"]:
    """Return the unit direction with polar angle `theta` and azimuth `phi`, in radians."""
    return torch.stack([theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos()], -1)


def to_angles(w: Float[Tensor, "*batch 3"]) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Return theta in [0, pi] and phi in (-pi, pi] of `w`, which need not have unit length.

    The gradient stays finite at the pole, where phi is 0 and has none: acos and atan2 would give NaN.
    """
    x, y, z = w.unbind(-1)
    on_axis = (x == 0) & (y == 0)
    x = torch.where(on_axis, torch.finfo(w.dtype).tiny ** 0.5, x)
    return torch.atan2(torch.hypot(x, y), z), torch.atan2(y, x)


def normalize(v: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
    """Return `v` with unit length; a zero vector stays zero."""
    return torch.nn.functional.normalize(v, dim=-1, eps=torch.finfo(v.dtype).tiny ** 0.5)


def dot(a: Float[Tensor, "*#batch 3"], b: Float[Tensor, "*#batch 3"]) -> Float[Tensor, "*#batch"]:
    """Return the scalar product of `a` and `b`."""
    return (a * b).sum(-1)
