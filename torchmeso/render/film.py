"""The finished picture: colour, depth and what each pixel shows.

Test: tests/render/test_film.py
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.data import image
from torchmeso.errors import ConfigError
from torchmeso.geometry.camera import Camera


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Picture:
    """A rendered frame; row 0 on top.

    Attributes:
        rgb: (H, W, 3) linear radiance.
        depth: (H, W) distance along the pixel's ray to what is seen; inf where nothing is.
        owner: (H, W) object seen; -1 = background, -2 = the inside of an object the eye is in.
        shadowed: (light, H, W) whether a light is blocked at what is seen; nowhere for a light that was left out.
        counts: what was done and what was skipped, by name.
        seconds: wall time per stage, by name.
    """

    rgb: Float[Tensor, "H W 3"]
    depth: Float[Tensor, "H W"]
    owner: Int[Tensor, "H W"]
    shadowed: Bool[Tensor, "light H W"]
    counts: dict[str, int]
    seconds: dict[str, float]

    @property
    def coverage(self) -> float:
        """Share of pixels that show an object."""
        return float((self.owner != -1).double().mean())


def average(paint: Callable[[Camera], Picture], cameras: Iterable[Camera]) -> Picture:
    """Return the mean of the pictures of `cameras`: times summed up, all but colour and time from the first.

    Decisions are averaged with everything else: edges, silhouettes and shadows come out smooth.
    """
    first, total, count = None, None, 0
    seconds: dict[str, float] = {}
    for camera in cameras:
        picture = paint(camera)
        if total is None:
            first = replace(picture, depth=picture.depth.clone(), owner=picture.owner.clone())
            total = picture.rgb.double()
        else:
            total += picture.rgb
        for stage, time in picture.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + time
        count += 1
    if first is None or total is None:
        raise ConfigError("average: expected at least one camera, got none")
    return replace(first, rgb=(total / count).to(first.rgb.dtype), seconds=seconds)


def total(pictures: Iterable[Picture]) -> Picture:
    """Return one view under the lights of several pictures: colours of what is seen and times summed up."""
    first, rgb, shadowed = None, None, []
    seconds: dict[str, float] = {}
    for picture in pictures:
        if first is None or rgb is None:
            first = replace(picture, depth=picture.depth.clone(), owner=picture.owner.clone())
            rgb = picture.rgb.double()
        else:
            rgb += picture.rgb * (first.owner >= 0)[..., None]
        shadowed.append(picture.shadowed)
        for stage, time in picture.seconds.items():
            seconds[stage] = seconds.get(stage, 0.0) + time
    if first is None or rgb is None:
        raise ConfigError("total: expected at least one picture, got none")
    return replace(first, rgb=rgb.to(first.rgb.dtype), shadowed=torch.cat(shadowed), seconds=seconds)


def write(picture: Picture, path: str | Path) -> None:
    """Write a picture: .png (sRGB, clipped) or .exr (linear, with a depth channel Z).

    Raises:
        ConfigError: another suffix.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".png":
        image.write_png(path, picture.rgb)
    elif suffix == ".exr":
        image.write_exr(path, picture.rgb, Z=picture.depth)
    else:
        raise ConfigError(f"{path}: expected a name that ends in .png or .exr")
