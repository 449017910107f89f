"""Sets of directions on the hemisphere: rings of equal polar angle, and interpolation between them.

A set is a list of rings, each with its own number of evenly spaced azimuths. A table over a set is
interpolated linearly in azimuth within two neighbouring rings and linearly in theta between them: four taps,
C0 on the whole hemisphere, exact at the samples. A set whose first ring is not at the pole gets one more
*node*, the pole, whose value is the mean of the first ring; `with_pole` adds it to a table.

Beyond the last ring the ring's value is held; what a caller does there (000's tables end at 75 or 80 deg) is
the caller's rule, see `data.btf` and `data.mdf`.

Kernel: none (decoders in kernels_cl/data)          Test: tests/geometry/test_hemisphere.py
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.errors import ConfigError, check_range
from torchmeso.geometry.directions import from_angles, to_angles


@dataclass(frozen=True, slots=True, kw_only=True)
class DirectionSet:
    """Rings of directions, ordered ring by ring from the pole outwards, then by azimuth.

    Attributes:
        name: how configurations write it, e.g. "grid(12, 5, 80)".
        theta_deg: polar angle of each ring, increasing, in [0, 90).
        count: directions in each ring.
        phi0_deg: azimuth of each ring's first direction.
    """

    name: str
    theta_deg: tuple[float, ...]
    count: tuple[int, ...]
    phi0_deg: tuple[float, ...]

    def __post_init__(self) -> None:
        """Raise ConfigError unless the rings are well formed."""
        if not len(self.theta_deg) == len(self.count) == len(self.phi0_deg) > 0:
            raise ConfigError(f"{self.name}: expected as many counts and azimuths as rings, at least one ring")
        if any(b <= a for a, b in pairwise(self.theta_deg)) or min(self.count) < 1:
            raise ConfigError(f"{self.name}: expected rings of increasing theta with at least one direction each")
        check_range(f"{self.name}: theta", self.theta_deg[0], 0, 89.9)
        check_range(f"{self.name}: theta", self.theta_deg[-1], 0, 89.9)

    def __len__(self) -> int:
        return sum(self.count)

    @property
    def needs_pole(self) -> bool:
        """Whether a table over the set gets the pole as one more node."""
        return self.theta_deg[0] > 0

    @property
    def n_nodes(self) -> int:
        """Nodes of a table with its pole: the directions, then the pole where there is none among them."""
        return len(self) + self.needs_pole

    @property
    def last(self) -> float:
        """Polar angle of the last ring in radians."""
        return math.radians(self.theta_deg[-1])

    def directions(self, dtype: torch.dtype = torch.float32) -> Float[Tensor, "direction 3"]:
        """Return the (n, 3) unit directions in table order."""
        theta, phi = [], []
        for theta_deg, count, phi0_deg in zip(self.theta_deg, self.count, self.phi0_deg, strict=True):
            theta += [math.radians(theta_deg)] * count
            phi += [math.radians(phi0_deg + 360 * j / count) for j in range(count)]
        return from_angles(torch.tensor(theta, dtype=torch.float64), torch.tensor(phi, dtype=torch.float64)).to(dtype)


class Footprint(NamedTuple):
    """The four nodes around each direction.

    Attributes:
        node: (..., 4) in [0, n_nodes).
        weight: (..., 4) in [0, 1], sums to 1.
    """

    node: Int[Tensor, "*batch 4"]
    weight: Float[Tensor, "*batch 4"]


def grid(n_phi: int, n_theta: int, last_deg: float) -> DirectionSet:
    """Return n_theta rings of n_phi directions, theta_k = last (k + 0.5) / (n_theta - 0.5).

    The paper's 12 x 5 and 12 x 8 (wang2005mdf, Table 1) are grid(12, 5, 80) and grid(12, 8, 80).
    """
    check_range("grid: n_phi", n_phi, 1, 3600)
    check_range("grid: n_theta", n_theta, 1, 900)
    return DirectionSet(
        name=f"grid({n_phi}, {n_theta}, {last_deg:g})",
        theta_deg=tuple(last_deg * (k + 0.5) / (n_theta - 0.5) for k in range(n_theta)),
        count=(n_phi,) * n_theta,
        phi0_deg=(0.0,) * n_theta,
    )


def ubo81() -> DirectionSet:
    """Return the 81 directions of the UBO2003 materials."""
    return DirectionSet(
        name="ubo81", theta_deg=(0, 15, 30, 45, 60, 75), count=(1, 6, 12, 18, 20, 24), phi0_deg=(0.0,) * 6
    )


def ubo151() -> DirectionSet:
    """Return the 151 directions of the UBO2014 dome."""
    return DirectionSet(
        name="ubo151",
        theta_deg=(0, 11, 23.5, 30, 37.5, 45, 52.5, 60, 67.5, 75),
        count=(1, 6, 12, 12, 12, 18, 18, 24, 24, 24),
        phi0_deg=(0, 15, 0, 15, 0, 0, 7.5, 0, 7.5, 0),
    )


def from_rings(theta_deg: Sequence[float], count: Sequence[int], phi0_deg: Sequence[float]) -> DirectionSet:
    """Return the set of these rings under a name that `parse` reads: "rings(0: 1, 15: 6, 30: 12 @ 7.5)".

    A ring is written theta: count @ first azimuth, in degrees; the azimuth is left out where it is 0.
    """
    parts = [
        f"{theta:.10g}: {n}" + (f" @ {phi0:.10g}" if phi0 else "")
        for theta, n, phi0 in zip(theta_deg, count, phi0_deg, strict=True)
    ]
    return DirectionSet(
        name=f"rings({', '.join(parts)})", theta_deg=tuple(theta_deg), count=tuple(count), phi0_deg=tuple(phi0_deg)
    )


def parse(text: str) -> DirectionSet:
    """Return the set that `text` names: "grid(n_phi, n_theta, last_deg)", "rings(...)", "ubo81" or "ubo151".

    Raises:
        ConfigError: the text is none of these.
    """
    named = {"ubo81": ubo81, "ubo151": ubo151}
    if text.strip() in named:
        return named[text.strip()]()
    if text.strip().startswith("rings("):
        return _parse_rings(text.strip())
    found = re.fullmatch(r"\s*grid\(\s*(\d+)\s*,\s*(\d+)\s*,\s*([\d.]+)\s*\)\s*", text)
    if not found:
        raise ConfigError(f"directions: expected 'grid(n_phi, n_theta, last_deg)', 'ubo81' or 'ubo151', got '{text}'")
    return grid(int(found[1]), int(found[2]), float(found[3]))


def _parse_rings(text: str) -> DirectionSet:
    number = r"\d{1,6}(?:\.\d{1,15})?"
    found = [
        re.fullmatch(rf"\s*({number})\s*:\s*(\d{{1,4}})\s*(?:@\s*({number})\s*)?", part)
        for part in text.removeprefix("rings(").removesuffix(")").split(",")
    ]
    rings = [(float(m[1]), int(m[2]), float(m[3] or 0)) for m in found if m]
    if len(rings) < len(found) or not text.endswith(")"):
        raise ConfigError(f"directions: expected 'rings(theta: count @ phi, ...)' in degrees, got '{text}'")
    return from_rings(*zip(*rings, strict=True))


def with_pole(table: Tensor, directions: DirectionSet, *, dim: int = 0) -> Tensor:
    """Return `table` with the pole appended along `dim` where the set needs one: the mean of the first ring."""
    if not directions.needs_pole:
        return table
    ring = table.narrow(dim, 0, directions.count[0])
    mean = (ring if table.is_floating_point() else ring.double()).mean(dim, keepdim=True)
    return torch.cat([table, mean.to(table.dtype) if table.is_floating_point() else mean.round().to(table.dtype)], dim)


def interpolate(directions: DirectionSet, w: Float[Tensor, "*batch 3"]) -> Footprint:
    """Return the four nodes around each direction `w` and their weights.

    Args:
        directions: the set.
        w: (..., 3) direction, local frame; below the last ring, also below the horizon, the ring's value is held.

    Returns:
        nodes (ring k, phi j), (k, j + 1), (k + 1, j), (k + 1, j + 1). Differentiable in `w` but for the kinks at the
        nodes.
    """
    theta, phi = to_angles(w)
    table = rings(directions)
    ring_theta = table.theta.to(w.dtype)
    theta = theta.clamp(max=ring_theta[-1])
    n_ring = len(ring_theta)
    k = (torch.searchsorted(ring_theta, theta.detach().contiguous(), right=True) - 1).clamp(0, max(n_ring - 2, 0))
    above = (k + 1).clamp(max=n_ring - 1)
    span = (ring_theta[above] - ring_theta[k]).clamp(min=torch.finfo(w.dtype).tiny)
    outer = ((theta - ring_theta[k]) / span).clamp(0, 1)
    node, weight = [], []
    for ring, share in ((k, 1 - outer), (above, outer)):
        size = table.size[ring]
        x = (phi - table.phi0[ring].to(w.dtype)) * size.to(w.dtype) / (2 * math.pi)
        first = x.detach().floor()
        f = x - first
        j = first.long()
        node += [table.offset[ring] + j % size, table.offset[ring] + (j + 1) % size]
        weight += [share * (1 - f), share * f]
    return Footprint(torch.stack(node, -1), torch.stack(weight, -1))


def quadrature(directions: DirectionSet) -> Float[Tensor, "direction"]:
    """Return float64 weights a_l with sum_l a_l f(w_l) = the integral over the hemisphere of f as interpolated.

    f is what `interpolate` gives up to the last ring, and falls off with cos(theta) / cos(last) beyond it: the rule
    for light directions. The weights integrate that function exactly, in closed form.
    """
    theta = [math.radians(t) for t in directions.theta_deg]
    if directions.needs_pole:
        theta = [0.0, *theta]
    mass = [0.0] * len(theta)
    for k, (a, b) in enumerate(pairwise(theta)):
        whole = math.cos(a) - math.cos(b)  # integral of sin
        moment = (math.sin(b) - b * math.cos(b)) - (math.sin(a) - a * math.cos(a))  # integral of theta sin
        rising = (moment - a * whole) / (b - a)
        mass[k + 1] += rising
        mass[k] += whole - rising
    mass[-1] += math.cos(theta[-1]) / 2
    if directions.needs_pole:
        mass = [mass[0] + mass[1], *mass[2:]]  # the pole is the mean of the first ring
    count = directions.count
    weights = [2 * math.pi * m / n for m, n in zip(mass, count, strict=True) for _ in range(n)]
    return torch.tensor(weights, dtype=torch.float64)


def solid_angles(directions: DirectionSet) -> Float[Tensor, "direction"]:
    """Return float64 solid angles that share out the hemisphere, 2 pi in all.

    A ring reaches half-way to its neighbours, the first one to the pole and the last one to the horizon.
    """
    theta = [math.radians(t) for t in directions.theta_deg]
    edge = [1.0, *(math.cos((a + b) / 2) for a, b in pairwise(theta)), 0.0]
    shares = [
        2 * math.pi * (upper - lower) / n for (upper, lower), n in zip(pairwise(edge), directions.count, strict=True)
    ]
    each = [share for share, n in zip(shares, directions.count, strict=True) for _ in range(n)]
    return torch.tensor(each, dtype=torch.float64)


class Rings(NamedTuple):
    """The rings of a set as arrays, the pole among them where the set needs one."""

    theta: Tensor  # (ring) radians, the pole first
    size: Tensor  # (ring) directions in the ring
    phi0: Tensor  # (ring) radians
    offset: Tensor  # (ring) node of the ring's first direction


@lru_cache(maxsize=64)
def rings(directions: DirectionSet) -> Rings:
    """Return the rings of `directions` as arrays."""
    theta, count, phi0 = list(directions.theta_deg), list(directions.count), list(directions.phi0_deg)
    offset = [0, *accumulate(count)][:-1]
    if directions.needs_pole:
        theta, count, phi0, offset = [0.0, *theta], [1, *count], [0.0, *phi0], [len(directions), *offset]
    return Rings(
        torch.tensor(theta, dtype=torch.float64).deg2rad(),
        torch.tensor(count),
        torch.tensor(phi0, dtype=torch.float64).deg2rad(),
        torch.tensor(offset),
    )
