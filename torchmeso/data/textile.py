"""Textiles: yarns as paths through nodes with a cross-section, swept into rings of points.

A path goes through its nodes with knots at their distances (lin2012automated):

    linear   straight from node to node
    cubic    a spline with continuous curvature; periodic, or natural at its ends
    bezier   cubic pieces; a third of the distance along each node's tangent, where it has none along the chord
             between its neighbours

A section stands across the path: y along the node's `up` made perpendicular to the tangent, x to the right of who
walks along the yarn. Lengths are in the file's units.

Test: tests/data/test_textile.py
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from torch import Tensor

from torchmeso.data.yarn_section import Section
from torchmeso.errors import FormatError, check_shape
from torchmeso.geometry.directions import normalize

FAR = 1e6
"""Nodes lie this near to the origin in the file's units."""

MOST_RINGS = 1 << 16
"""Rings of one yarn."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Yarn:
    """A yarn.

    Attributes:
        nodes: (node, 3) places that the path goes through, at least two, float64.
        tangents: (node, 3) directions of a Bezier path; zero where they follow from the neighbours.
        ups: (node, 3) directions across the path.
        path: how it goes from node to node.
        periodic: whether the last node continues like the first; their difference is the period.
        sections: one for the whole yarn, or several.
        places: shares of the length, rising, where several sections hold; None = one at each node.
        ramped: whether sections go over into each other evenly; otherwise slowly at first and last.
        repeats: (repeat, 3) translations under which the textile holds the yarn again.
    """

    nodes: Float[Tensor, "node 3"]
    tangents: Float[Tensor, "node 3"]
    ups: Float[Tensor, "node 3"]
    path: Literal["linear", "cubic", "bezier"] = "cubic"
    periodic: bool = True
    sections: tuple[Section, ...]
    places: tuple[float, ...] | None = None
    ramped: bool = True
    repeats: Float[Tensor, "repeat 3"]

    def __post_init__(self) -> None:
        """Raise ShapeError or FormatError unless the parts make a yarn."""
        count = len(self.nodes)
        for name in ("nodes", "tangents", "ups"):
            check_shape(f"yarn.{name}", getattr(self, name), (count, 3))
            if not bool((getattr(self, name).abs() <= FAR).all()):  # not so for nan either
                raise FormatError(f"yarn: expected finite {name} within {FAR:g} of the origin")
        check_shape("yarn.repeats", self.repeats, (-1, 3))
        if count < 2 or float(self.nodes.diff(dim=0).norm(dim=-1).min()) < 1e-9:
            raise FormatError(f"yarn: expected at least two nodes, no two in a row at one place, got {count}")
        wanted = count if self.places is None else len(self.places)
        if len(self.sections) not in (1, wanted) or not self.sections:
            what = "node" if self.places is None else "place"
            raise FormatError(f"yarn: expected 1 section or one for each {what} ({wanted}), got {len(self.sections)}")
        places = self.places or (0.0,)
        if not all(a < b for a, b in pairwise(places)) or not 0 <= places[0] <= places[-1] <= 1:
            raise FormatError("yarn: expected rising places of sections from 0 to 1")

    @property
    def way(self) -> Float[Tensor, "3"]:
        """From the first node to the last."""
        return self.nodes[-1] - self.nodes[0]

    def count(self, step: float) -> int:
        """Return the number of rings at a distance of `step`.

        Raises:
            FormatError: the yarn is too long for `step`.
        """
        return int(self._pieces(step).sum()) + 1

    def rings(self, step: float, segments: int) -> Float[Tensor, "ring {segments} 3"]:
        """Return the outlines along the yarn, from its first node to its last, each closed.

        Args:
            step: distance of rings along the chord between nodes, at most; every node has a ring.
            segments: points of an outline, counter-clockwise seen against the tangent.

        Raises:
            FormatError: the yarn is too long for `step`, or an `up` lies along the path.
        """
        knots, pieces = self._knots(), self._pieces(step)
        at = [np.linspace(a, b, int(n), endpoint=False) for a, b, n in zip(knots, knots[1:], pieces, strict=False)]
        u = np.append(np.concatenate(at), knots[-1])
        point, tangent = (torch.from_numpy(x) for x in self._trace(knots, u))
        up = torch.from_numpy(np.stack([np.interp(u, knots, x) for x in self.ups.numpy().T], -1))
        tangent = normalize(tangent)
        across = torch.linalg.cross(tangent, up)
        if float((across.norm(dim=-1) - 1e-6 * up.norm(dim=-1)).min()) <= 0:
            raise FormatError("yarn: expected an up across the path at every place, got one along it, or a cusp")
        right = normalize(across)
        up = torch.linalg.cross(right, tangent)
        outline = self._outlines(knots, u, point, segments)
        return point[:, None] + outline[..., :1] * right[:, None] + outline[..., 1:] * up[:, None]

    def _pieces(self, step: float) -> np.ndarray:
        """Return how many pieces the path has from each node to the next."""
        pieces = np.ceil(np.diff(self._knots()) / step).clip(2)
        if not pieces.sum() <= MOST_RINGS:
            raise FormatError(f"yarn: expected at most {MOST_RINGS} rings, got {pieces.sum():.4g}; it is too long")
        return pieces

    def _knots(self) -> np.ndarray:
        return np.append(0.0, self.nodes.double().diff(dim=0).norm(dim=-1).cumsum(0).numpy())

    def _trace(self, knots: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return places and derivatives of the path."""
        nodes = self.nodes.double()
        if self.path == "linear":
            point = np.stack([np.interp(u, knots, x) for x in nodes.numpy().T], -1)
            # A section at a node stands between both pieces; elsewhere across its own.
            slopes = (nodes.diff(dim=0) / torch.from_numpy(np.diff(knots))[:, None]).numpy()
            before, behind = (np.searchsorted(knots, u, side) - 1 for side in ("left", "right"))
            if self.periodic:
                before, behind = before % len(slopes), behind % len(slopes)
            last = len(slopes) - 1
            return point, slopes[before.clip(0, last)] + slopes[behind.clip(0, last)]
        if self.path == "bezier":
            curve = CubicHermiteSpline(knots, nodes.numpy(), self._slopes().numpy())
        else:
            # A periodic path comes back to its start once the way is taken off.
            slant = (self.way / knots[-1]).numpy()
            flat = nodes.numpy() - knots[:, None] * slant
            if self.periodic:
                flat[-1] = flat[0]
            found = CubicSpline(knots, flat, bc_type="periodic" if self.periodic else "natural")
            return found(u) + u[:, None] * slant, found(u, 1) + slant
        return curve(u), curve(u, 1)

    def _slopes(self) -> Float[Tensor, "node 3"]:
        """Return the unit tangents of a Bezier path: control points lie a third of the distance along them."""
        before, behind = self.nodes.roll(1, 0), self.nodes.roll(-1, 0)
        before[0], behind[-1] = self.nodes[0], self.nodes[-1]
        if self.periodic:
            before[0], behind[-1] = self.nodes[-2] - self.way, self.nodes[1] + self.way
        given = self.tangents.norm(dim=-1, keepdim=True) > 0
        return normalize(torch.where(given, self.tangents, behind - before).double())

    def _outlines(self, knots: np.ndarray, u: np.ndarray, point: Tensor, segments: int) -> Float[Tensor, "ring n 2"]:
        v = torch.arange(segments, dtype=torch.float64) / segments
        known = torch.stack([section.outline(v) for section in self.sections])
        if len(known) == 1:
            return known.expand(len(u), -1, -1)
        if self.places is None:
            at, places = u, knots
        else:
            length = point.diff(dim=0).norm(dim=-1).cumsum(0).numpy()
            at, places = np.append(0.0, length) / length[-1], np.array(self.places)
            if self.periodic:  # sections go over the end to the first one
                known = torch.cat([known[-1:], known, known[:1]])
                places = np.concatenate([places[-1:] - 1, places, places[:1] + 1])
        behind = np.searchsorted(places, at, "right").clip(1, len(places) - 1)
        share = ((at - places[behind - 1]) / np.diff(places)[behind - 1]).clip(0, 1)
        if not self.ramped:
            share = share**2 * (3 - 2 * share)
        share = torch.from_numpy(share)[:, None, None]
        return known[behind - 1] * (1 - share) + known[behind] * share


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Textile:
    """Yarns, and the box that a file shows of them.

    Attributes:
        yarns: at least one.
        domain: ((x low, y low), (x high, y high)), or None.
    """

    yarns: tuple[Yarn, ...]
    domain: Float[Tensor, "2 2"] | None = None

    def __post_init__(self) -> None:
        """Raise FormatError unless there is something to show."""
        if not self.yarns:
            raise FormatError("textile: expected at least one yarn, got none")
        if self.domain is not None:
            check_shape("textile.domain", self.domain, (2, 2))
            if not bool((self.domain[1] - self.domain[0] > 1e-9).all() and (self.domain.abs() <= FAR).all()):
                raise FormatError(f"textile: expected a domain with two sides, got {self.domain.tolist()}")
