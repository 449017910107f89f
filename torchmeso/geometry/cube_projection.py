"""Quads on any mesh by projecting it onto a cube around it: what a cube map sees from the middle.

Each of the six faces is split into n x n cells by planes through the middle, at equal angles, and triangles are cut
along them. Good for what a ray from the middle leaves once; where the surface folds back, quads are seen through one
another, and are mirrored and stretched there.

Test: tests/geometry/test_cube_projection.py
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.errors import GeometryError, check_range
from torchmeso.geometry import plane_cut
from torchmeso.geometry.quads import Patches

SLACK = 1e-9
"""Of the mesh's size: vertices this near to a plane lie on it."""


def project(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    parts: int,
    *,
    middle: tuple[float, float, float] | None = None,
) -> Patches:
    """Return a mesh in the quads of a cube.

    Args:
        vertices: positions.
        faces: triangles.
        parts: quads along a side of the cube.
        middle: of projection; None = that of the bounding box.

    Raises:
        ConfigError: `parts` is not in 1..64.
        GeometryError: the middle lies on the mesh.
    """
    check_range("cube.parts", parts, 1, 64)
    points = vertices.double()
    low, high = points.aminmax(dim=0)
    centre = (low + high) / 2 if middle is None else torch.tensor(middle, dtype=torch.float64)
    size = float((high - low).max())
    pieces = plane_cut.whole(points - centre, faces)
    for one, other in ((0, 1), (1, 2), (2, 0)):
        for sign in (1.0, -1.0):
            p = pieces.vertices
            pieces = plane_cut.cut(pieces, p[:, one] - sign * p[:, other], slack=SLACK * size)
    lines = torch.tan(math.pi / 4 * torch.linspace(-1, 1, parts + 1, dtype=torch.float64))
    for axis in range(3):
        others = [(axis + 1) % 3, (axis + 2) % 3]
        for line in lines[1:-1].tolist():
            # The same function on all four faces around the axis: their common edges are cut once.
            p = pieces.vertices
            distance = p[:, axis] - line * p[:, others].abs().amax(1)
            pieces = plane_cut.cut(pieces, distance, _main_axis(pieces)[0] != axis, slack=SLACK * size)
    axis, sign = _main_axis(pieces)
    s, t = (axis + torch.where(sign > 0, 1, 2)) % 3, (axis + torch.where(sign > 0, 2, 1)) % 3
    corner = pieces.vertices[pieces.faces]
    depth = (corner.gather(2, axis[:, None, None].expand(-1, 3, 1))[..., 0] * sign[:, None]).clamp(min=0)
    if bool((depth <= SLACK * size).any()):
        raise GeometryError("cube: expected a middle that is not on the mesh; name another")
    along = torch.stack([corner.gather(2, k[:, None, None].expand(-1, 3, 1))[..., 0] for k in (s, t)], -1)
    along = along / depth[..., None]
    # Of the three corners the middle lies inside of one cell.
    first = (torch.bucketize(along.mean(1).contiguous(), lines) - 1).clamp(0, parts - 1)
    start, end = lines[first], lines[first + 1]
    place = ((along - start[:, None]) / (end - start)[:, None]).clamp(0, 1)
    number = ((2 * axis + (sign < 0)) * parts + first[:, 1]) * parts + first[:, 0]
    used, cell = number.unique(return_inverse=True)
    return Patches(pieces.vertices + centre, pieces.faces, cell, place, _cells(parts)[used])


def _main_axis(pieces: plane_cut.Pieces) -> tuple[Int[Tensor, "F"], Float[Tensor, "F"]]:
    """Return the axis and the sign of the cube's face that each piece is seen through."""
    middle = pieces.vertices[pieces.faces].mean(1)
    axis = middle.abs().argmax(1)
    return axis, torch.where(middle.gather(1, axis[:, None])[:, 0] < 0, -1.0, 1.0).double()


def _cells(parts: int) -> Int[Tensor, "Q 4"]:
    """Return the quads of the cube, numbers of points of a grid of (parts + 1)^3: +x, -x, +y, ..., row by row."""
    t, s = torch.meshgrid(torch.arange(parts), torch.arange(parts), indexing="ij")
    found = []
    for axis in range(3):
        for end in (parts, 0):
            one, other = ((axis + 1) % 3, (axis + 2) % 3) if end else ((axis + 2) % 3, (axis + 1) % 3)
            at = torch.zeros(parts, parts, 4, 3, dtype=torch.long)
            at[..., axis] = end
            for k, (ds, dt) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
                at[:, :, k, one], at[:, :, k, other] = s + ds, t + dt
            found.append(at.reshape(-1, 4, 3))
    weight = torch.tensor([(parts + 1) ** 2, parts + 1, 1])
    return (torch.cat(found) * weight).sum(-1)
