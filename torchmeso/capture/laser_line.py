"""Where the laser's stripe lies in a frame, from the part that shows only the flat turntable.

wang2005mdf, section 3.2 and Fig. 5a: the frame is smoothed by a Gaussian, the brightest pixel of every column of the
reference region is a candidate if it is above a threshold, and a line is fitted to the candidates. Here the peak is
found below a pixel from the samples a, b, c around it (b the largest),

    parabola   (a - c) / (2 (a - 2 b + c))          gaussian   the parabola of log a, log b, log c
    centroid   sum x I / sum I of what exceeds half the peak's height

and the line is fitted by total least squares with Tukey's weights, from the best of the lines through pairs.
Lines are a x + b y = c in pixels, (a, b) unit; pixel centres are at (i + 0.5).

Test: tests/capture/test_laser_line.py          Reference: tests/reference/laser_line.py
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from torchmeso.errors import ConfigError, check_range, check_shape

Peak = Literal["parabola", "centroid", "gaussian"]

BLOCK_BYTES = 64 << 20
"""Frames are searched in blocks of about this size in float32."""

TUKEY = 4.685
"""Width of Tukey's weight in standard deviations: 95 % efficient on normal noise."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LineSearch:
    """How a line is looked for.

    Attributes:
        across: the picture axis nearest to the stripe's motion: "y" finds one peak per column, "x" one per row.
        sigma: of the Gaussian filter in pixels, 0 to 20.
        threshold: least value of a candidate after the filter, in the frames' unit (8-bit frames: 0 to 255).
        peak: how it is found below a pixel.
        least: fewest candidates that make a line.
    """

    across: Literal["x", "y"] = "y"
    sigma: float = 1.0
    threshold: float = 30.0
    peak: Peak = "gaussian"
    least: int = 10

    def __post_init__(self) -> None:
        """Raise ConfigError for values out of range."""
        check_range("line.sigma", self.sigma, 0, 20)
        check_range("line.least", self.least, 2, 1 << 20)
        if self.across not in ("x", "y"):
            raise ConfigError(f"line.across: expected 'x' or 'y', got '{self.across}'")
        if self.peak not in ("parabola", "centroid", "gaussian"):
            raise ConfigError(f"line.peak: expected parabola, centroid or gaussian, got '{self.peak}'")


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class LaserLines:
    """The line of every frame.

    Attributes:
        line: (frame, 3) float64 a, b, c of a x + b y = c in pixels; NaN where the frame shows none.
        rms: (frame) weighted distance of the candidates from the line, pixels; NaN where there is none.
        count: (frame) candidates that agree with the line (weight > 0).
    """

    line: Float[Tensor, "frame 3"]
    rms: Float[Tensor, "frame"]
    count: Shaped[Tensor, "frame"]

    @property
    def found(self) -> Bool[Tensor, "frame"]:
        """Whether the frame shows a line."""
        return self.line[:, 0].isfinite()


def measure(
    frames: Shaped[Tensor, "frame H W"], region: Bool[Tensor, "H W"], search: LineSearch = LineSearch()
) -> LaserLines:
    """Return the laser's line in every frame.

    Args:
        frames: (frame, H, W) brightness, uint8 or float; a memory map is read block by block.
        region: (H, W) true where only the turntable is seen.
        search: thresholds and methods.

    Raises:
        ShapeError: frames or region have another shape.
        ConfigError: the region is empty.
    """
    check_shape("frames", frames, (-1, -1, -1))
    check_shape("region", region, tuple(frames.shape[1:]))
    if not bool(region.any()):
        raise ConfigError("region: expected some pixels that show only the turntable, got none")
    parts = [fit_lines(*peaks(block, region, search), search.least) for block in _blocks(frames)]
    return LaserLines(
        line=torch.cat([p.line for p in parts]) if parts else torch.zeros(0, 3, dtype=torch.float64),
        rms=torch.cat([p.rms for p in parts]) if parts else torch.zeros(0, dtype=torch.float64),
        count=torch.cat([p.count for p in parts]) if parts else torch.zeros(0, dtype=torch.int64),
    )


