"""Quads on a closed mesh by QuadriFlow (huang2018quadriflow), and back onto it.

QuadriFlow finds quads of about one size whose sides follow the mesh, with few corners where other than four meet. They
are large; split into smaller ones they are laid back onto the mesh (`onto`).

Test: tests/geometry/test_quadriflow.py
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor
from trimesh.triangles import closest_point

from torchmeso.errors import GeometryError
from torchmeso.geometry import quads
from torchmeso.geometry.quads import Patches, QuadMesh, edges

SEED = 0
"""Of QuadriFlow's own choices."""

NEAR = 16
"""Triangles among which a point's nearest is looked for."""


def quads_of(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], count: int) -> QuadMesh:
    """Return about `count` quads over a closed mesh.

    Raises:
        GeometryError: the mesh has borders, the package is not installed, or it finds no quads.
    """
    open_ = int((edges(faces).beside < 0).sum())
    if open_:
        raise GeometryError(
            f"quadriflow: expected a closed mesh, got {open_} edges at borders; close it, or take another way (cube)"
        )
    try:
        from pyQuadriFlow.pyQuadriFlow import pyquadriflow
    except ImportError as error:
        raise GeometryError(
            "quadriflow: expected the package pyquadriflow; install the extra: torchmeso[mesh]"
        ) from error
    low, high = vertices.aminmax(dim=0)
    size = float((high - low).max())
    try:
        found: Any = pyquadriflow(
            count, SEED, ((vertices - low) / size).tolist(), faces.tolist(), False, False, False, False, False
        )
    except Exception as error:  # the package raises no kind of its own
        raise GeometryError(f"quadriflow: expected about {count} quads, got none ({error}); ask for more") from error
    points, corners = torch.tensor(found["vertices"], dtype=torch.float64), torch.tensor(found["faces"])
    return quads.mended(QuadMesh(points * size + low, corners))[0]


def onto(patches: Patches, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Patches:
    """Return patches whose points are moved to the nearest of a mesh, among the triangles whose middles are near."""
    triangles = vertices[faces].double().numpy()
    points = patches.vertices.numpy()
    _, near = KDTree(triangles.mean(1)).query(points, k=min(NEAR, len(triangles)))
    near = near.reshape(len(points), -1)
    found = closest_point(triangles[near.ravel()], points.repeat(near.shape[1], 0)).reshape(*near.shape, 3)
    best = np.square(found - points[:, None]).sum(-1).argmin(1)
    return patches._replace(vertices=torch.from_numpy(found[np.arange(len(points)), best]))
