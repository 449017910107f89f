"""Bake the mesostructure distance function of a tile: one ray per view and texel.

wang2005mdf, section 3 (there measured by laser): D(u, v, wo) is the distance from the reference plane along -wo
to the first material, kept as the drop delta = D cos(theta_o) / h.

Test: tests/meso/test_bake_mdf.py
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso.data import mdf as mdf_data
from torchmeso.data.address import texel_centres
from torchmeso.data.mdf import MIN_COS, Mdf
from torchmeso.data.store import open_blocks, writing
from torchmeso.errors import check_memory, check_range
from torchmeso.geometry import hemisphere
from torchmeso.meso.mesostructure import Mesostructure
from torchmeso.transport.tracer import TileTracer

ABOVE = 1e-4
"""Rays start this far (tile units) above the reference plane, so that material on the plane itself is hit."""

MEMORY_LIMIT = 8 << 30


@dataclass(frozen=True, slots=True, kw_only=True)
class MdfOptions:
    """How to bake an MDF.

    Attributes:
        texels: side of the texture.
        views: view directions; the last ring should be near 87.5 deg, because silhouettes live there.
        storage: uint8, float16 or float32.
    """

    texels: int = 256
    views: str = "grid(15, 10, 87.5)"
    storage: Literal["uint8", "float16", "float32"] = "uint8"

    def __post_init__(self) -> None:
        """Raise ConfigError or SizeError for sizes that cannot be meant."""
        check_range("bake.mdf.texels", self.texels, 1, 1 << 20)
        needed = float(self.texels) ** 2 * len(hemisphere.parse(self.views)) * 5
        check_memory("bake.mdf", needed, MEMORY_LIMIT, "lower bake.mdf.texels or take fewer views")


class RayCastMdf:
    """D by casting a ray for every question: the limit that tables approach. Answers what `data.Mdf` answers."""

    def __init__(self, meso: Mesostructure):
        """Build the acceleration structure."""
        self.h = meso.h
        self.no_hit = None
        self.delta_max = 1.0
        self._tracer = TileTracer(meso.geometry, meso.h)

    def evaluate(self, uv: Float[Tensor, "n 2"], wo: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return D(uv, wo) in tile units; inf where the ray leaves the slab without a hit.

        Directions below 89.5 deg are lifted to it, as in the table.
        """
        cosine = wo[:, 2].clamp(min=MIN_COS)
        flat = torch.nn.functional.normalize(wo[:, :2], dim=-1) * (1 - cosine.square()).sqrt().unsqueeze(-1)
        lifted = torch.cat([flat, cosine.unsqueeze(-1)], -1).float()
        ahead = ABOVE / lifted[:, 2:]
        origin = torch.cat([uv.float(), torch.zeros_like(ahead)], -1) + ahead * lifted
        surface = self._tracer.trace(origin, -lifted)
        distance = (surface.t - ahead[:, 0]).clamp(min=0)
        return torch.where(surface.hit, torch.minimum(distance, self.h / lifted[:, 2]), torch.inf).to(uv.dtype)

    def distance(self, uv: Float[Tensor, "n 2"], wo: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return D(uv, wo): every answer is as good as it gets."""
        return self.evaluate(uv, wo)

    def depth(self, uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """Return how deep the material lies straight below `uv`, in tile units; inf in holes."""
        flat = uv.reshape(-1, 2)
        up = torch.tensor([0.0, 0.0, 1.0], dtype=uv.dtype)
        return self.evaluate(flat, up.expand(len(flat), 3)).reshape(uv.shape[:-1])


def bake(
    meso: Mesostructure,
    options: MdfOptions,
    path: str | Path,
    *,
    about: dict[str, object],
    progress: Callable[[float], None] = lambda share: None,
) -> None:
    """Bake the MDF of `meso` into the raw table `path` (.mdf.zarr), view by view; a cut-off bake goes on.

    Args:
        meso: the tile.
        options: texels, views, storage.
        path: the table.
        about: what the table says of its origin; an unfinished table with other words is started anew.
        progress: called with the share done, 0..1.
    """
    directions = hemisphere.parse(options.views)
    shape = (len(directions), options.texels, options.texels)
    attributes = {**mdf_data.table_attributes(directions, meso.h), **about}
    writer = open_blocks(path, mdf_data.specs(shape, options.storage), attributes)
    caster = RayCastMdf(meso)
    with writing(path):
        for view, wo in enumerate(directions.directions()):
            if not writer.is_done(view):
                delta, no_hit = drop_image(caster, wo, options.texels)
                codes = (delta * 255).round().to(torch.uint8) if options.storage == "uint8" else delta
                writer["delta"][view] = codes.numpy()
                writer["no_hit"][view] = no_hit.numpy()
                writer.mark_done(view)
            progress((view + 1) / len(directions))
        writer.finish()


def drop_image(
    caster: RayCastMdf, wo: Float[Tensor, "3"], texels: int
) -> tuple[Float[Tensor, "H W"], Bool[Tensor, "H W"]]:
    """Return delta at every texel centre seen from `wo`, and where there is no hit (delta 0)."""
    uv = texel_centres(texels, texels).reshape(-1, 2)
    D = caster.evaluate(uv, wo.expand(len(uv), 3))
    no_hit = D.isinf()
    delta = (D * wo[2] / caster.h).clamp(0, 1).masked_fill(no_hit, 0)
    return delta.reshape(texels, texels), no_hit.reshape(texels, texels)


def in_memory(meso: Mesostructure, options: MdfOptions) -> Mdf:
    """Return the baked MDF without writing a file."""
    directions = hemisphere.parse(options.views)
    caster = RayCastMdf(meso)
    images = [drop_image(caster, wo, options.texels) for wo in directions.directions()]
    delta = torch.stack([d for d, _ in images])
    no_hit = torch.stack([n for _, n in images])
    codes = (
        (delta * 255).round().to(torch.uint8)
        if options.storage == "uint8"
        else delta.to(getattr(torch, options.storage))
    )
    return Mdf(delta=codes, no_hit=no_hit if bool(no_hit.any()) else None, directions=directions, h=meso.h)