def peaks(
    frames: Shaped[Tensor, "frame H W"], region: Bool[Tensor, "H W"], search: LineSearch
) -> tuple[Float[Tensor, "frame n 2"], Bool[Tensor, "frame n"]]:
    """Return one candidate per column (row, where across is "x") in pixels, and whether it is one."""
    smooth = gaussian_filter(frames, search.sigma)
    inside = region
    if search.across == "x":
        smooth, inside = smooth.mT, inside.mT
    height = smooth.shape[1]
    masked = torch.where(inside, smooth, -torch.inf)
    best, row = masked.max(1)
    # A peak on the border of the frame has no neighbour to be found from below a pixel.
    valid = (best >= search.threshold) & (row > 0) & (row < height - 1)
    offset = _SUBPIXEL[search.peak](smooth, row.clamp(1, max(height - 2, 1)), best)
    y = row + 0.5 + offset
    x = (torch.arange(smooth.shape[2]) + 0.5).expand_as(y)
    xy = torch.stack([x, y] if search.across == "y" else [y, x], -1).double()
    return xy, valid & offset.isfinite()


def gaussian_filter(frames: Shaped[Tensor, "frame H W"], sigma: float) -> Float[Tensor, "frame H W"]:
    """Return frames smoothed by a Gaussian of `sigma` pixels, the border repeated; float32 unless float64."""
    frames = frames if frames.dtype == torch.float64 else frames.float()
    if sigma == 0:
        return frames
    radius = math.ceil(4 * sigma)
    x = torch.arange(-radius, radius + 1, dtype=frames.dtype)
    kernel = torch.exp(-0.5 * (x / sigma).square())
    kernel = kernel / kernel.sum()
    whole = F.pad(frames.unsqueeze(1), (radius,) * 4, mode="replicate")
    return F.conv2d(F.conv2d(whole, kernel.view(1, 1, -1, 1)), kernel.view(1, 1, 1, -1)).squeeze(1)


