"""Fit a factored GDM: the singular value decomposition of its distances, or of those alone that are of hits.

wang2004gdm, section 5: rows (x, y, phi), columns (theta, z). The paper fills the matrix with the way to the boundary
where a ray leaves (`fill="boundary"`), and inside of solid distances are 0: at every silhouette it jumps, and ranks
are spent on jumps that no query reads. With `fill="hits"` what is no hit has no value: it is filled with what the
components of the round before say (the fixed point is a least-squares fit of the hits alone, reached by expectation
and maximisation), and last the weights of each row are solved for on its own hits.

Test: tests/compress/test_gdm_svd.py
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso.algebra.gram import gram, right_basis
from torchmeso.data import gdm_streams
from torchmeso.data.gdm import Gdm
from torchmeso.data.gdm_coded import codes_of
from torchmeso.data.gdm_svd import GdmSvd, packed_bits
from torchmeso.errors import ConfigError, check_range
from torchmeso.geometry import sphere

ROUNDS = 8
"""Of filling in what is no hit; the RMS of a weave's hits falls by less than 1 % in each later one."""

RIDGE = 1e-3
"""How much large weights count beside errors of hits (of a row's mean hit): rows with few hits stay small."""

MOST_RANK = 64

BLOCK = 8192
"""Rows that are solved for at once."""

Progress = Callable[[float], None]

Fill = Literal["hits", "boundary"]


@dataclass(frozen=True, slots=True, kw_only=True)
class GdmSvdOptions:
    """How to factor.

    Attributes:
        rank: components kept.
        fill: what the matrix holds where there is no hit: "boundary" (the way out of the slab, as the paper's), or
            whatever fits the "hits".
    """

    rank: int = 16
    fill: Fill = "hits"

    def __post_init__(self) -> None:
        """Raise ConfigError for a rank that cannot be meant."""
        check_range("compress.rank", self.rank, 1, 4096)


def fit(table: Gdm, options: GdmSvdOptions | None = None, *, progress: Progress = lambda share: None) -> GdmSvd:
    """Return the factored GDM of a table.

    Args:
        table: of any storage.
        options: rank, and what is fitted.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the rank exceeds the number of columns or rows.
    """
    options = options or GdmSvdOptions()
    layers, height, width = table.voxels
    n_theta, n_phi = table.distance.shape[3:]
    most = min((n_theta + 2) * layers, height * width * n_phi)
    if options.rank > most:
        raise ConfigError(f"compress.rank: expected 1 to {most} for this table, got {options.rank}")
    A, hits = matrix(table)
    if options.fill == "hits":
        V, W = _fit_hits(A, hits, options.rank, progress)
    else:
        V = right_basis(gram([A], A.shape[1]), options.rank).vectors.float()
        W = A @ V
    low, high = W.amin(0), W.amax(0)
    scale = ((high - low) / 255).clamp(min=torch.finfo(torch.float32).tiny)
    codes = ((W - low) / scale).round().clamp(0, 255).to(torch.uint8)
    progress(1.0)
    # Poles leave where most of their ring does.
    left = sphere.with_poles((~table.left).float()) < 0.5
    return GdmSvd(
        weights=codes.reshape(height, width, n_phi, options.rank),
        scale=scale,
        offset=low,
        maps=V.T.reshape(options.rank, n_theta + 2, layers).contiguous(),
        left=packed_bits(left),
        occupancy=table.occupancy,
        matter=table.matter,
        h=table.h,
        cap=table.cap,
    )


def matrix(table: Gdm) -> tuple[Float[Tensor, "row column"], Bool[Tensor, "row column"]]:
    """Return distances in tile units, rows (y, x, phi) by columns (direction row, layer), and which are of hits.

    Directions have the rows of the poles. What leaves is the way to the boundary, what is solid 0.
    """
    n_phi = table.distance.shape[4]
    met = (~table.left).float()
    known = sphere.with_poles(met)
    unit = table.cap / 255 if table.distance.dtype == torch.uint8 else 1.0
    distance = sphere.with_poles(table.distance.float() * unit * met) / known.clamp(min=1e-6)
    solid = (table.occupancy > 0.5)[..., None, None]
    hits = (known > 0.5) & ~solid
    grid = table.directions.directions()
    up = torch.tensor([0.0, 0.0, 1.0]).expand(1, n_phi, 3)
    w = torch.cat([up, grid, -up])
    layers = table.voxels[0]
    place = torch.zeros(layers, 1, 1, 3)
    place[..., 2] = (-table.h + table.h * torch.arange(layers) / (layers - 1))[:, None, None]
    end = table.boundary(place.expand(-1, *w.shape[:2], 3), w.expand(layers, -1, -1, -1))[:, None, None]
    distance = torch.where(hits, distance, torch.where(solid, 0, end))
    order = (1, 2, 4, 3, 0)
    columns = distance.shape[3] * layers
    return distance.permute(order).reshape(-1, columns), hits.permute(order).reshape(-1, columns)


