"""The mesostructure distance function D(u, v, wo): how far below the reference plane the material lies.

A table over its own set of view directions (to 87.5 deg: silhouettes live there) holds the drop

    delta = D cos(theta_o) / h   in [0, 1],

bounded at grazing angles, and one explicit bit where a ray leaves the slab without a hit. wang2005mdf,
section 3; the bounded storage is ours.

Test: tests/data/test_mdf.py
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Shaped
from torch import Tensor

from torchmeso.data import address, store
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.data.relief import Relief, from_views
from torchmeso.errors import ShapeError, check_finite, check_range, check_shape
from torchmeso.geometry import hemisphere
from torchmeso.geometry.hemisphere import DirectionSet

MIN_COS = math.cos(math.radians(89.5))
"""Cosines of the view angle are taken no smaller than this: D stays finite at and below the horizon."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Mdf:
    """Drops over views and texels.

    Attributes:
        delta: (view, H, W) drop as uint8 (code / 255), float16 or float32 in [0, 1]; 0 where there is no hit.
        no_hit: (view, H, W) true where the ray leaves the slab, or None where every entry is a hit.
        directions: the view directions.
        h: slab depth in tile units.
        quilting: a larger texture made of the table's texels, or None: the table repeats.
    """

    delta: Shaped[Tensor, "view H W"]
    no_hit: Bool[Tensor, "view H W"] | None
    directions: DirectionSet
    h: float
    quilting: QuiltingMap | None = None

    def __post_init__(self) -> None:
        """Raise ShapeError or ConfigError unless the parts match."""
        check_shape("mdf.delta", self.delta, (len(self.directions), -1, -1))
        if self.delta.dtype not in (torch.uint8, torch.float16, torch.float32, torch.float64):
            raise ShapeError(f"mdf.delta: expected uint8, float16, float32 or float64, got {self.delta.dtype}")
        if self.no_hit is not None:
            check_shape("mdf.no_hit", self.no_hit, tuple(self.delta.shape))
        if min(self.texels) < 1:
            raise ShapeError(f"mdf.delta: expected at least one texel, got {self.texels[1]} x {self.texels[0]}")
        if self.delta.dtype != torch.uint8:
            check_finite("mdf.delta", self.delta, 0, 1)
        check_range("mdf.h", self.h, 1e-6, 1e3)

    @property
    def texels(self) -> tuple[int, int]:
        """Height and width of the texture."""
        return self.delta.shape[1], self.delta.shape[2]

    @property
    def delta_max(self) -> float:
        """Largest drop of the table, for the bound that lets thick intervals pass without a look-up."""
        return self._delta_max

    def evaluate(self, uv: Float[Tensor, "*batch 2"], wo: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Return D(uv, wo) in tile units; +inf where most of the footprint has no hit.

        Args:
            uv: (..., 2) texture coordinates, unbounded.
            wo: (..., 3) unit direction to the viewer, local frame; below the last ring the drop is held.

        Returns:
            (...) distance along -wo; differentiable in both where it is finite.
        """
        delta, missing = self.drop(uv, wo)
        distance = delta * self.h / wo[..., 2].clamp(min=MIN_COS)
        return distance if self.no_hit is None else torch.where(missing > 0.5, torch.inf, distance)

    def drop(
        self, uv: Float[Tensor, "*batch 2"], wo: Float[Tensor, "*batch 3"]
    ) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
        """Return delta, interpolated over the taps that hit, and the weight of the taps that do not."""
        taps = address.bilinear(uv, *self.texels, self.quilting)
        view = hemisphere.interpolate(self.directions, wo)
        n_texel = self.delta.shape[1] * self.delta.shape[2]
        index = (view.node[..., :, None] * n_texel + taps.texel[..., None, :]).flatten(-2)
        weight = (view.weight[..., :, None] * taps.weight[..., None, :]).flatten(-2)
        table, missing_table = self._nodes
        delta = table[index].to(uv.dtype)
        if table.dtype == torch.uint8:
            delta = delta / 255
        if missing_table is None:
            return (delta * weight).sum(-1), torch.zeros_like(weight[..., 0])
        missing = (missing_table[index] * weight).sum(-1)
        return (delta * weight).sum(-1) / (1 - missing).clamp(min=1e-6), missing

    @cached_property
    def relief(self) -> Relief:
        """The height map that the first ring of views agrees on, finer than the texels; made when first asked for."""
        count = self.directions.count[0]
        wo = self.directions.directions(torch.float64)[:count]
        drop = self.delta[:count].float() * (self.h / (255 if self.delta.dtype == torch.uint8 else 1))
        no_hit = None if self.no_hit is None else self.no_hit[:count]
        found = from_views(drop, no_hit, (wo[:, :2] / wo[:, 2:]).float(), self.h)
        return found if self.quilting is None else replace(found, quilting=self.quilting)

    def distance(self, uv: Float[Tensor, "n 2"], wo: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Return D(uv, wo) by marching through the relief: for the few rays whose answer decides a silhouette."""
        return self.relief.march(uv, wo, MIN_COS)

    def depth(self, uv: Float[Tensor, "*batch 2"]) -> Float[Tensor, "*batch"]:
        """Return the depth of the relief straight below `uv`, in tile units; inf in holes."""
        return self.relief.depth(uv)

    @cached_property
    def _delta_max(self) -> float:
        return float(self.delta.max()) / (255 if self.delta.dtype == torch.uint8 else 1)

    @cached_property
    def _nodes(self) -> tuple[Tensor, Tensor | None]:
        """The table with its pole, flat; where there is no hit delta is 0, so it drops out of weighted sums."""
        delta = hemisphere.with_pole(self.delta, self.directions).flatten()
        if self.no_hit is None:
            return delta, None
        missing = hemisphere.with_pole(self.no_hit.float(), self.directions).flatten()
        return delta, missing


def save(mdf: Mdf, path: str | Path, **attributes: object) -> None:
    """Write `mdf` as a raw table (.mdf.zarr), whole."""
    missing = torch.zeros_like(mdf.delta, dtype=torch.bool) if mdf.no_hit is None else mdf.no_hit
    layout = specs(mdf.delta.shape, str(mdf.delta.dtype).removeprefix("torch."))
    about = {**table_attributes(mdf.directions, mdf.h), **attributes}
    with store.writing(path):
        writer = store.open_blocks(path, layout, about)
        writer["delta"][:] = mdf.delta.numpy()
        writer["no_hit"][:] = missing.numpy()
        writer.finish()


def load(path: str | Path) -> Mdf:
    """Return the MDF of a raw table.

    Raises:
        FormatError: the table is missing, damaged or of another kind.
    """
    group = store.open_table(path, "mdf")
    with store.reading(path):
        about = store.attributes(group)
        no_hit = store.read_array(group, "no_hit").bool()
        return Mdf(
            delta=store.read_array(group, "delta"),
            no_hit=no_hit if bool(no_hit.any()) else None,
            directions=hemisphere.parse(about["directions"]),
            h=about["h"],
        )


def specs(shape: tuple[int, ...], dtype: str) -> dict[str, store.ArraySpec]:
    """Return the layout of a raw table: one shard per view, so that a view can be baked and read alone."""
    view, height, width = shape
    chunk = (1, min(height, 128), min(width, 128))
    shard = (1, *(-(-n // c) * c for n, c in zip((height, width), chunk[1:], strict=True)))
    layout = {"shape": (view, height, width), "chunks": chunk, "shards": shard, "axes": ("view", "H", "W")}
    return {"delta": store.ArraySpec(dtype=dtype, **layout), "no_hit": store.ArraySpec(dtype="bool", **layout)}


def table_attributes(directions: DirectionSet, h: float) -> dict[str, object]:
    """Return what a raw table says about itself."""
    return {"kind": "mdf", "directions": directions.name, "h": h, "unit": "drop D cos(theta) / h; uint8 = code / 255"}


def to_tensors(mdf: Mdf) -> tuple[dict[str, Tensor], dict[str, object]]:
    """Return the tensors and the metadata of `mdf` for a run-time model."""
    tensors = {"mdf.delta": mdf.delta}
    if mdf.no_hit is not None:
        tensors["mdf.no_hit"] = mdf.no_hit
    return tensors, {"directions": mdf.directions.name, "h": mdf.h}


def from_model(model: store.Model) -> Mdf | None:
    """Return the MDF of a run-time model, or None where it has none."""
    meta = model.meta.get("mdf")
    if meta is None:
        return None
    with store.reading(model.path):
        no_hit = model.read("mdf.no_hit") if "mdf.no_hit" in model.names() else None
        directions = hemisphere.parse(meta["directions"])
        return Mdf(delta=model.read("mdf.delta"), no_hit=no_hit, directions=directions, h=meta["h"])
