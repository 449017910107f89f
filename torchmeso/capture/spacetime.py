"""When the laser passed each pixel, and from that where the surface is: space-time analysis.

wang2005mdf, section 3.2 and Fig. 5b, after curless1995spacetime: at a pixel the stripe's profile in time is that of
the laser whatever the albedo around the pixel, so the moment t of its peak is unbiased where the place of the peak in
one frame is not. The peak is found below a frame from the samples before, at and after the brightest (as in
`laser_line`); the laser plane at t is interpolated between those of the frames, and with n . x = d there and the ray
x = o + s w of the pixel

    s = (d - n . o) / (n . w),         D = s - s_ref,

s_ref where the ray meets the reference plane z = z_ref: the displacement along the ray that really was taken. A peak
below the threshold means that the laser did not reach the point: a mask, no magic number.

A swept shadow (bouguet1999shadows) has an edge instead of a peak: the moment at which the pixel falls through the mean
of its least and its greatest value.

Frames are read one by one, so memory does not depend on how many there are.

Test: tests/capture/test_spacetime.py          Reference: tests/reference/spacetime.py
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from torchmeso.capture.laser_line import gaussian
from torchmeso.errors import ShapeError, check_range, check_shape

Frames = Iterable[Shaped[Tensor, "H W"]]
"""A tensor (frame, H, W), memory-mapped or not, or anything that yields frames (H, W) in order."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Passage:
    """When something passed each pixel.

    Attributes:
        time: (H, W) float32 in frames, 0 = the first; 0 where not valid.
        strength: (H, W) float32 height of the peak, or of the edge, in the frames' unit.
        valid: (H, W) true where it passed once, and above the threshold.
        passes: (H, W) uint8 how often the threshold was reached from below (peaks; 255 = that or more).
    """

    time: Float[Tensor, "H W"]
    strength: Float[Tensor, "H W"]
    valid: Bool[Tensor, "H W"]
    passes: Shaped[Tensor, "H W"]


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Displacement:
    """Distances below the reference plane along the rays of the pixels.

    Attributes:
        distance: (H, W) D along the ray, in the rig's unit; 0 where not valid. Negative above the plane.
        valid: (H, W) true where the surface was found.
        sigma: (H, W) change of D per frame of time: what an error of the peak costs, in the rig's unit per frame.
    """

    distance: Float[Tensor, "H W"]
    valid: Bool[Tensor, "H W"]
    sigma: Float[Tensor, "H W"]


def laser_passage(frames: Frames, threshold: float) -> Passage:
    """Return when each pixel was brightest, below a frame by the Gaussian through three samples.

    Of a plateau (saturation) the middle is taken. Peaks in the first and the last frame are not valid: they may go
    on outside. Pixels that reach the threshold twice are not valid either: one of the two is an interreflection.

    Args:
        frames: of (H, W), uint8 or float.
        threshold: least value at which a pixel is lit by the laser, in the frames' unit.

    Raises:
        ShapeError: fewer than three frames, or frames of different size.
    """
    check_range("laser threshold", threshold, 1e-12, 1e12)
    state, count = None, 0
    for frame in frames:
        state = _first(frame, threshold) if state is None else _brighter(state, frame, count, threshold)
        count += 1
    if state is None or count < 3:
        raise ShapeError(f"laser frames: expected at least 3, got {count}")
    a, b, c = (state[k].float() for k in ("before", "best", "after"))
    wide = state["width"].float()
    offset = torch.where(wide > 1, 0.5 * (wide - 1), gaussian(a, b, c))
    ends = state["at"] + wide
    valid = (b >= threshold) & (state["at"] > 0) & (ends < count) & (state["passes"] == 1)
    time = torch.where(valid, state["at"] + offset, 0)
    return Passage(time=time, strength=b, valid=valid, passes=state["passes"])


def _first(frame: Tensor, threshold: float) -> dict[str, Tensor]:
    check_shape("frame", frame, (-1, -1))
    frame = frame.clone()
    lit = frame >= threshold
    return {
        "best": frame,
        "before": torch.zeros_like(frame),
        "after": torch.zeros_like(frame),
        "previous": frame,
        "at": torch.zeros(frame.shape, dtype=torch.float32),
        "width": torch.ones(frame.shape, dtype=torch.uint8),
        "rose": torch.ones_like(lit),
        "flat": torch.ones_like(lit),
        "lit": lit,
        "passes": lit.to(torch.uint8),
    }


