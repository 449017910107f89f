"""Fit the factors of a decorrelated full matrix factorisation, Bonn's DFMF: one factorisation per colour channel.

The BTF in the numbers of a colour model (log Y, U/Y, V/Y by default, so that the eye's errors and not the highlights
decide) is one matrix of texels x pairs of light and view for each channel. Each is cut to its leading components by
subspace iteration over bands of texel rows: the BTF is never in memory, its factors are.

Test: tests/compress/test_dfmf.py
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra import subspace
from torchmeso.data import btfdbb_colour
from torchmeso.data.btf import Bands
from torchmeso.data.btfdbb_colour import Colour
from torchmeso.errors import check_range

BLOCK_BYTES = 256 << 20
"""Memory of one band of texel rows while fitting."""

DEFAULT_RANK = 64

DEFAULT_COLOUR = Colour(11)
"""What Bonn's published files are taken to use."""

Progress = Callable[[float], None]
Factors = list[tuple[Float[Tensor, "pair rank"], Float[Tensor, "texel rank"]]]


@dataclass(frozen=True, slots=True, kw_only=True)
class DfmfOptions:
    """How to factor.

    Attributes:
        rank: components kept of each channel, at most the pairs of light and view and the texels; none = 64 or all.
        colour: what the channels are.
        accurate: multiply in float64: twice as slow, for factors that keep values of 1e-4 of the largest.
    """

    rank: int | None = None
    colour: Colour = DEFAULT_COLOUR
    accurate: bool = False


def fit(table: Bands, options: DfmfOptions | None = None, *, progress: Progress = lambda share: None) -> Factors:
    """Return for each channel U (pair, rank) and S V (texel, rank) as `data.btfdbb_write.write_dfmf` takes them.

    Args:
        table: in memory or on disk; read six times.
        options: rank and colour model.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the rank is out of range.
        ShapeError: a value is not finite, or negative where the colour model takes logarithms.
    """
    options = options or DfmfOptions()
    height, width = table.texels
    pairs, texels = len(table.lights) * len(table.views), height * width
    most = min(pairs, texels)
    rank = min(DEFAULT_RANK, most) if options.rank is None else options.rank
    check_range("dfmf.rank", rank, 1, most)
    step = max(1, min(height, BLOCK_BYTES // (pairs * width * 12)))
    done = 0

    def blocks() -> Iterator[Float[Tensor, "3 texel pair"]]:
        nonlocal done
        for stop in range(height, 0, -step):  # files begin at the bottom row
            start = max(stop - step, 0)
            rgb = table.rows(start, stop)
            x = btfdbb_colour.from_rgb(options.colour, rgb.double() if options.accurate else rgb).flip(2)
            yield x.permute(4, 2, 3, 1, 0).reshape(3, -1, pairs)
            done += stop - start
            progress(done / (height * 2 * subspace.ROUNDS))

    by_texel, by_pair = subspace.factor(blocks, texels, pairs, 3, rank)
    return list(zip(by_pair, by_texel, strict=True))
