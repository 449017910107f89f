"""Bake the BTF of a tile by path tracing: shadowing, masking and interreflection of the mesostructure.

One block per view: rays go down through the texels of the reference plane, and each path asks every light of
the set at every vertex, so that one set of paths fills a whole column of the table. The seed of a block
depends on the block alone: a resumed bake equals an uninterrupted one.

Test: tests/meso/test_bake_btf.py
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.data import btf as btf_data
from torchmeso.data.address import texel_centres
from torchmeso.data.btf import Btf
from torchmeso.data.store import open_blocks, writing
from torchmeso.errors import check_memory, check_range
from torchmeso.geometry import hemisphere
from torchmeso.geometry.light import DirectionalLight
from torchmeso.meso.bake_mdf import ABOVE
from torchmeso.meso.mesostructure import Mesostructure
from torchmeso.transport.path import radiance
from torchmeso.transport.tracer import TileTracer

MEMORY_LIMIT = 64 << 30
"""Bytes of a raw table above which a bake is refused."""

RAYS = 1 << 17
"""Camera rays handled at once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BtfOptions:
    """How to bake a BTF.

    Attributes:
        texels: side of the texture.
        lights: light directions.
        views: view directions.
        samples: rays per texel and view, on a grid over the texel (1, 4, 9, 16, ...).
        bounces: reflections followed beyond the first surface; 0 = direct light only.
        seed: of the directions of bounces.
    """

    texels: int = 64
    lights: str = "grid(12, 5, 80)"
    views: str = "grid(12, 5, 80)"
    samples: int = 4
    bounces: int = 2
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise ConfigError or SizeError for sizes that cannot be meant."""
        check_range("bake.btf.texels", self.texels, 1, 1 << 20)
        check_range("bake.btf.samples", self.samples, 1, 4096)
        check_range("bake.btf.bounces", self.bounces, 0, 64)
        n_pictures = len(hemisphere.parse(self.lights)) * len(hemisphere.parse(self.views))
        needed = float(self.texels) ** 2 * n_pictures * 6
        check_memory("bake.btf", needed, MEMORY_LIMIT, "lower bake.btf.texels or take fewer directions")


def bake(
    meso: Mesostructure,
    options: BtfOptions,
    path: str | Path,
    *,
    about: dict[str, object],
    progress: Callable[[float], None] = lambda share: None,
) -> None:
    """Bake the BTF of `meso` into the raw table `path` (.btf.zarr), view by view; a cut-off bake goes on.

    Args:
        meso: the tile.
        options: texels, directions, samples, bounces.
        path: the table.
        about: what the table says of its origin; an unfinished table with other words is started anew.
        progress: called with the share done, 0..1.
    """
    lights, views = hemisphere.parse(options.lights), hemisphere.parse(options.views)
    shape = (len(lights), len(views), options.texels, options.texels, 3)
    attributes = {**btf_data.table_attributes(lights, views, meso.h), **about}
    writer = open_blocks(path, btf_data.specs(shape), attributes)
    tracer = TileTracer(meso.geometry, meso.h)
    with writing(path):
        for view in range(len(views)):
            if not writer.is_done(view):
                writer["images"][:, view] = view_column(tracer, view, options).to(torch.float16).numpy()
                writer.mark_done(view)
            progress((view + 1) / len(views))
        writer.finish()


def in_memory(meso: Mesostructure, options: BtfOptions, dtype: torch.dtype = torch.float32) -> Btf:
    """Return the baked BTF without writing a file."""
    lights, views = hemisphere.parse(options.lights), hemisphere.parse(options.views)
    tracer = TileTracer(meso.geometry, meso.h)
    images = torch.empty(len(lights), len(views), options.texels, options.texels, 3, dtype=dtype)
    for view in range(len(views)):
        images[:, view] = view_column(tracer, view, options)
    return Btf(images=images, lights=lights, views=views, h=meso.h)


def view_column(tracer: TileTracer, view: int, options: BtfOptions) -> Float[Tensor, "light H W 3"]:
    """Return T for all lights at one view; rays that pass through the tile give 0."""
    lights = hemisphere.parse(options.lights)
    wo = hemisphere.parse(options.views).directions()[view]
    # E = pi makes the radiance of each light the BTF value itself.
    irradiance = torch.full((3,), math.pi)
    suns = [DirectionalLight(direction=wi, irradiance=irradiance) for wi in lights.directions()]
    uv = _footprints(options.texels, options.samples)
    rng = torch.Generator().manual_seed(options.seed * 1_000_003 + view)
    total = torch.zeros(options.texels**2, len(lights), 3)
    for place in uv:
        for first in range(0, len(place), RAYS):
            part = place[first : first + RAYS]
            ahead = ABOVE / wo[2]
            origin = torch.cat([part, torch.zeros(len(part), 1)], 1) + ahead * wo
            direction = (-wo).expand(len(part), 3)
            by_light, _, _ = radiance(tracer, origin, direction, suns, bounces=options.bounces, rng=rng)
            total[first : first + RAYS] += by_light
    mean = total / len(uv)
    return mean.reshape(options.texels, options.texels, len(lights), 3).permute(2, 0, 1, 3)


def _footprints(texels: int, samples: int) -> Float[Tensor, "sample texel 2"]:
    """Return the places of each texel's samples: the smallest square grid with at least `samples` cells."""
    side = math.ceil(math.sqrt(samples))
    offsets = (torch.arange(side) + 0.5) / side - 0.5
    shift = torch.stack(torch.meshgrid(offsets, offsets, indexing="ij"), -1).reshape(-1, 1, 2) / texels
    return texel_centres(texels, texels).reshape(1, -1, 2) + shift
