"""The prism mapping: texture space (u, v, z) <-> world, one prism per base triangle.

A base triangle's prism is spanned by its corners and the corners moved along the vertex normals:

    p(a, z) = sum_i a_i (v_i + z s_i n_i),   a barycentric in the UV triangle, z in [-h, 0] tile units,

with s_i the texture scale and n_i the normal at vertex i. It is linear in a at fixed z and linear in z at
fixed a, and neighbours agree on their common face, so the mapped mesostructure has no cracks. The
displaced-mesh truth and GDM prisms share it.

Test: tests/geometry/test_prisms.py
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.geometry.mesh import Mesh

THIN = 1e-6
"""Height over length of UV triangles in which float32 texture coordinates do not tell where a point lies."""


def to_world(
    mesh: Mesh,
    face: Int[Tensor, "*batch"],
    barycentric: Float[Tensor, "*batch 3"],
    z: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch 3"]:
    """Return the world position of points of the slab.

    Args:
        mesh: the base mesh.
        face: (...) base triangle.
        barycentric: (..., 3) position in the triangle.
        z: (...) height in tile units, 0 = the base surface, negative below it.

    Returns:
        (..., 3) in the dtype of `barycentric`.
    """
    corner = mesh.faces[face]
    dtype = barycentric.dtype
    shift = (mesh.scale.to(dtype)[:, None] * mesh.normals.to(dtype))[corner]
    return (barycentric.unsqueeze(-1) * (mesh.vertices.to(dtype)[corner] + z[..., None, None] * shift)).sum(-2)


def barycentric(uv: Float[Tensor, "*batch 2"], triangle: Float[Tensor, "*batch 3 2"]) -> Float[Tensor, "*batch 3"]:
    """Return the barycentric coordinates of `uv` in UV triangles (NaN where a triangle has no area)."""
    a, b, c = triangle.unbind(-2)
    area = _cross(b - a, c - a)
    return torch.stack([_cross(b - uv, c - uv), _cross(c - uv, a - uv), _cross(a - uv, b - uv)], -1) / area.unsqueeze(
        -1
    )


def is_thin(triangle: Float[Tensor, "*batch 3 2"]) -> Bool[Tensor, "*batch"]:
    """Return which UV triangles are as good as a line; of a point of theirs the middle is as good a guess as any."""
    first, second = triangle[..., 1, :] - triangle[..., 0, :], triangle[..., 2, :] - triangle[..., 0, :]
    length = torch.maximum(first.norm(dim=-1), second.norm(dim=-1))
    # Texture coordinates far from 0 are no better known near each other.
    rounded = THIN * torch.maximum(length, triangle.abs().amax((-1, -2)))
    return _cross(first, second).abs() <= rounded * length


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
