"""Rays at tiles, and what they meet in closed form."""

import math

import torch

from torchmeso.geometry.directions import from_angles

N = 4000


def looks(rng, last_deg=80.0, n=N):
    theta = torch.rand(n, generator=rng, dtype=torch.float64) * math.radians(last_deg)
    phi = torch.rand(n, generator=rng, dtype=torch.float64) * 2 * math.pi
    return torch.rand(n, 2, generator=rng, dtype=torch.float64) * 4 - 2, from_angles(theta, phi)


def straight_down(rng, n=N):
    wo = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(n, 3)
    return torch.rand(n, 2, generator=rng, dtype=torch.float64), wo


def in_first_tile(uv):
    """Points on the reference plane, brought into [0, 1]^2."""
    return torch.cat([uv % 1, torch.zeros(len(uv), 1, dtype=uv.dtype)], 1)


def box_distance(uv, wo, boxes):
    """Rays against boxes (low u, v, z, high u, v, z) and their copies in the tiles around; inf where none is met."""
    p, best = in_first_tile(uv), torch.full((len(uv),), torch.inf, dtype=uv.dtype)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            shift = torch.tensor([i, j, 0.0], dtype=uv.dtype)
            for box in boxes:
                low, high = torch.tensor(box, dtype=uv.dtype).reshape(2, 3) + shift
                a, b = (low - p) / -wo, (high - p) / -wo
                near, far = torch.minimum(a, b).amax(-1).clamp(min=0), torch.maximum(a, b).amin(-1)
                best = torch.where(near <= far, torch.minimum(best, near), best)
    return best


def wrong(D, expected, tolerance):
    """Share of distances off by more than `tolerance`, or finite where the other is not."""
    return float(((expected != D) & ~((D - expected).abs() <= tolerance)).double().mean())
