"""The generalised displacement map d(u, v, z, w): how far material is from a point of the slab in a direction.

wang2004gdm, section 3.1. A sample is one of three cases: a hit at distance d; `left`, the ray leaves the slab through
its top or bottom (or meets nothing within `cap`) and the distance there is known without a table; inside solid, d = 0.
The three never mix: a query decides by weight which case it is, and averages over the samples of that case alone.
A sample's distance is carried along the ray to the point asked about, d_i + (p_i - p) . w, which is exact before a
plane however many of the eight corners lie inside solid; distances that lie far apart are of two surfaces, and only the
larger share of them counts. Corners inside solid that lie ahead count as hits; those
behind, as of a ray that leaves a surface, do not count.

Test: tests/data/test_gdm.py
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchmeso.data import gdm_query, store
from torchmeso.data.gdm_query import Query
from torchmeso.errors import ShapeError, check_finite, check_range, check_shape
from torchmeso.geometry import sphere
from torchmeso.geometry.sphere import SphereGrid

MISS = -1
"""In place of a distance: nothing is met."""

ROUNDED = 1e-3
"""Halves of the longest distance may lie above it by this share."""


class Matter(NamedTuple):
    """What material is made of near points.

    Attributes:
        normal: (..., 3) unit, out of the material.
        albedo: (..., 3) linear RGB.
        alpha: (...) GGX width.
        f0: (..., 3) reflectance of the coat at normal incidence.
    """

    normal: Float[Tensor, "*batch 3"]
    albedo: Float[Tensor, "*batch 3"]
    alpha: Float[Tensor, "*batch"]
    f0: Float[Tensor, "*batch 3"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Gdm:
    """Distances over a grid of points and directions, and the material at the points.

    Attributes:
        distance: (Z, H, W, theta, phi) way to the first material as uint8 (code * cap / 255), float16 or float32 in
            tile units; layers run from z = -h to z = 0, both included; 0 where `left` or inside solid.
        left: (Z, H, W, theta, phi) true where a ray meets nothing within `cap` or before it leaves the slab.
        occupancy: (Z, H, W) share of solid around each point in [0, 1]; above one half the point is inside.
        matter: (Z, H, W, 10) normal, albedo, alpha and f0 of the surface nearest to each point; 0 where none is near.
        h: slab depth in tile units.
        cap: longest distance in the table, tile units.
    """

    distance: Shaped[Tensor, "Z H W theta phi"]
    left: Bool[Tensor, "Z H W theta phi"]
    occupancy: Float[Tensor, "Z H W"]
    matter: Float[Tensor, "Z H W 10"]
    h: float
    cap: float

    def __post_init__(self) -> None:
        """Raise ShapeError or ConfigError unless the parts match, are finite and lie in their ranges."""
        check_shape("gdm.distance", self.distance, (-1, -1, -1, -1, -1))
        shape = tuple(self.distance.shape)
        if self.distance.dtype not in (torch.uint8, torch.float16, torch.float32, torch.float64):
            raise ShapeError(f"gdm.distance: expected uint8, float16, float32 or float64, got {self.distance.dtype}")
        check_shape("gdm.left", self.left, shape)
        check_shape("gdm.occupancy", self.occupancy, shape[:3])
        check_shape("gdm.matter", self.matter, (*shape[:3], 10))
        if shape[0] < 2 or min(shape[1:3]) < 1:
            raise ShapeError(f"gdm.distance: expected at least two layers of one voxel, got {shape[:3]}")
        check_finite("gdm.occupancy", self.occupancy, 0, 1)
        check_finite("gdm.matter", self.matter)
        check_range("gdm.h", self.h, 1e-6, 1e3)
        check_range("gdm.cap", self.cap, 1e-6, 1e3)
        if self.distance.is_floating_point():
            check_finite("gdm.distance", self.distance, 0, self.cap * (1 + ROUNDED))
        SphereGrid(n_theta=shape[3], n_phi=shape[4])

    @property
    def voxels(self) -> tuple[int, int, int]:
        """Layers, height and width."""
        z, height, width = self.distance.shape[:3]
        return z, height, width

    @property
    def voxel(self) -> float:
        """The longest side of a voxel, tile units."""
        return gdm_query.voxel_side(self)

    @property
    def directions(self) -> SphereGrid:
        """The directions of travel."""
        return SphereGrid(n_theta=self.distance.shape[3], n_phi=self.distance.shape[4])

    def evaluate(self, place: Float[Tensor, "*batch 3"], w: Float[Tensor, "*batch 3"]) -> Query:
        """Return how far it is from `place` along `w` to material.

        Args:
            place: (..., 3) u and v unbounded, z in [-h, 0] (held beyond), tile units.
            w: (..., 3) unit direction of travel in the local frame.

        Returns:
            distances in tile units; 0 inside solid.
        """
        return gdm_query.query(self, place, w)

    def samples(
        self, voxel: Int[Tensor, "*batch 8"], node: Int[Tensor, "*batch 4"], dtype: torch.dtype
    ) -> tuple[Float[Tensor, "*batch 8 4"], Float[Tensor, "*batch 8 4"]]:
        """Return the distances in the table, tile units (negative: of no hit), and 1 where they are of a hit.

        Args:
            voxel: (layer * H + row) * W + column.
            node: of `SphereGrid.interpolate`.
            dtype: of what is returned.
        """
        rows = self._rows
        index = voxel[..., :, None] * rows.distance.shape[1] + node[..., None, :]
        found = rows.distance.flatten().take(index).to(dtype)
        met = (found >= 0).to(dtype)
        if self.distance.dtype == torch.uint8:
            found = found * (self.cap / 255)
        return found, met

    @property
    def solid(self) -> Float[Tensor, "voxel"]:
        """1 where a voxel is inside of material."""
        return self._rows.solid

    def boundary(self, place: Float[Tensor, "*batch 3"], w: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Return the way along `w` to the top or bottom of the slab, at most `cap`."""
        return gdm_query.boundary(self, place, w)

    def matter_at(self, place: Float[Tensor, "*batch 3"], wo: Float[Tensor, "*batch 3"] | None = None) -> Matter:
        """Return the material around `place`, from the corners that have one; the normal is up where none has.

        Args:
            place: as of `evaluate`.
            wo: (..., 3) unit, to the viewer: corners whose material turns away from there are of another side of
                something thin, which cannot be seen. Where all do, the normal is up.
        """
        voxel, weight, _ = gdm_query.corners(self, place)
        rows = self.matter.reshape(-1, 10).to(place.dtype)[voxel]
        known = weight * (rows[..., 6] > 0)
        seen = torch.ones_like(known[..., :1], dtype=torch.bool)
        if wo is not None:
            facing = known * ((rows[..., :3] * wo.unsqueeze(-2)).sum(-1) > 0)
            seen = facing.sum(-1, keepdim=True) > 1e-6
            known = torch.where(seen, facing, known)
        mean = (known.unsqueeze(-1) * rows).sum(-2) / known.sum(-1, keepdim=True).clamp(min=1e-12)
        normal = mean[..., :3]
        length = torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
        up = torch.tensor([0.0, 0.0, 1.0], dtype=place.dtype).expand_as(normal)
        normal = torch.where(seen & (length > 1e-6), normal / length.clamp(min=1e-6), up)
        return Matter(normal, mean[..., 3:6], mean[..., 6].clamp(min=0.02), mean[..., 7:])

    @cached_property
    def _rows(self) -> "_Rows":
        """The tables with rows for the poles, one line per voxel."""
        n = self.occupancy.numel()
        exact = torch.float64 if self.distance.dtype == torch.float64 else torch.float32
        met = (~self.left).to(exact)
        left = sphere.with_poles(met) < 0.5
        # A pole's distance is the mean of those around it that meet something.
        total = sphere.with_poles(self.distance.to(exact) * met) / sphere.with_poles(met).clamp(min=1e-6)
        distance = torch.where(
            left, MISS, total.round().to(torch.int16) if self.distance.dtype == torch.uint8 else total
        )
        solid = (self.occupancy > 0.5).to(torch.float32)
        return _Rows(distance.reshape(n, -1), solid.reshape(n))


