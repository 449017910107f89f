"""Minification: pyramids of textures, and where a pixel that covers many texels looks into them.

Eigen maps are linear in what they show, so the mean of a texture's codes is the code of the mean: a level of the
pyramid is exact, whatever light and view it is used with. What a pixel covers is a slanted box: as wide as the pixel
across the view, longer by 1 / cos(theta_o) along it. Up to `MOST_PROBES` places along the box are read, each at the
level whose texels have the area of its share of the box, so that grazing views stay sharp across. Levels blend into
each other around the middle between two (`BLEND`), so that nothing jumps and most look-ups read one level.

Distances are not filtered. A silhouette is a decision, and a mean of depths decides wrongly; jittered frames filter
decisions (`FrameOptions.antialias`).

Kernels: kernels_cl/data/pyramid.clh          Test: tests/data/test_pyramid.py
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

MOST_PROBES = 4
SLANT = 3.0
"""Lengths over widths that one place stands for."""

BLEND = 0.05
"""Levels blend within this distance of the middle between two."""

LEAST_COSINE = math.cos(math.radians(89.5))


class Footprint(NamedTuple):
    """What a pixel covers of a texture.

    Attributes:
        across: (...) shorter side in tile units.
        along: (..., 2) longer side, a vector in texture space.
    """

    across: Float[Tensor, "*batch"]
    along: Float[Tensor, "*batch 2"]


class Probe(NamedTuple):
    """One look-up of those that a pixel needs.

    Attributes:
        uv: (n, 2).
        level: (n) of the pyramid, 0 = the texture itself.
        weight: (n); 0 where the pixel does without it.
    """

    uv: Float[Tensor, "n 2"]
    level: Int[Tensor, "n"]
    weight: Float[Tensor, "n"]


def footprint(wo: Float[Tensor, "*batch 3"], pixel: Float[Tensor, "*batch"]) -> Footprint:
    """Return what a pixel covers that is `pixel` tile units wide where it is seen, from `wo` in the local frame.

    The texture is taken to be as long as wide on the surface, as its texture scale says.
    """
    flat = wo[..., :2]
    away = flat.norm(dim=-1, keepdim=True)
    way = torch.where(away > 1e-12, flat / away.clamp(min=1e-12), flat.new_tensor([1.0, 0.0]))
    return Footprint(pixel, way * (pixel / wo[..., 2].clamp(min=LEAST_COSINE)).unsqueeze(-1))


def probes(uv: Float[Tensor, "n 2"], seen: Footprint, texels: int, levels: int, most: int = MOST_PROBES) -> list[Probe]:
    """Return the look-ups of pixels that cover `seen` around `uv`; their weights sum to 1.

    Args:
        uv: centres.
        seen: what is covered.
        texels: along the longer side of the texture.
        levels: of its pyramid.
        most: places along a pixel.
    """
    length = seen.along.norm(dim=-1)
    count = torch.minimum(length / seen.across.clamp(min=1e-30), length * texels)
    count = (count / SLANT + 0.5).floor().clamp(1, most)
    share = seen.across * length / count * texels**2
    level = (0.5 * torch.log2(share.clamp(min=1e-30))).clamp(0, levels - 1)
    lower = level.floor()
    upper_share = ((level - lower - 0.5) / (2 * BLEND) + 0.5).clamp(0, 1)
    found = []
    for k in range(int(count.max())):
        place = uv + seen.along * ((k + 0.5) / count - 0.5).unsqueeze(-1)
        share = (k < count) / count
        for which, part in ((lower, 1 - upper_share), (lower + 1, upper_share)):
            weight = share * part
            if bool((weight > 0).any()):
                found.append(Probe(place, which.long().clamp(max=levels - 1), weight))
    return found


def average(
    look_up: Callable[[Bool[Tensor, "n"], Float[Tensor, "m 2"], int], Tensor],
    uv: Float[Tensor, "*batch 2"],
    seen: Footprint | None,
    texels: int,
    levels: int,
    most: int = MOST_PROBES,
) -> Tensor:
    """Return the mean of a texture over what is `seen`, or its value at the point where that is None.

    Args:
        look_up: returns (m, ...) values of the points `which` at `uv` in a level.
        uv: (..., 2); (n, 2) where something is seen.
        seen: what is covered.
        texels: along the longer side of the texture.
        levels: of its pyramid.
        most: places along a pixel.

    Returns:
        (..., ...) the shape of uv's points, then that of a value.
    """
    if seen is None:
        value = look_up(torch.ones(uv.shape[:-1].numel(), dtype=torch.bool), uv.reshape(-1, 2), 0)
        return value.reshape(*uv.shape[:-1], *value.shape[1:])
    total: Tensor | None = None
    for probe in probes(uv, seen, texels, levels, most):
        for level in probe.level.unique().tolist():
            which = (probe.level == level) & (probe.weight > 0)
            value = look_up(which, probe.uv[which], level)
            if total is None:
                total = value.new_zeros(len(uv), *value.shape[1:])
            weight = probe.weight[which].reshape(-1, *(1,) * (value.dim() - 1))
            total[which] = total[which] + weight * value
    assert total is not None  # weights sum to 1: there is a probe
    return total


def halve(x: Tensor, dim: int) -> Tensor:
    """Return `x` with half as many texels along `dim` (at least one), each the mean of what it covers; float.

    Where a size is odd, texels are shared out by area.
    """
    size = x.shape[dim]
    half = max(size // 2, 1)
    edges = torch.arange(half + 1, dtype=torch.float64) * size / half
    texel = torch.arange(size, dtype=torch.float64)
    overlap = torch.minimum(edges[1:, None], texel + 1) - torch.maximum(edges[:-1, None], texel)
    share = (overlap.clamp(min=0) * half / size).to(x.dtype)
    moved = torch.movedim(x, dim, 0)
    return torch.movedim((share @ moved.flatten(1)).unflatten(1, moved.shape[1:]), 0, dim)


def build(x: Tensor, rows: int) -> list[Tensor]:
    """Return the levels of a texture down to a single texel, the texture itself first; codes of uint8 are rounded.

    Args:
        x: (..., H, W, ...).
        rows: dimension of H; W follows.
    """
    levels = [x]
    mean = x if x.is_floating_point() and x.dtype != torch.float16 else x.float()
    while max(mean.shape[rows], mean.shape[rows + 1]) > 1:
        mean = halve(halve(mean, rows), rows + 1)
        levels.append(mean if x.is_floating_point() else mean.round())
    return [level.to(x.dtype) for level in levels]
