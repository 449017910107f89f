"""Fit an eigen BTF: the best approximation of a BTF by a few view weights times eigen maps.

wang2005mdf, section 5. The matrix has rows (x, y, light, rgb) and columns view. Its Gram matrix over views is
summed over bands of texel rows, its leading eigenvectors are W, and a second pass over the bands gives
E = A W: the whole BTF is never in memory.

Test: tests/compress/test_eigen.py
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra.gram import gram, right_basis
from torchmeso.compress import quantize
from torchmeso.compress.quantize import Spread, Storage
from torchmeso.data import bands
from torchmeso.data.btf import Bands
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.errors import ConfigError

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class EigenOptions:
    """How to compress.

    Attributes:
        rank: components kept (4 in wang2005mdf), at most the number of views.
        storage: uint8, float16, float32, or adaptive (bytes with steps that follow their variance).
    """

    rank: int = 4
    storage: Storage = "uint8"


def fit(btf: Bands, options: EigenOptions | None = None, *, progress: Progress = lambda share: None) -> EigenBtf:
    """Return the eigen BTF of `btf`: among all models of its rank the one with the least squared error.

    Args:
        btf: in memory or on disk.
        options: rank and storage.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the rank is not between 1 and the number of views.
        ShapeError: a value of the BTF is not finite.
    """
    options = options or EigenOptions()
    check(btf, options)
    total = gram_over_views(btf, lambda share: progress(0.5 * share))
    W = right_basis(total, options.rank).vectors.float()
    maps = maps_of(btf, W, lambda share: progress(0.5 + 0.5 * share))
    step = None
    if options.storage == "adaptive":
        spreads = (quantize.spread(maps[..., k, :]) for k in range(options.rank))
        step = adaptive_steps(btf, options.rank, total, spreads)
    codes = quantize.one_by_one(maps, options.storage, step)
    return EigenBtf(
        maps=codes.codes, weights=W, scale=codes.scale, offset=codes.offset, lights=btf.lights, views=btf.views
    )


def gram_over_views(btf: Bands, progress: Progress = lambda share: None) -> Float[Tensor, "view view"]:
    """Return the sum over all rows of the matrix, in float64."""
    n_view = len(btf.views)
    total = torch.zeros(n_view, n_view, dtype=torch.float64)
    for rows, sum_so_far in grams(btf, bands.layout(btf), total):
        total = sum_so_far
        progress(rows.stop / btf.texels[0])
    return total


def maps_of(
    btf: Bands, W: Float[Tensor, "view rank"], progress: Progress = lambda share: None
) -> Float[Tensor, "light H W rank 3"]:
    """Return the eigen maps E = A W of the whole texture."""
    height, width = btf.texels
    maps = torch.empty(len(btf.lights), height, width, W.shape[1], 3)
    for rows, E in scores(btf, W, bands.layout(btf)):
        maps[:, rows] = E.permute(1, 2, 3, 0, 4)
        progress(rows.stop / height)
    return maps


def adaptive_steps(
    btf: Bands, rank: int, total: Float[Tensor, "view view"], spreads: Iterable[Spread]
) -> Float[Tensor, "rank 3"]:
    """Return the steps of eigen maps: weights over views are orthonormal, so that all maps have the same gain."""
    height, width = btf.texels
    values = len(btf.lights) * len(btf.views) * height * width * 3
    left_out = torch.linalg.eigvalsh(total)[: len(btf.views) - rank].clamp(min=0).sum()
    gain = torch.full((rank,), 1 / len(btf.views))
    return quantize.steps(list(spreads), gain, float(left_out) / values)


def check(btf: Bands, options: EigenOptions) -> None:
    """Raise ConfigError unless the rank is between 1 and the number of views."""
    n_view = len(btf.views)
    if not 1 <= options.rank <= n_view:
        raise ConfigError(f"compress.rank: expected 1 to {n_view} (the number of views), got {options.rank}")


def grams(
    btf: Bands, wanted: Sequence[slice], total: Float[Tensor, "view view"]
) -> Iterator[tuple[slice, Float[Tensor, "view view"]]]:
    """Yield bands of texel rows and the Gram matrix over views of `total` and all bands so far.

    It is summed texel row by texel row: bands of any height give the same bits, and so does a sum that goes on.
    """
    for band in bands.ahead(btf, wanted):
        for samples in bands.each_row(btf, band):
            if bool(samples.any()):
                total = total + gram([_matrix(samples)], len(total))
        yield band.rows, total


def scores(
    btf: Bands, W: Float[Tensor, "view rank"], wanted: Sequence[slice]
) -> Iterator[tuple[slice, Float[Tensor, "rank light rows W 3"]]]:
    """Yield bands of texel rows and their eigen maps E = A W, the products texel row by texel row."""
    for band in bands.ahead(btf, wanted):
        n_light, _, height, width, _ = band.stored.shape
        E = torch.zeros(W.shape[1], n_light, height, width, 3)
        for row, samples in enumerate(bands.each_row(btf, band)):
            if bool(samples.any()):
                E[:, :, row] = scores_of(samples, W)
        yield band.rows, E


def scores_of(
    samples: Float[Tensor, "light view W 3"], W: Float[Tensor, "view rank"]
) -> Float[Tensor, "rank light W 3"]:
    """Return the eigen maps of a texel row."""
    n_light, _, width, _ = samples.shape
    return (_matrix(samples) @ W).reshape(n_light, width, 3, -1).permute(3, 0, 1, 2)


def _matrix(samples: Float[Tensor, "light view W 3"]) -> Float[Tensor, "row view"]:
    """Return one row of texels as the matrix whose columns are views."""
    return samples.permute(0, 2, 3, 1).reshape(-1, samples.shape[1])
