"""Fit a factored BTF: the factors of `compress.dfmf`, and how many components it needs when it is opened.

A factored BTF opens as the eigen BTF of the table that it stands for. Its rank is the least one that adds no more than
`SHARE` to the squared error that the factors have: with a colour model that is linear it is bounded by theirs, with
logarithms it is not.

Test: tests/compress/test_factored.py
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra.gram import gram
from torchmeso.compress import dfmf, eigen
from torchmeso.compress.dfmf import DfmfOptions
from torchmeso.compress.eigen import EigenOptions
from torchmeso.data import bands
from torchmeso.data.btf import Bands
from torchmeso.data.btfdbb_colour import Colour
from torchmeso.data.eigen_btf import EigenBtf
from torchmeso.data.factored_btf import FactoredBtf
from torchmeso.data.journal import Parts
from torchmeso.errors import check_range

COLOURS = {"rgb": Colour(0), "yuv": Colour(1), "log-y": Colour(11)}
"""Channels by name; log-y is log Y, U/Y, V/Y, which Bonn's files have."""

SHARE = 0.05
"""Of the squared error of the factors, what opening them may add: 0.2 dB."""

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class FactoredOptions:
    """How to compress.

    Attributes:
        rank: components of each channel.
        colour: what the channels are. Logarithms are for materials whose darks matter most: a few components of them
            ring, and an exponential makes highlights of it.
    """

    rank: int = 16
    colour: Literal["rgb", "yuv", "log-y"] = "rgb"


def fit(
    btf: Bands,
    options: FactoredOptions | None = None,
    *,
    kept: Parts | None = None,
    progress: Progress = lambda share: None,
) -> FactoredBtf:
    """Return the factored BTF of `btf`, its factors rounded to halves as files have them.

    Args:
        btf: in memory or on disk; read seven times.
        options: rank and colour model.
        kept: keeps what each pass over the table gives; a run that was killed goes on from there.
        progress: called with the share done, 0..1.

    Raises:
        ConfigError: the rank is out of range.
        ShapeError: a value is not finite, or negative where the colour model takes logarithms.
    """
    options = options or FactoredOptions()
    height, width = btf.texels
    n_light, n_view = len(btf.lights), len(btf.views)
    colour = COLOURS[options.colour]
    chosen = check(btf, options)
    factors = dfmf.fit(btf, chosen, kept=kept, progress=lambda share: progress(0.8 * share))
    # Rows of P are pairs, the light first; rows of S begin with the lowest row of texels.
    by_pair = torch.stack([P.unflatten(0, (n_view, n_light)).transpose(0, 1) for P, _ in factors])
    by_texel = torch.stack([S.unflatten(0, (height, width)).flip(0) for _, S in factors])
    by_pair, by_texel = _balanced(by_pair, by_texel)
    model = FactoredBtf(
        by_pair=by_pair.half().float(), by_texel=by_texel.half().float(), colour=colour, opened_rank=n_view,
        lights=btf.lights, views=btf.views,
    )  # fmt: skip
    error, total = _beside(btf, model, lambda share: progress(0.8 + 0.2 * share))
    left_out = torch.linalg.eigvalsh(total).clamp(min=0).cumsum(0).flip(0)  # by 0, 1, ... components
    needed = int((left_out > SHARE * error).sum())
    return replace(model, opened_rank=min(n_view, max(1, needed)))


def _balanced(by_pair: Float[Tensor, "3 light view k"], by_texel: Float[Tensor, "3 H W k"]) -> tuple[Tensor, Tensor]:
    """Return factors whose largest values are as large in both: halves end at 65,504, their products at 4e9."""
    largest = [
        x.abs().amax((1, 2), keepdim=True).clamp(min=torch.finfo(torch.float32).tiny) for x in (by_pair, by_texel)
    ]
    factor = (largest[1] / largest[0]).sqrt()
    return by_pair * factor, by_texel / factor


def check(btf: Bands, options: FactoredOptions) -> DfmfOptions:
    """Return how each channel is factored.

    Raises:
        ConfigError: the rank is out of range.
    """
    height, width = btf.texels
    check_range("compress.rank", options.rank, 1, min(len(btf.lights) * len(btf.views), height * width))
    return DfmfOptions(rank=options.rank, colour=COLOURS[options.colour])


def opened(model: FactoredBtf, rank: int | None = None) -> EigenBtf:
    """Return the eigen BTF of eight bits that `model` is drawn as, of at most `rank` components.

    It takes two passes over all values that the model stands for, a band of texel rows at a time.
    """
    kept = model.opened_rank if rank is None else max(1, min(rank, model.opened_rank))
    return eigen.fit(model, EigenOptions(rank=kept))


def _beside(btf: Bands, model: FactoredBtf, progress: Progress) -> tuple[float, Float[Tensor, "view view"]]:
    """Return the squared error of the model, and the Gram matrix over views of what it shows."""
    n_view = len(btf.views)
    total, error = torch.zeros(n_view, n_view, dtype=torch.float64), 0.0
    for band in bands.ahead(btf, bands.layout(btf)):
        for row in range(band.stored.shape[2]):
            shown = model.rows(band.rows.start + row, band.rows.start + row + 1)[:, :, 0]
            error += float((shown - bands.linear_row(btf, band, row)).square().sum(dtype=torch.float64))
            total += gram([shown.permute(0, 2, 3, 1).reshape(-1, n_view)], n_view)
        progress(band.rows.stop / btf.texels[0])
    return error, total
