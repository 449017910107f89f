"""A plain surface with pictures: diffuse colour and normal map, beside BTFs.

    T(uv, wi, wo) = albedo(uv) max(0, n(uv) . wi),      L_a(uv, wo) = albedo(uv) (1 + n_z(uv)) / 2

n is the map's normal in the local frame, which is left-handed where the texture is mirrored, so a mirrored map leans
the right way. Light from below the surface itself is dark: L_a is the integral over what is left of the hemisphere.
Colours are decoded from sRGB once, when they are read, and interpolated as light.

Kernel: kernels_cl/data/textured.clh          Test: tests/data/test_textured.py
"""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data import address, image, pyramid
from torchmeso.data.pyramid import Footprint
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.errors import check_shape
from torchmeso.geometry.directions import dot, normalize
from torchmeso.geometry.mesh_file import Finish


@dataclass(frozen=True, eq=False, kw_only=True)
class Textured:
    """Pictures that repeat with period 1, of any two sizes; row 0 at v near 1.

    Attributes:
        albedo: (H, W, 3) linear RGB; 1 x 1 where it is uniform.
        normals: (H2, W2, 3) in the local frame, of any length, or None = (0, 0, 1).
        quilting: a larger texture made of the pictures' texels, or None: the pictures repeat.
    """

    albedo: Float[Tensor, "H W 3"]
    normals: Float[Tensor, "_ _ 3"] | None = None
    quilting: QuiltingMap | None = None

    def __post_init__(self) -> None:
        """Raise ShapeError unless these are pictures."""
        check_shape("textured.albedo", self.albedo, (-1, -1, 3))
        if self.normals is not None:
            check_shape("textured.normals", self.normals, (-1, -1, 3))

    def evaluate(
        self,
        uv: Float[Tensor, "*batch 2"],
        wi: Float[Tensor, "*batch 3"],
        wo: Float[Tensor, "*batch 3"],
        seen: Footprint | None = None,
    ) -> Float[Tensor, "*batch 3"]:
        """Return T(uv, wi, wo), linear RGB; local frame, 0 for wi below the horizon. `wo` changes nothing.

        Over what is `seen`, colour and normal are averaged apart.
        """
        cosine = dot(self.normal(uv, seen), wi).clamp(min=0)
        lit = torch.where(wi[..., 2] > 0, cosine, 0).unsqueeze(-1)
        return self.colour(uv, seen) * lit

    def ambient(
        self, uv: Float[Tensor, "*batch 2"], wo: Float[Tensor, "*batch 3"], seen: Footprint | None = None
    ) -> Float[Tensor, "*batch 3"]:
        """Return L_a(uv, wo) = (1/pi) times the integral of T over the light hemisphere (white: 1)."""
        return self.colour(uv, seen) * (0.5 * (1 + self.normal(uv, seen)[..., 2:]))

    def colour(self, uv: Float[Tensor, "*batch 2"], seen: Footprint | None = None) -> Float[Tensor, "*batch 3"]:
        """Return the albedo at uv."""
        return _look_up(self.albedo_levels, uv, seen, self.quilting)

    def normal(self, uv: Float[Tensor, "*batch 2"], seen: Footprint | None = None) -> Float[Tensor, "*batch 3"]:
        """Return the unit normal n(uv) in the local frame."""
        if self.normal_levels is None:
            return torch.tensor([0.0, 0.0, 1.0], dtype=uv.dtype).expand(*uv.shape[:-1], 3)
        return normalize(_look_up(self.normal_levels, uv, seen, self.quilting))

    @cached_property
    def albedo_levels(self) -> list[Float[Tensor, "_ _ 3"]]:
        """The colours, and their means over ever more texels."""
        return pyramid.build(self.albedo, 0)

    @cached_property
    def normal_levels(self) -> list[Float[Tensor, "_ _ 3"]] | None:
        """The normals, likewise."""
        return None if self.normals is None else pyramid.build(normalize(self.normals), 0)


def from_finish(finish: Finish) -> Textured:
    """Return the pictures of a look, decoded.

    Raises:
        FormatError: a picture is missing or unreadable.
    """
    albedo = torch.tensor(finish.albedo, dtype=torch.float32)[None, None]
    if finish.albedo_map is not None:
        albedo = albedo * image.read(finish.albedo_map)
    normals = None
    if finish.normal_map is not None:
        scale = torch.tensor([finish.normal_scale, finish.normal_scale, 1.0])
        normals = (2 * image.read_vectors(finish.normal_map) - 1) * scale
    return Textured(albedo=albedo, normals=normals)


def _look_up(levels: list[Tensor], uv: Tensor, seen: Footprint | None, quilting: QuiltingMap | None) -> Tensor:
    def at(_: Tensor, uv: Tensor, level: int) -> Tensor:
        picture = levels[level]
        taps = address.of_level(uv, picture.shape[0], picture.shape[1], level, quilting)
        return (picture.reshape(-1, 3).to(uv.dtype)[taps.texel] * taps.weight.unsqueeze(-1)).sum(-2)

    return pyramid.average(at, uv, seen, max(levels[0].shape[:2]), len(levels))
