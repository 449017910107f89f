"""Texture coordinates for meshes that have none: an atlas by xatlas, at one scale all over.

A cut atlas is a stopgap: the mesostructure does not continue across its seams, so their length is reported.

Test: tests/geometry/test_unwrap.py
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.errors import GeometryError, check_range
from torchmeso.geometry import components


class Atlas(NamedTuple):
    """A mesh with texture coordinates.

    Attributes:
        vertices: (V, 3) world, split along seams.
        faces: (F, 3), in the order of the original faces.
        uv: (V, 2) in tiles.
        seam_length: world length of the edges across which texture coordinates jump.
        edge_length: world length of all edges.
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    uv: Float[Tensor, "V 2"]
    seam_length: float
    edge_length: float


def unwrap(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], *, tile_size: float) -> Atlas:
    """Return texture coordinates in which one tile covers `tile_size` x `tile_size` world units everywhere.

    Raises:
        ConfigError: the tile size is not positive.
        GeometryError: xatlas is not installed, or finds no chart.
    """
    try:
        import xatlas
    except ImportError as error:
        raise GeometryError("unwrap: expected the package xatlas; install the extra: torchmeso[mesh]") from error
    check_range("unwrap.tile_size", tile_size, 1e-9, 1e9)
    position = components.weld(vertices)
    first = torch.full((int(position.max()) + 1,), len(vertices)).scatter_reduce_(
        0, position, torch.arange(len(vertices)), "amin"
    )
    welded = np.ascontiguousarray(vertices[first].float().numpy())
    source, index, uv = xatlas.parametrize(welded, np.ascontiguousarray(position[faces].numpy().astype(np.uint32)))
    new_vertices = torch.from_numpy(welded[source.astype(np.int64)])
    new_faces = torch.from_numpy(index.astype(np.int64).reshape(-1, 3))
    if len(new_faces) != len(faces):
        raise GeometryError(f"unwrap: expected {len(faces)} triangles back, got {len(new_faces)}; clean the mesh first")
    uv = torch.from_numpy(uv.astype(np.float64))
    uv = uv * (_area(new_vertices.double(), new_faces) / max(_area(uv, new_faces), 1e-300)) ** 0.5 / tile_size
    seams, edges = _seams(new_vertices, new_faces, uv)
    return Atlas(new_vertices, new_faces, uv.float(), seams, edges)


def _area(points: Tensor, faces: Tensor) -> float:
    p = points[faces]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    if points.shape[1] == 2:
        return float((e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0]).abs().sum()) / 2
    return float(torch.linalg.cross(e1, e2).norm(dim=-1).sum()) / 2


def _seams(vertices: Tensor, faces: Tensor, uv: Tensor) -> tuple[float, float]:
    """Return the world length of edges whose two sides have different texture coordinates, and of all edges."""
    position = components.weld(vertices)
    sides: dict[tuple[int, int], list[tuple]] = {}
    for tail, head in zip(faces.flatten().tolist(), faces.roll(-1, 1).flatten().tolist(), strict=True):
        a, b = int(position[tail]), int(position[head])
        ends = (tail, head) if a < b else (head, tail)
        sides.setdefault((min(a, b), max(a, b)), []).append(tuple(uv[list(ends)].flatten().tolist()))
    seams = edges = 0.0
    place = {int(p): i for i, p in enumerate(position.tolist())}
    for (a, b), coordinates in sides.items():
        length = float((vertices[place[a]] - vertices[place[b]]).norm())
        edges += length
        if len(coordinates) > 1 and any(c != coordinates[0] for c in coordinates[1:]):
            seams += length
    return seams, edges
