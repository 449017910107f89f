"""Storage of maps: codes with a scale and an offset per component and channel, or floats.

`uint8` spreads 256 codes over the range of every component, whatever it adds to T: the layout of the papers. `adaptive`
gives all components the same error of T instead. What a component adds to the mean squared error of T is its own times
its gain, so its step is d / sqrt(gain): a component then has as many bits as its spread has steps, and one whose values
all lie within a step has none. That is the least error for the bits (reverse water-filling), and d follows from what
the model leaves out anyway: `SHARE` of that may be lost, on top of what `uint8` would lose. The codes are still bytes,
so that such a model opens as any other; entropy coding (`data.code_stream`) turns the bits into a smaller file.

Test: tests/compress/test_quantize.py
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

Storage = Literal["uint8", "float16", "float32", "adaptive"]


PART = 1 << 16
"""Values of each component and channel that are turned into codes at a time."""

SHARE = 0.02
"""Of the squared error of a model, what adaptive steps may add to it: 0.09 dB."""

SAMPLE = 4096
"""Values of each component and channel that its step is chosen from."""


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


class Spread(NamedTuple):
    """What the step of a component is chosen from.

    Attributes:
        low: (channel) least value.
        high: (channel) largest value.
        sample: (value, channel) every so many values, less their mean.
    """

    low: Float[Tensor, "channel"]
    high: Float[Tensor, "channel"]
    sample: Float[Tensor, "value channel"]


def dtype_of(storage: Storage) -> torch.dtype:
    """Return the type of codes in `storage`."""
    return torch.uint8 if storage == "adaptive" else getattr(torch, storage)


def spread(values: Float[Tensor, "*batch channel"]) -> Spread:
    """Return the spread of one component."""
    flat = values.reshape(-1, values.shape[-1]).float()
    sample = flat[:: -(-len(flat) // SAMPLE)]
    return Spread(flat.amin(0), flat.amax(0), sample - sample.mean(0))


def steps(
    spreads: Sequence[Spread], gain: Float[Tensor, "rank"], lost: float, share: float = SHARE
) -> Float[Tensor, "rank channel"]:
    """Return the adaptive steps of all components.

    Args:
        spreads: of each component.
        gain: mean squared error of T for a mean squared error of 1 of a component, over all that T is a table of.
        lost: mean squared error of T that the model has before it is quantised.
        share: of `lost`, what may be added to it.
    """
    sample, range_ = torch.stack([s.sample for s in spreads]), _ranges(spreads)
    eight_bits = float((gain.double()[:, None] * (range_ / 255).square()).mean(1).sum()) / 12
    spare = eight_bits + share * (lost + eight_bits)

    def error(d: float) -> float:
        step = equal_steps(spreads, gain, d)[:, None]
        found = (sample - (sample / step).round_() * step).square_().mean((1, 2), dtype=torch.float64)
        return float((gain.double() * found).sum())

    fine, coarse = -60.0, math.log(coarsest(spreads, gain))
    for _ in range(32):
        middle = (fine + coarse) / 2
        fine, coarse = (middle, coarse) if error(math.exp(middle)) <= spare else (fine, middle)
    return equal_steps(spreads, gain, math.exp(fine))


def equal_steps(spreads: Sequence[Spread], gain: Float[Tensor, "rank"], d: float) -> Float[Tensor, "rank channel"]:
    """Return the steps with which all components have the same error of T, d / sqrt(gain).

    Where a byte has not as many codes (256, and the mean lies on one of them), a component has larger ones.
    """
    step = torch.maximum(d / gain.double().sqrt()[:, None], _ranges(spreads) / 254)
    return step.float().clamp(min=torch.finfo(torch.float32).tiny)


def coarsest(spreads: Sequence[Spread], gain: Float[Tensor, "rank"]) -> float:
    """Return a d from which on all codes are 0."""
    return max(3 * float((_ranges(spreads) * gain.double().sqrt()[:, None]).amax()), 1e-20)


def _ranges(spreads: Sequence[Spread]) -> Float[Tensor, "rank channel"]:
    return torch.stack([s.high - s.low for s in spreads]).double()


def quantize(
    values: Float[Tensor, "*batch rank channel"], storage: Storage, step: Float[Tensor, "rank channel"] | None = None
) -> Codes:
    """Return `values` in `storage`; uint8 spreads its 256 codes over the range of each component and channel.

    float16 keeps eleven bits relative to the largest value, so that maps of any range fit. adaptive takes the `step`
    of each component and channel.
    """
    flat = values.reshape(-1, *values.shape[-2:])
    low, high = flat.amin(0), flat.amax(0)
    if storage == "adaptive":
        assert step is not None
        return _stepped(values, low, high, step)
    if storage == "uint8":
        step = ((high - low) / 255).clamp(min=torch.finfo(torch.float32).tiny)
        return Codes(_codes(flat, low, step).reshape(values.shape), step, low)
    zero = torch.zeros_like(low)
    if storage == "float16":
        size = torch.maximum(high.abs(), low.abs()).clamp(min=torch.finfo(torch.float32).tiny)
        return Codes((values / size).to(torch.float16), size, zero)
    return Codes(values.float(), torch.ones_like(low), zero)


def one_by_one(
    values: Float[Tensor, "*batch rank channel"], storage: Storage, step: Float[Tensor, "rank channel"] | None = None
) -> Codes:
    """Return `quantize` of each component alone: the same bits as of one that is all there is, and no large copies."""
    parts = [
        quantize(values[..., k : k + 1, :], storage, None if step is None else step[k : k + 1])
        for k in range(values.shape[-2])
    ]
    codes, scale, offset = zip(*parts, strict=True)
    return Codes(torch.cat(codes, -2), torch.cat(scale), torch.cat(offset))


def _stepped(values: Tensor, low: Tensor, high: Tensor, step: Tensor) -> Codes:
    flat = values.reshape(-1, *values.shape[-2:])
    # The mean lies on a code, so that a component without bits is its mean.
    mean = flat.mean(0, dtype=torch.float64).float()
    offset = mean - step * ((mean - low) / step).round()
    codes = _codes(flat, offset, step)
    # Codes are spread over the byte: means of texels, in the levels of a pyramid, are rounded to a byte again.
    unit = 255 // codes.amax((0, 2)).clamp(min=1)
    return Codes((codes * unit[:, None]).reshape(values.shape), step / unit[:, None], offset)


def _codes(flat: Tensor, offset: Tensor, step: Tensor) -> Tensor:
    codes = torch.empty(flat.shape, dtype=torch.uint8)
    for part, place in zip(flat.split(PART), codes.split(PART), strict=True):  # copies of all would be large
        place[...] = ((part - offset) / step).round_().clamp_(0, 255)
    return codes
