"""Two-dimensional weaves as patterns: which yarn lies over which at every crossing, made into yarns.

Yarns along x and yarns along y lie in lanes beside each other, each in the middle of its lane. At a crossing the upper
one touches the upper face of the fabric and the lower one the lower face; what is left of the thickness is the gap
between them. From crossing to crossing a yarn goes level into level (Bezier pieces with tangents along the yarn).

Test: tests/data/test_weave_pattern.py
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso.data.textile import Textile, Yarn
from torchmeso.data.yarn_section import Ellipse
from torchmeso.errors import FormatError, check_shape


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class WeavePattern:
    """A weave.

    Attributes:
        x_over: (x yarn, y yarn) whether the yarn along x lies over the one along y.
        x_yarns: (x yarn, 3) width, height and lane of each.
        y_yarns: (y yarn, 3) the same.
        thickness: of the fabric; at least both heights at every crossing.
    """

    x_over: Bool[Tensor, "x y"]
    x_yarns: Float[Tensor, "x 3"]
    y_yarns: Float[Tensor, "y 3"]
    thickness: float

    def __post_init__(self) -> None:
        """Raise FormatError unless the yarns fit into lanes and thickness."""
        check_shape("weave_pattern.x_yarns", self.x_yarns, (len(self.x_over), 3))
        check_shape("weave_pattern.y_yarns", self.y_yarns, (self.x_over.shape[1], 3))
        if not self.x_over.numel():
            raise FormatError("weave: expected yarns in both directions")
        for name, yarns in (("x", self.x_yarns), ("y", self.y_yarns)):
            if not bool(((yarns > 0) & (yarns <= 1e5)).all()) or not bool((yarns[:, 0] <= yarns[:, 2] + 1e-9).all()):
                raise FormatError(
                    f"weave: expected widths, heights and spacings of {name} yarns above 0 and up to 1e5, "
                    "no yarn wider than its spacing"
                )
        needed = float(self.x_yarns[:, 1].max() + self.y_yarns[:, 1].max())
        if not needed * (1 - 1e-6) <= self.thickness <= 1e5:
            raise FormatError(f"weave: expected a thickness of at least two yarns ({needed:g}), got {self.thickness:g}")


def yarns(pattern: WeavePattern) -> Textile:
    """Return the yarns of a weave, those along x first, over the domain of one period."""
    sides = torch.stack([pattern.y_yarns[:, 2].sum(), pattern.x_yarns[:, 2].sum()]).double()
    made = [
        _yarn(0, k, pattern.x_yarns, pattern.y_yarns, over, pattern.thickness, sides)
        for k, over in enumerate(pattern.x_over)
    ]
    made += [
        _yarn(1, k, pattern.y_yarns, pattern.x_yarns, ~over, pattern.thickness, sides)
        for k, over in enumerate(pattern.x_over.T)
    ]
    return Textile(yarns=tuple(made), domain=torch.stack([torch.zeros_like(sides), sides]))


def _yarn(axis: int, k: int, own: Tensor, others: Tensor, over: Tensor, thickness: float, sides: Tensor) -> Yarn:
    """Return yarn `k` along an axis over one period, from the middle of its first crossing."""
    width, height, _ = own[k].tolist()
    along, across = _middles(others), float(_middles(own)[k])
    top = (thickness - height) / 2
    nodes = torch.zeros(len(others) + 1, 3, dtype=torch.float64)
    nodes[:-1, axis], nodes[-1, axis] = along, along[0] + sides[axis]
    nodes[:, 1 - axis] = across
    nodes[:, 2] = torch.where(torch.cat([over, over[:1]]), top, -top).double()
    ahead, up = torch.zeros_like(nodes), torch.zeros_like(nodes)
    ahead[:, axis] = 1
    up[:, 2] = 1
    return Yarn(
        nodes=nodes,
        tangents=ahead,
        ups=up,
        path="bezier",
        sections=(Ellipse(width=width, height=height),),
        repeats=torch.diag(torch.cat([sides, sides.new_zeros(1)]))[:2],
    )


def _middles(yarns: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    lane = yarns[:, 2].double()
    return lane.cumsum(0) - lane / 2