def _fit_hits(A: Tensor, hits: Tensor, rank: int, progress: Progress) -> tuple[Tensor, Tensor]:
    """Return V (column, rank) and W (row, rank) of the hits alone."""
    X, n = A.clone(), A.shape[1]
    for k in range(ROUNDS):
        V = right_basis(gram([X], n), rank).vectors.float()
        for x, a, hit in zip(X.split(BLOCK), A.split(BLOCK), hits.split(BLOCK), strict=True):
            x.copy_(torch.where(hit, a, x @ V @ V.T))
        progress((k + 1) / (ROUNDS + 1))
    V = right_basis(gram([X], n), rank).vectors.float()
    parts = zip(A.split(BLOCK), hits.split(BLOCK), (X @ V).split(BLOCK), strict=True)
    return V, torch.cat([_weights(a, hit.float(), V, start) for a, hit, start in parts])


def _weights(a: Tensor, hit: Tensor, V: Tensor, start: Tensor) -> Tensor:
    """Return the weights (row, rank) that fit the hits of each row best, close to `start` where they say little."""
    products = (V[:, :, None] * V[:, None, :]).reshape(len(V), -1)
    normal = (hit @ products).reshape(len(a), *[V.shape[1]] * 2) + RIDGE * torch.eye(V.shape[1])
    error = hit * (a - start @ V.T)
    return start + torch.linalg.solve(normal, error @ V)


def error(table: Gdm, factored: GdmSvd, share: float = 0.95) -> float:
    """Return how far (voxels) that share of the hits of a table are from it at most; 0 where there is none."""
    solid = (table.occupancy > 0.5)[..., None, None]
    off = (codes_of(table).short() - factored.expanded().distance.short()).abs()[~table.left & ~solid]
    counts = torch.bincount(off.flatten(), minlength=1).cumsum(0)
    if not len(off):
        return 0.0
    return int((counts < share * len(off)).sum()) * table.cap / 255 / table.voxel


def stored_bytes(factored: GdmSvd) -> int:
    """Return the bytes that a file of it takes but for its header."""
    parts = [gdm_streams.packed(factored.weights[..., k]) for k in range(factored.rank)]
    parts += gdm_streams.to_tensors(factored.left, factored.occupancy, factored.matter).values()
    return sum(len(x) for x in parts) + 4 * (factored.maps.numel() + 2 * factored.rank)


def fit_to(
    table: Gdm,
    *,
    size: int | None = None,
    within: float | None = None,
    fill: Fill = "hits",
    progress: Progress = lambda share: None,
) -> GdmSvd:
    """Return the factored GDM of the highest rank in a size, or of the lowest within an error, up to rank 64.

    Args:
        table: of any storage.
        size: most bytes of the file.
        within: most voxels that 95 % of the hits are off by.
        fill: see `GdmSvdOptions`.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: no rank fits; both or neither are given.
    """
    if (size is None) == (within is None):
        raise ConfigError("compress: expected either --size or --error")
    columns, rows = (table.distance.shape[3] + 2) * table.voxels[0], table.distance[0, :, :, 0].numel()
    low, high = 1, min(MOST_RANK, columns, rows)
    steps, done, best, found = high.bit_length() + 1, 0, None, None
    while low <= high:
        rank = (low + high) // 2
        # One more call in a search of known depth: the share never falls.
        told = lambda share, done=done: progress(min((done + share) / steps, 1.0))  # noqa: E731
        found = fit(table, GdmSvdOptions(rank=rank, fill=fill), progress=told)
        good = stored_bytes(found) <= size if size is not None else error(table, found) <= (within or 0)
        best = found if good else best
        if good == (size is not None):
            low = rank + 1
        else:
            high = rank - 1
        done += 1
    if best is not None:
        return best
    assert found is not None  # there is at least one rank to try
    if size is not None:
        raise ConfigError(f"compress.size: expected at least {stored_bytes(found)} bytes for this table, got {size}")
    raise ConfigError(
        f"compress.error: expected at least {error(table, found):.2g} voxels, which rank {found.rank} reaches, "
        f"got {within}"
    )
