"""Fit the factors of a decorrelated full matrix factorisation, Bonn's DFMF: one factorisation per colour channel.

The BTF in the numbers of a colour model (log Y, U/Y, V/Y by default, so that the eye's errors and not the highlights
decide) is one matrix of texels x pairs of light and view for each channel. Each is cut to its leading components by
subspace iteration over bands of texel rows: the BTF is never in memory, its factors are. Products are taken texel row
by texel row, so that bands of any height give the same bits.

Test: tests/compress/test_dfmf.py
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra import subspace
from torchmeso.data import bands, btfdbb_colour
from torchmeso.data.btf import Bands
from torchmeso.data.btfdbb_colour import Colour
from torchmeso.data.journal import Parts
from torchmeso.errors import check_range

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


def fit(
    table: Bands,
    options: DfmfOptions | None = None,
    *,
    kept: Parts | None = None,
    progress: Progress = lambda share: None,
) -> Factors:
    """Return for each channel U (pair, rank) and S V (texel, rank) as `data.btfdbb_write.write_dfmf` takes them.

    Args:
        table: in memory or on disk; read six times.
        options: rank and colour model.
        kept: keeps what each pass over the table gives; a run that was killed goes on from there.
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
    layout = bands.layout(table)[::-1]  # files begin at the bottom row
    done = 0

    def blocks() -> Iterator[Float[Tensor, "3 texel pair"]]:
        nonlocal done
        for band in bands.ahead(table, layout):
            for row in reversed(range(band.stored.shape[2])):
                rgb = bands.linear_row(table, band, row)
                x = btfdbb_colour.from_rgb(options.colour, rgb.double() if options.accurate else rgb)
                yield x.permute(3, 2, 1, 0).reshape(3, -1, pairs)
                done += 1
                progress(done / (height * 2 * subspace.ROUNDS))

    def remember(name: str, shape: tuple[int, ...], made: Callable[[], Tensor]) -> Tensor:
        nonlocal done
        if kept is None:
            return made()
        for dtype in (torch.float32, torch.float64):  # told apart by their size
            if kept.has(name, shape, dtype):
                done += height
                return kept.read(name, shape, dtype)
        found = made()
        kept.write(name, found)
        return found

    by_texel, by_pair = subspace.factor(blocks, texels, pairs, 3, rank, remember=remember)
    return list(zip(by_pair, by_texel, strict=True))