class _Rows(NamedTuple):
    distance: Tensor  # MISS where nothing is met
    solid: Tensor


def save(gdm: Gdm, path: str | Path, **attributes: object) -> None:
    """Write `gdm` as a raw table (.gdm.zarr), whole."""
    layout = specs(tuple(gdm.distance.shape), str(gdm.distance.dtype).removeprefix("torch."))
    about = {**table_attributes(gdm.h, gdm.cap), **attributes}
    with store.writing(path):
        writer = store.open_blocks(path, layout, about)
        for name in layout:
            writer[name][:] = getattr(gdm, name).numpy()
        writer.finish()


def load(path: str | Path) -> Gdm:
    """Return the GDM of a raw table.

    Raises:
        FormatError: the table is missing, damaged or of another kind.
    """
    group = store.open_table(path, "gdm")
    with store.reading(path):
        about = store.attributes(group)
        return Gdm(
            distance=store.read_array(group, "distance"),
            left=store.read_array(group, "left").bool(),
            occupancy=store.read_array(group, "occupancy").float(),
            matter=store.read_array(group, "matter").float(),
            h=about["h"],
            cap=about["cap"],
        )


def specs(shape: tuple[int, ...], dtype: str) -> dict[str, store.ArraySpec]:
    """Return the layout of a raw table: one shard per layer, so that a layer can be baked alone."""
    layers, height, width, theta, phi = shape
    axes = ("Z", "H", "W", "theta", "phi")
    chunk = (1, height, width, 1, phi)
    table = {"shape": shape, "chunks": chunk, "shards": (1, height, width, theta, phi), "axes": axes}
    layer = {"shards": (1, height, width), "chunks": (1, height, width), "axes": axes[:3]}
    return {
        "distance": store.ArraySpec(dtype=dtype, **table),
        "left": store.ArraySpec(dtype="bool", **table),
        "occupancy": store.ArraySpec(dtype="float32", shape=(layers, height, width), **layer),
        "matter": store.ArraySpec(
            dtype="float32", shape=(layers, height, width, 10), chunks=(1, height, width, 10),
            shards=(1, height, width, 10), axes=(*axes[:3], "C"),
        ),
    }  # fmt: skip


def table_attributes(h: float, cap: float) -> dict[str, object]:
    """Return what a raw table says about itself."""
    return {
        "kind": "gdm", "h": h, "cap": cap, "unit": "way to the first material in tile units; uint8 = code * cap / 255",
    }  # fmt: skip
