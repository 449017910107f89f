"""Rays against triangles: Embree behind tensors. The only module that imports embreex.

Embree works in float32 and finds every hit from the origin on, so callers move origins off the surface they
leave (`offset`). Large batches are split over threads; results do not depend on how many.

Test: tests/geometry/test_rays.py
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.errors import GeometryError

CHUNK = 1 << 16
"""Rays handed to Embree in one call."""


class Hits(NamedTuple):
    """First hits of a batch of rays.

    Attributes:
        t: (n,) distance in units of the direction's length; inf where nothing is hit.
        face: (n,) triangle, -1 where nothing is hit.
        barycentric: (n, 3) position in the triangle.
    """

    t: Float[Tensor, "n"]
    face: Int[Tensor, "n"]
    barycentric: Float[Tensor, "n 3"]


class RayScene:
    """Triangles that rays can be cast at; built once, used from any number of threads."""

    def __init__(self, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]):
        """Build the acceleration structure.

        Raises:
            GeometryError: there is no triangle, or a position is not finite.
        """
        from embreex import rtcore_scene
        from embreex.mesh_construction import TriangleMesh

        if len(faces) == 0 or not bool(torch.isfinite(vertices).all()):
            raise GeometryError("rays: expected at least one triangle and finite positions")
        self._arrays = (
            np.ascontiguousarray(vertices.detach().float().numpy()),
            np.ascontiguousarray(faces.int().numpy()),
        )
        self._scene = rtcore_scene.EmbreeScene(robust=True)  # pyright: ignore[reportAttributeAccessIssue]
        self._mesh = TriangleMesh(self._scene, *self._arrays)
        self._run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), None)  # commits the scene

    def first_hit(
        self,
        origin: Float[Tensor, "n 3"],
        direction: Float[Tensor, "n 3"],
        limit: Float[Tensor, "n"] | None = None,
    ) -> Hits:
        """Return the nearest hit of each ray with t in [0, limit]."""
        n = len(origin)
        t = torch.full((n,), torch.inf)
        face = torch.full((n,), -1, dtype=torch.long)
        uv = torch.zeros(n, 2)

        def cast(part: slice) -> None:
            found = self._run(_array(origin[part]), _array(direction[part]), _limits(limit, part))
            hit = found["primID"] >= 0
            face[part] = torch.from_numpy(found["primID"].astype(np.int64))
            t[part] = torch.from_numpy(np.where(hit, found["tfar"], np.float32(np.inf)))
            uv[part] = torch.from_numpy(np.stack([found["u"], found["v"]], -1) * hit[:, None])

        _in_chunks(n, cast)
        return Hits(t, face, torch.stack([1 - uv[:, 0] - uv[:, 1], uv[:, 0], uv[:, 1]], -1))

    def occluded(
        self,
        origin: Float[Tensor, "n 3"],
        direction: Float[Tensor, "n 3"],
        limit: Float[Tensor, "n"] | None = None,
    ) -> Bool[Tensor, "n"]:
        """Return whether anything lies on each ray with t in [0, limit]."""
        blocked = torch.zeros(len(origin), dtype=torch.bool)

        def cast(part: slice) -> None:
            found = self._scene.run(
                _array(origin[part]), _array(direction[part]), dists=_limits(limit, part), query="OCCLUDED"
            )
            blocked[part] = torch.from_numpy(np.asarray(found) >= 0)

        _in_chunks(len(origin), cast)
        return blocked

    def _run(self, origin: np.ndarray, direction: np.ndarray, limit: np.ndarray | None) -> dict:
        return self._scene.run(origin, direction, dists=limit, query="INTERSECT", output=1)


def offset(point: Float[Tensor, "n 3"], normal: Float[Tensor, "n 3"], size: float) -> Float[Tensor, "n 3"]:
    """Return `point` moved along `normal` by a few float32 steps of a scene of extent `size`.

    A ray that leaves the point towards the normal's side then misses the surface it starts on.
    """
    return point + normal * (size * 4e-6)


def _array(x: Tensor) -> np.ndarray:
    return np.ascontiguousarray(x.detach().float().numpy())


def _limits(limit: Tensor | None, part: slice) -> np.ndarray | None:
    return None if limit is None else _array(limit[part])


def _in_chunks(n: int, cast) -> None:
    parts: Sequence[slice] = [slice(i, min(i + CHUNK, n)) for i in range(0, n, CHUNK)]
    if len(parts) <= 1 or torch.get_num_threads() == 1:
        for part in parts:
            cast(part)
        return
    with ThreadPoolExecutor(torch.get_num_threads()) as pool:
        list(pool.map(cast, parts))