def _brighter(s: dict[str, Tensor], frame: Tensor, index: int, threshold: float) -> dict[str, Tensor]:
    """Return the state after one more frame; everything is kept per pixel, nothing per frame."""
    if frame.shape != s["best"].shape:
        raise ShapeError(
            f"laser frame {index}: expected {tuple(s['best'].shape)} pixels as before, got {tuple(frame.shape)}"
        )
    rises = frame > s["best"]
    flat = s["flat"] & (frame == s["best"])  # the plateau that began at the best frame goes on
    lit = frame >= threshold
    passes = s["passes"] + (lit & ~s["lit"])
    return {
        "best": torch.maximum(s["best"], frame),
        "before": torch.where(rises, s["previous"], s["before"]),
        "after": torch.where(s["rose"], frame, s["after"]),
        "previous": frame,
        "at": s["at"].masked_fill(rises, index),
        "width": (s["width"] + flat).masked_fill(rises, 1),
        "rose": rises,
        "flat": flat | rises,
        "lit": lit,
        "passes": torch.where(passes < s["passes"], s["passes"], passes),
    }


def shadow_passage(frames: Callable[[], Frames], contrast: float) -> Passage:
    """Return when the edge of a swept shadow reached each pixel: its first fall through the middle of its range.

    Args:
        frames: a function that yields the frames anew; they are read twice.
        contrast: least difference of a pixel's greatest and least value, in the frames' unit.

    Raises:
        ShapeError: fewer than two frames.
    """
    check_range("shadow contrast", contrast, 1e-12, 1e12)
    low, high = extremes(frames())
    middle = 0.5 * (low.float() + high.float())
    previous = None
    time = torch.full(low.shape, torch.nan)
    passes = torch.zeros(low.shape, dtype=torch.uint8)
    for index, frame in enumerate(frames()):
        now = frame.float() - middle
        if previous is not None:
            falls = (previous >= 0) & (now < 0)
            between = previous / (previous - now).clamp(min=1e-12)
            time = torch.where(falls & time.isnan(), index - 1 + between, time)
            passes = torch.where(falls & (passes < 255), passes + 1, passes)
        previous = now
    strength = high.float() - low.float()
    valid = (strength >= contrast) & time.isfinite()
    return Passage(time=torch.where(valid, time, 0), strength=strength, valid=valid, passes=passes)


def extremes(frames: Frames) -> tuple[Shaped[Tensor, "H W"], Shaped[Tensor, "H W"]]:
    """Return the least and the greatest value of each pixel.

    Raises:
        ShapeError: fewer than two frames.
    """
    low = high = None
    count = 0
    for frame in frames:
        low = frame.clone() if low is None else torch.minimum(low, frame)
        high = frame.clone() if high is None else torch.maximum(high, frame)
        count += 1
    if low is None or high is None or count < 2:
        raise ShapeError(f"shadow frames: expected at least 2, got {count}")
    return low, high


def shadow_edge(
    frame: Shaped[Tensor, "H W"], middle: Float[Tensor, "H W"], region: Bool[Tensor, "H W"]
) -> tuple[Float[Tensor, "H 2"], Bool[Tensor, "H"]]:
    """Return where each row of `region` falls through `middle` from left to right, in pixels, and whether it does.

    The edge that runs ahead of a shadow moving to the right lies where frame - middle rises with x; this function
    takes the last such crossing, so the region may begin inside the shadow.
    """
    away = torch.where(region, frame.float() - middle, torch.nan)
    crosses = (away[:, :-1] < 0) & (away[:, 1:] >= 0)
    last = torch.where(crosses, torch.arange(crosses.shape[1]), -1).max(1).values
    at = last.clamp(min=0).unsqueeze(1)
    a, b = away.gather(1, at).squeeze(1), away.gather(1, at + 1).squeeze(1)
    x = last + 0.5 + a / (a - b)
    return torch.stack([x, torch.arange(len(frame)) + 0.5], -1), last >= 0


