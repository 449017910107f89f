"""Storage of maps: uint8 codes with a scale and an offset per component and channel, or floats.

Test: tests/compress/test_quantize.py
"""

from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

Storage = Literal["uint8", "float16", "float32"]


PART = 1 << 16
"""Values of each component and channel that are turned into codes at a time."""


class Codes(NamedTuple):
    """Quantised values: value = offset + scale * code.

    Attributes:
        codes: (..., rank, channel) in the storage type; channels are rgb, or one for all of them.
        scale: (rank, channel) float32.
        offset: (rank, channel) float32.
    """

    codes: Shaped[Tensor, "*batch rank channel"]
    scale: Float[Tensor, "rank channel"]
    offset: Float[Tensor, "rank channel"]


def quantize(values: Float[Tensor, "*batch rank channel"], storage: Storage) -> Codes:
    """Return `values` in `storage`; uint8 spreads its 256 codes over the range of each component and channel.

    float16 keeps eleven bits relative to the largest value, so that maps of any range fit.
    """
    flat = values.reshape(-1, *values.shape[-2:])
    low, high = flat.amin(0), flat.amax(0)
    if storage == "uint8":
        step = ((high - low) / 255).clamp(min=torch.finfo(torch.float32).tiny)
        codes = torch.empty(flat.shape, dtype=torch.uint8)
        for part, place in zip(flat.split(PART), codes.split(PART), strict=True):  # copies of all would be large
            place[...] = ((part - low) / step).round_().clamp_(0, 255)
        return Codes(codes.reshape(values.shape), step, low)
    zero = torch.zeros_like(low)
    if storage == "float16":
        size = torch.maximum(high.abs(), low.abs()).clamp(min=torch.finfo(torch.float32).tiny)
        return Codes((values / size).to(torch.float16), size, zero)
    return Codes(values.float(), torch.ones_like(low), zero)
