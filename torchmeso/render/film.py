"""The finished picture: colour, depth and what each pixel shows.

Test: tests/render/test_film.py
"""

from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.data import image
from torchmeso.errors import ConfigError


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Picture:
    """A rendered frame; row 0 on top.

    Attributes:
        rgb: (H, W, 3) linear radiance.
        depth: (H, W) distance along the pixel's ray to what is seen; inf where nothing is.
        owner: (H, W) object seen; -1 = background, -2 = the inside of an object the eye is in.
        shadowed: (light, H, W) whether a light is blocked at what is seen.
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