def parabola(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Return where the parabola through a, b, c at -1, 0, 1 peaks; 0 where the three are on a line."""
    bend = a - 2 * b + c
    return torch.where(bend < 0, 0.5 * (a - c) / bend.clamp(max=-1e-30), torch.zeros_like(b)).clamp(-0.5, 0.5)


def gaussian(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Return where the Gaussian through a, b, c at -1, 0, 1 peaks; samples are lifted to a thousandth of the peak."""
    low = 1e-3 * b.clamp(min=1e-30)
    return parabola(*(x.maximum(low).log() for x in (a, b, c)))


def fit_lines(xy: Float[Tensor, "frame n 2"], valid: Bool[Tensor, "frame n"], least: int) -> LaserLines:
    """Return the line that most candidates of each frame agree on, by total least squares."""
    weight = _first_guess(xy, valid)
    line = _total_least_squares(xy, weight)
    for _ in range(10):
        away = (xy * line[:, None, :2]).sum(-1) - line[:, None, 2]
        scale = _median(away.abs(), weight > 0) * 1.4826  # of a normal distribution
        u = away / (TUKEY * scale.clamp(min=1e-3)).unsqueeze(1)
        weight = torch.where(valid, (1 - u.square()).clamp(min=0).square(), 0)
        line = _total_least_squares(xy, weight)
    away = (xy * line[:, None, :2]).sum(-1) - line[:, None, 2]
    rms = ((weight * away.square()).sum(1) / weight.sum(1)).sqrt()
    count = (weight > 0).sum(1)
    # A line needs length: candidates in one spot fit any direction.
    found = (count >= least) & line.isfinite().all(1)
    nan = torch.full_like(rms, torch.nan)
    return LaserLines(
        line=torch.where(found[:, None], line, nan[:, None]), rms=torch.where(found, rms, nan), count=count
    )


def _first_guess(xy: Tensor, valid: Tensor) -> Tensor:
    """Return weights 1 for the candidates near the line, of 64 through pairs, with the least median distance."""
    n_pair = 64
    order = torch.where(valid, torch.arange(valid.shape[1]), valid.shape[1]).sort(1).values  # candidates first
    n = valid.sum(1, keepdim=True).clamp(min=1)
    rng = torch.Generator().manual_seed(0)
    u = torch.rand(2, n_pair, generator=rng, dtype=torch.float64)
    first, second = (order.gather(1, (x * n).long().clamp(max=valid.shape[1] - 1)) for x in u)
    last = valid.shape[1] - 1
    p, q = (xy.gather(1, i.clamp(max=last)[..., None].expand(-1, -1, 2)) for i in (first, second))
    normal = torch.stack([q[..., 1] - p[..., 1], p[..., 0] - q[..., 0]], -1)
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp(min=1e-12)
    away = ((xy[:, None] - p[:, :, None]) * normal[:, :, None]).sum(-1).abs()  # (frame, pair, n)
    away = torch.where(valid[:, None] & (normal.norm(dim=-1) > 0.5)[..., None], away, torch.inf)
    middle = away.sort(-1).values.gather(2, (n // 2)[..., None].expand(-1, n_pair, 1).clamp(max=last)).squeeze(2)
    best = middle.argmin(1)
    pick = torch.arange(len(xy))
    return (away[pick, best] <= (2.5 * middle[pick, best].clamp(min=0.2))[:, None]).to(xy.dtype)


def _total_least_squares(xy: Tensor, weight: Tensor) -> Tensor:
    total = weight.sum(1, keepdim=True).clamp(min=1e-12)
    mean = (xy * weight[..., None]).sum(1) / total
    d = (xy - mean[:, None]) * (weight[..., None] > 0)
    spread = torch.einsum("fni,fnj,fn->fij", d, d, weight)
    normal = torch.linalg.eigh(spread).eigenvectors[..., 0]
    # The sign is fixed, so that neighbouring frames can be interpolated.
    normal = normal * torch.where(normal.sum(1, keepdim=True) < 0, -1.0, 1.0)
    return torch.cat([normal, (normal * mean).sum(1, keepdim=True)], 1)


def _median(x: Tensor, among: Tensor) -> Tensor:
    ranked = torch.where(among, x, torch.inf).sort(1).values
    middle = ranked.gather(1, (among.sum(1, keepdim=True) // 2).clamp(max=x.shape[1] - 1)).squeeze(1)
    return torch.where(middle.isfinite(), middle, 0)


def _from_three(formula: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Callable[[Tensor, Tensor, Tensor], Tensor]:
    def offset(smooth: Tensor, row: Tensor, best: Tensor) -> Tensor:
        a, c = (smooth.gather(1, (row + d).unsqueeze(1)).squeeze(1) for d in (-1, 1))
        return formula(a, best, c)

    return offset


def _centroid(smooth: Tensor, row: Tensor, best: Tensor) -> Tensor:
    """Return the centre of mass of the part around the peak that exceeds half its height over the background."""
    reach = 8
    steps = torch.arange(-reach, reach + 1)
    at = (row.unsqueeze(1) + steps[:, None]).clamp(0, smooth.shape[1] - 1)
    value = smooth.gather(1, at)
    half = 0.5 * (best + smooth.median(1).values)
    above = (value - half.unsqueeze(1)).clamp(min=0)
    x = steps.to(value.dtype)[:, None]
    return (above * x).sum(1) / above.sum(1)


_SUBPIXEL = {"parabola": _from_three(parabola), "gaussian": _from_three(gaussian), "centroid": _centroid}


def _blocks(frames: Tensor) -> Iterator[Tensor]:
    size = max(1, BLOCK_BYTES // (4 * frames.shape[1] * frames.shape[2]))
    for start in range(0, len(frames), size):
        yield frames[start : start + size]
