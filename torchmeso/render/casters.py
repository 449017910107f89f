"""What a shadow map of the sun has to cover: where something can be shadowed.

A component that lies in one plane shadows nothing of itself, so a wide floor or wall counts only as far as other
components reach over it. Of a map around a whole scene with a floor, most texels would show the bare floor.

Test: tests/render/test_casters.py
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.geometry.directions import dot, normalize
from torchmeso.render.scene import World

FLAT = 1e-5
"""A component is flat where no vertex lies further from its plane, in units of its size."""

MOST_FLATS = 16
"""Flat components, the largest, that are looked at one by one; others count as bodies."""


class Corners(NamedTuple):
    """The vertices of a scene, as far as the views of lights have to know them; float64.

    Attributes:
        bodies: (3, V) of all components that can shadow themselves.
        flats: (3, n) of each component that lies in a plane.
    """

    bodies: Float[np.ndarray, "3 V"]
    flats: "tuple[np.ndarray, ...]"

    @property
    def sets(self) -> list[np.ndarray]:
        """Return all that are not empty, bodies first."""
        return [x for x in (self.bodies, *self.flats) if x.size]


class Box(NamedTuple):
    """A box along the axes of a light.

    Attributes:
        low: (3,) least coordinates.
        high: (3,) greatest.
    """

    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]


def corners_of(world: World) -> Corners:
    """Return the vertices of `world`, those of flat components apart."""
    vertices, component = world.vertices.double(), world.component
    flat = _flat(vertices, world)
    used = torch.zeros(len(vertices), dtype=torch.bool)
    used[world.faces[~torch.isin(component, flat)].reshape(-1)] = True
    flats = [vertices[world.faces[component == c].unique()] for c in flat]
    bodies, *others = (np.ascontiguousarray(x.numpy().T) for x in (vertices[used], *flats))
    return Corners(bodies, tuple(others))


def extents(corners: Corners, axes: Float[np.ndarray, "3 3"]) -> tuple[Box, Box]:
    """Return the box around a scene, and the one around all that can be shadowed in it.

    What a flat component shadows, or is shadowed by, lies where the others are in front of it or behind. (A slab's
    mesostructure can move a point it shows beyond the sheet's own outline; there it has nothing to shadow.)

    Args:
        corners: of the scene.
        axes: (3, 3) rows: right, up and back of a light's view.
    """
    boxes = [Box((axes @ x).min(1), (axes @ x).max(1)) for x in corners.sets]
    whole = _around(boxes)
    cast = boxes[:1] if corners.bodies.size else []
    for k in range(len(cast), len(boxes)):
        others = boxes[:k] + boxes[k + 1 :]
        if not others:
            continue
        reach = _around(others)
        low, high = np.maximum(boxes[k].low, reach.low), np.minimum(boxes[k].high, reach.high)
        if (low <= high)[:2].all():
            cast.append(Box(low, high))
    return whole, _around(cast) if cast else Box(whole.low, whole.low)


def _around(boxes: list[Box]) -> Box:
    return Box(np.min([b.low for b in boxes], 0), np.max([b.high for b in boxes], 0))


def _flat(vertices: Float[Tensor, "V 3"], world: World) -> Int[Tensor, "n"]:
    """Return the open components that lie in a plane, the largest where there are many."""
    component, count = world.component, len(world.closed)
    corner = vertices[world.faces]
    area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])

    def total(x: Tensor) -> Tensor:
        return torch.zeros(count, *x.shape[1:], dtype=x.dtype).index_add_(0, component, x)

    def most(x: Tensor) -> Tensor:
        return torch.zeros(count, dtype=x.dtype).scatter_reduce_(0, component, x, "amax")

    normal = total(area)
    # A tube's normals cancel: what is left of them is no plane's.
    aligned = normal.norm(dim=-1) > 0.5 * total(area.norm(dim=-1))
    middle = total(corner.mean(1)) / total(torch.ones(len(corner), 1, dtype=area.dtype)).clamp(min=1)
    way = corner - middle[component, None]
    size = most(way.norm(dim=-1).amax(1))
    off = most(dot(way, normalize(normal)[component, None]).abs().amax(1))
    flat = (aligned & (off <= FLAT * size) & ~world.closed).nonzero()[:, 0]
    return flat[torch.argsort(size[flat], descending=True, stable=True)[:MOST_FLATS]]
