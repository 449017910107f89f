"""Texture coordinates for meshes that have none, or bad ones: an atlas by xatlas, at one scale all over.

A cut atlas is a stopgap: the mesostructure does not continue across its seams, so their length is reported. Charts are
laid for textures that repeat: each has the same scale, none is mirrored, and +v points up the y axis where it can.
With `packed` they stay where xatlas put them, side by side in one square, for pictures painted on the atlas.

Test: tests/geometry/test_unwrap.py
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchmeso.errors import GeometryError, check_range
from torchmeso.geometry import components


@dataclass(frozen=True, slots=True, kw_only=True)
class UnwrapOptions:
    """How charts are made.

    Attributes:
        max_cost: how bent and ragged a chart may get before another begins; more = fewer, more distorted charts.
        iterations: times the charts are grown anew from better places; 4 gives half the charts of 1 in twice the time.
        packed: keep charts apart from each other in [0, 1]^2, mirrored and turned as they were packed, instead of
            giving each the same scale and direction; `tile_size` then scales nothing.
    """

    max_cost: float = 2.0
    iterations: int = 4
    packed: bool = False

    def __post_init__(self) -> None:
        """Raise ConfigError for a value out of range."""
        check_range("unwrap.max_cost", self.max_cost, 0.01, 1e6)
        check_range("unwrap.iterations", self.iterations, 1, 64)


class Atlas(NamedTuple):
    """A mesh with texture coordinates.

    Attributes:
        vertices: (V, 3) world, split along seams.
        faces: (F, 3), in the order of the original faces.
        uv: (V, 2) in tiles.
        charts: number of pieces.
        seams: how much of the surface's edges they cut.
    """

    vertices: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    uv: Float[Tensor, "V 2"]
    charts: int
    seams: "Seams"


class Seams(NamedTuple):
    """Edges between two faces across which texture coordinates jump.

    Attributes:
        length: of those, world units.
        edges: of all edges.
    """

    length: float
    edges: float

    def __str__(self) -> str:
        """Return both in words."""
        return f"{self.length:.3g} world units long ({self.length / max(self.edges, 1e-30):.0%} of all edges)"


def unwrap(
    vertices: Float[Tensor, "V 3"],
    faces: Int[Tensor, "F 3"],
    *,
    tile_size: float,
    options: UnwrapOptions | None = None,
) -> Atlas:
    """Return texture coordinates in which one tile covers `tile_size` x `tile_size` world units everywhere.

    Raises:
        ConfigError: the tile size is not positive.
        GeometryError: xatlas is not installed, or finds no chart.
    """
    options = options or UnwrapOptions()
    check_range("unwrap.tile_size", tile_size, 1e-9, 1e9)
    position = components.weld(vertices)
    first = torch.full((int(position.max()) + 1,), len(vertices)).scatter_reduce_(
        0, position, torch.arange(len(vertices)), "amin"
    )
    welded = vertices[first].float()
    source, new_faces, uv = _charts(welded, position[faces], options)
    if len(new_faces) != len(faces):
        raise GeometryError(f"unwrap: expected {len(faces)} triangles back, got {len(new_faces)}; clean the mesh first")
    new_vertices = welded[source]
    chart = _chart_of(new_faces, len(new_vertices))
    if not options.packed:
        uv = _straighten(new_vertices.double(), new_faces, uv, chart) / tile_size
    uv = uv.float()
    return Atlas(new_vertices, new_faces, uv, int(chart.max()) + 1, find_seams(new_vertices, new_faces, uv))


def find_seams(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], uv: Float[Tensor, "V 2"]) -> Seams:
    """Return how long the edges are whose two sides have different texture coordinates.

    Whole tiles between them count as a seam only if the mesostructure does not go on: a jump of whole tiles is none.
    """
    position = components.weld(vertices)
    tail, head = faces.flatten(), faces.roll(-1, 1).flatten()
    swap = position[tail] > position[head]
    low, high = torch.where(swap, head, tail), torch.where(swap, tail, head)
    key = position[low] * (int(position.max()) + 1) + position[high]
    _, edge = torch.unique(key, return_inverse=True)
    n_edge = int(edge.max()) + 1
    first = torch.full((n_edge,), len(key)).scatter_reduce_(0, edge, torch.arange(len(key)), "amin")
    length = (vertices[tail[first]] - vertices[head[first]]).double().norm(dim=-1)
    jump = torch.cat([uv[low] - uv[low[first]][edge], uv[high] - uv[high[first]][edge]], 1).double()
    torn = ((jump - jump.round()).abs() > 1e-4).any(1)
    # The same whole tiles at both ends: the texture goes on.
    torn |= ((jump[:, :2] - jump[:, 2:]).abs() > 1e-4).any(1)
    cut = torch.zeros(n_edge, dtype=torch.bool)
    cut[edge[torn]] = True
    return Seams(float(length[cut].sum()), float(length.sum()))


def _charts(vertices: Tensor, faces: Tensor, options: UnwrapOptions) -> tuple[Tensor, Tensor, Tensor]:
    """Return which vertex each new one was, faces, and texture coordinates in units of one length in u and v."""
    try:
        import xatlas
    except ImportError as error:
        raise GeometryError("unwrap: expected the package xatlas; install the extra: torchmeso[mesh]") from error
    chart: Any = xatlas.ChartOptions()
    chart.max_cost, chart.max_iterations = options.max_cost, options.iterations
    pack: Any = xatlas.PackOptions()
    pack.padding = 2 if options.packed else 0
    atlas = xatlas.Atlas()
    atlas.add_mesh(np.ascontiguousarray(vertices.numpy()), np.ascontiguousarray(faces.numpy().astype(np.uint32)))
    atlas.generate(chart, pack)
    source, index, uv = atlas[0]
    # Both sides were divided by their own size in texels.
    shape = np.array([atlas.width, atlas.height], dtype=np.float64)
    uv = uv.astype(np.float64) * shape / shape.max()
    return (
        torch.from_numpy(source.astype(np.int64)),
        torch.from_numpy(index.astype(np.int64).reshape(-1, 3)),
        torch.from_numpy(uv),
    )


def _chart_of(faces: Tensor, n_vertex: int) -> Int[Tensor, "V"]:
    """Return the chart of each vertex: vertices that faces join."""
    a, b = faces[:, [0, 1]].flatten().numpy(), faces[:, [1, 2]].flatten().numpy()
    links = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(n_vertex, n_vertex))
    return torch.from_numpy(connected_components(links, directed=False)[1]).long()


def _straighten(vertices: Tensor, faces: Tensor, uv: Tensor, chart: Tensor) -> Float[Tensor, "V 2"]:
    """Return charts in world lengths, none mirrored, each turned so that on the whole +v goes up the y axis."""
    n, of_face = int(chart.max()) + 1, chart[faces[:, 0]]
    p, q = vertices[faces], uv[faces]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    (u1, v1), (u2, v2) = (q[:, 1] - q[:, 0]).unbind(-1), (q[:, 2] - q[:, 0]).unbind(-1)
    twice = u1 * v2 - u2 * v1

    def total(x: Tensor) -> Tensor:
        return torch.zeros(n, dtype=torch.float64).index_add_(0, of_face, x)

    world, flat, signed = total(torch.linalg.cross(e1, e2).norm(dim=-1)), total(twice.abs()), total(twice)
    scale = torch.where(flat > 0, (world / flat.clamp(min=1e-300)).sqrt(), 1.0)
    side = torch.where(signed < 0, -1.0, 1.0)
    # The gradient of y over (u, v), times the UV area, which is what a mean over the chart weighs it with.
    turn = torch.where(twice < 0, -1.0, 1.0)
    along_u = total((e1[:, 1] * v2 - e2[:, 1] * v1) * turn) * side
    along_v = total((e2[:, 1] * u1 - e1[:, 1] * u2) * turn)
    steep = torch.hypot(along_u, along_v)
    lying = steep * scale <= 1e-3 * world.clamp(min=1e-300)
    cosine = torch.where(lying, 1.0, along_v / steep.clamp(min=1e-300))
    sine = torch.where(lying, 0.0, along_u / steep.clamp(min=1e-300))
    u, v = (uv * scale[chart, None]).unbind(-1)
    u = u * side[chart]
    return torch.stack([cosine[chart] * u - sine[chart] * v, sine[chart] * u + cosine[chart] * v], -1)
