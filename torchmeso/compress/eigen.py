"""Fit an eigen BTF: the best approximation of a BTF by a few view weights times eigen maps.

wang2005mdf, section 5. The matrix has rows (x, y, light, rgb) and columns view. Its Gram matrix over views is
summed over bands of texel rows, its leading eigenvectors are W, and a second pass over the bands gives
E = A W: the whole BTF is never in memory.

Test: tests/compress/test_eigen.py
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra.gram import gram, right_basis
from torchmeso.compress.quantize import Storage, quantize
from torchmeso.data.btf import Bands
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.errors import ConfigError

BLOCK_BYTES = 256 << 20
"""Memory of one band of texel rows while fitting."""

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class EigenOptions:
    """How to compress.

    Attributes:
        rank: components kept (4 in wang2005mdf), at most the number of views.
        storage: uint8, float16 or float32.
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
    n_view = len(btf.views)
    if not 1 <= options.rank <= n_view:
        raise ConfigError(f"compress.rank: expected 1 to {n_view} (the number of views), got {options.rank}")

    def bands(first: float, last: float) -> Iterator[Float[Tensor, "rows view"]]:
        for share, band in _bands(btf):
            yield band
            progress(first + (last - first) * share)

    basis = right_basis(gram(bands(0, 0.5), n_view), options.rank)
    W = basis.vectors.float()
    height, width = btf.texels
    maps = torch.empty(len(btf.lights), height, width, options.rank, 3)
    row = 0
    for band in bands(0.5, 1):
        scores = (band @ W).unflatten(0, (-1, len(btf.lights), width, 3))
        maps[:, row : row + len(scores)] = scores.permute(1, 0, 2, 4, 3)
        row += len(scores)
    codes = quantize(maps, options.storage)
    return EigenBtf(
        maps=codes.codes, weights=W, scale=codes.scale, offset=codes.offset, lights=btf.lights, views=btf.views
    )


def _bands(btf: Bands) -> Iterator[tuple[float, Float[Tensor, "rows view"]]]:
    """Yield (share done, (row light W rgb, view)) band by band."""
    height, width = btf.texels
    row_bytes = len(btf.lights) * len(btf.views) * width * 3 * 4
    step = max(1, min(height, BLOCK_BYTES // row_bytes))
    for start in range(0, height, step):
        band = btf.rows(start, min(start + step, height))
        yield min(start + step, height) / height, band.permute(2, 0, 3, 4, 1).reshape(-1, len(btf.views))
