"""Directions over the whole sphere: rings of equal azimuths between two poles, and interpolation between them.

The directions of wang2004gdm, section 5: "16 x 32 viewing directions at equal intervals in phi and theta". Tables over
them get a row for each pole, the mean of the ring beside it, so that interpolation is continuous everywhere.

Test: tests/geometry/test_sphere.py
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import check_range
from torchmeso.geometry.directions import from_angles
from torchmeso.geometry.hemisphere import Footprint


@dataclass(frozen=True, slots=True, kw_only=True)
class SphereGrid:
    """Rings theta_k = pi (k + 0.5) / n_theta of azimuths phi_j = 2 pi j / n_phi.

    Attributes:
        n_theta: rings.
        n_phi: directions of a ring.
    """

    n_theta: int
    n_phi: int

    def __post_init__(self) -> None:
        """Raise ConfigError for a set that covers nothing or no memory holds."""
        check_range("sphere grid: n_theta", self.n_theta, 2, 512)
        check_range("sphere grid: n_phi", self.n_phi, 3, 1024)

    def directions(self, dtype: torch.dtype = torch.float32) -> Float[Tensor, "theta phi 3"]:
        """Return the unit directions, ring by ring from +z on."""
        theta = math.pi * (torch.arange(self.n_theta, dtype=torch.float64) + 0.5) / self.n_theta
        phi = 2 * math.pi * torch.arange(self.n_phi, dtype=torch.float64) / self.n_phi
        grid_theta, grid_phi = torch.meshgrid(theta, phi, indexing="ij")
        return from_angles(grid_theta, grid_phi).to(dtype)

    def interpolate(self, w: Float[Tensor, "*batch 3"]) -> Footprint:
        """Return the four directions around each unit `w`: rows of a table `with_poles`, row * n_phi + azimuth.

        Weights sum to 1 and are differentiable in `w`.
        """
        theta = torch.atan2(torch.linalg.vector_norm(w[..., :2], dim=-1), w[..., 2])
        upright = (w[..., 0] == 0) & (w[..., 1] == 0)
        phi = torch.atan2(torch.where(upright, 0, w[..., 1]), torch.where(upright, 1, w[..., 0]))
        # Rows: the pole at 0, rings at 0.5, 1.5, ..., n_theta - 0.5 steps, the other pole at n_theta.
        x = theta * (self.n_theta / math.pi)
        ring = (x.detach() + 0.5).floor().long().clamp(0, self.n_theta)
        start = (ring - 0.5).clamp(min=0)
        width = torch.where((ring == 0) | (ring == self.n_theta), 0.5, 1.0).to(x.dtype)
        outer = ((x - start) / width).clamp(0, 1)
        y = phi * (self.n_phi / (2 * math.pi))
        first = y.detach().floor()
        part = y - first
        column = first.long() % self.n_phi
        following = (column + 1) % self.n_phi
        top, bottom = ring * self.n_phi, (ring + 1) * self.n_phi
        node = torch.stack([top + column, top + following, bottom + column, bottom + following], -1)
        weight = [(1 - outer) * (1 - part), (1 - outer) * part, outer * (1 - part), outer * part]
        return Footprint(node, torch.stack(weight, -1))


def with_poles(table: Float[Tensor, "*batch theta phi"]) -> Float[Tensor, "*batch rows phi"]:
    """Return a table over a `SphereGrid` with a row for each pole: the mean of the ring beside it."""
    top, bottom = (
        table[..., k : k + 1, :].mean(-1, keepdim=True).expand_as(table[..., :1, :]) for k in (0, table.shape[-2] - 1)
    )
    return torch.cat([top, table, bottom], -2)