def planes_of_lines(
    line: Float[Tensor, "frame 3"],
    rays_of: Callable[[Tensor], tuple[Tensor, Tensor]],
    *,
    span: float,
    normal: Float[Tensor, "3"],
    source: Float[Tensor, "3"] | None = None,
    height: float = 0.0,
) -> Float[Tensor, "frame 4"]:
    """Return the laser planes (n, d), n . x = d, n unit, that were seen as lines on the plane z = `height`.

    Two points of the line go to the reference plane along their rays. The plane holds them and the laser's source
    where that is known. Otherwise all planes of the scan are parallel, as in wang2005mdf, and the line gives only
    the offset.

    Args:
        line: (frame, 3) a, b, c of a x + b y = c in pixels; NaN gives NaN.
        rays_of: origin and unit directions of pixels, as `CalibratedCamera.rays`.
        span: pixels along the line between its two points.
        normal: (3) unit normal of the parallel planes of the scan; ignored where `source` is known.
        source: (3) where the laser stands, in the rig's frame, or None.
        height: of the plane on which the line was seen, in the rig's unit.
    """
    foot = line[:, :2] * line[:, 2:]
    along = torch.stack([-line[:, 1], line[:, 0]], -1)
    origin, direction = rays_of(torch.stack([foot - span * along, foot + span * along], 1))
    points = origin + direction * ((height - origin[2]) / direction[..., 2:])
    if source is None:
        n = normal.to(line) * torch.ones_like(line[:, :1])
        return torch.cat([n, (n * points.mean(1)).sum(-1, keepdim=True)], -1)
    n = torch.linalg.cross(points[:, 1] - points[:, 0], source.to(line) - points[:, 0])
    n = n / n.norm(dim=-1, keepdim=True)
    # One side for all: planes are interpolated between frames.
    n = n * torch.where((n * normal.to(line)).sum(-1, keepdim=True) < 0, -1.0, 1.0)
    return torch.cat([n, (n * source.to(line)).sum(-1, keepdim=True)], -1)


def plane_at(planes: Float[Tensor, "frame 4"], time: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 4"]:
    """Return the planes at fractional frames, interpolated linearly and not normalised; NaN beyond the known ones."""
    low = time.floor().clamp(0, max(len(planes) - 2, 0)).long()
    part = (time - low).unsqueeze(-1).to(planes)
    return planes[low] * (1 - part) + planes[(low + 1).clamp(max=len(planes) - 1)] * part


def displacement(
    passage: Passage,
    planes: Float[Tensor, "frame 4"],
    origin: Float[Tensor, "3"],
    direction: Float[Tensor, "H W 3"],
    z_ref: float,
) -> Displacement:
    """Return how far below z = `z_ref` each pixel's ray met the surface, by triangulation on the laser plane.

    Args:
        passage: when the laser or the shadow passed.
        planes: (frame, 4) n, d of n . x = d in the rig's frame; NaN where the frame has none.
        origin: (3) the camera's centre of projection.
        direction: (H, W, 3) unit directions away from the camera.
        z_ref: height of the reference plane in the rig's unit.

    Raises:
        ShapeError: sizes do not match.
    """
    check_shape("direction", direction, (*passage.time.shape, 3))
    check_shape("planes", planes, (-1, 4))
    index = passage.valid.nonzero(as_tuple=True)
    time = passage.time[index].double()
    ray, o = direction[index].double(), origin.double()
    planes = planes.double()

    def meet(t: Tensor) -> Tensor:
        plane = plane_at(planes, t)
        return (plane[:, 3] - plane[:, :3] @ o) / (plane[:, :3] * ray).sum(-1)

    s = meet(time)
    drop = s - (z_ref - o[2]) / ray[:, 2]
    # Half a frame to either side: how far the answer moves with time.
    cost = (meet(time + 0.5) - meet(time - 0.5)).abs()
    good = drop.isfinite() & (s > 0)
    out = {name: torch.zeros(passage.time.shape) for name in ("distance", "sigma")}
    out["distance"][index] = torch.where(good, drop, 0).float()
    out["sigma"][index] = torch.where(good & cost.isfinite(), cost, 0).float()
    valid = torch.zeros_like(passage.valid)
    valid[index] = good
    return Displacement(valid=valid, **out)
