"""A generalised displacement map as a product of small tables.

wang2004gdm, section 5: d(x, y, z, theta, phi) = sum_i W_i(x, y, phi) E_i(theta, z), eigen-maps E over rows of
directions (rings and both poles) and layers, weights W of eight bits over texels and azimuths. What a ray meets is one
explicit bit, so that neither the jump at a silhouette nor its distance is left to the sum: distances count where a bit
says hit. `expanded` is the table itself, which is drawn as any other.

Test: tests/data/test_gdm_svd.py
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from torchmeso.data import gdm_query, gdm_streams, store
from torchmeso.data.gdm import Gdm
from torchmeso.data.gdm_query import Query
from torchmeso.errors import FormatError, ShapeError, check_finite, check_range, check_shape
from torchmeso.geometry.sphere import SphereGrid


@dataclass(frozen=True, eq=False, kw_only=True)
class GdmSvd:
    """Weights and eigen-maps of distances, and the bits and the material that a table has besides.

    Attributes:
        weights: (H, W, phi, rank) W as codes: value = offset + scale * code.
        scale: (rank,) of a code.
        offset: (rank,) of code 0.
        maps: (rank, rows, Z) E in tile units; rows are the pole at +z, the rings, the pole at -z.
        left: (Z, H, W, rows, bytes) whether a ray meets nothing: bits of the azimuths, the first the highest of a byte.
        occupancy: (Z, H, W) as of `Gdm`.
        matter: (Z, H, W, 10) as of `Gdm`.
        h: slab depth in tile units.
        cap: longest distance, tile units.
    """

    weights: UInt8[Tensor, "H W phi rank"]
    scale: Float[Tensor, "rank"]
    offset: Float[Tensor, "rank"]
    maps: Float[Tensor, "rank rows Z"]
    left: UInt8[Tensor, "Z H W rows bytes"]
    occupancy: Float[Tensor, "Z H W"]
    matter: Float[Tensor, "Z H W 10"]
    h: float
    cap: float

    def __post_init__(self) -> None:
        """Raise ShapeError or ConfigError unless the parts match."""
        check_shape("gdm.weights", self.weights, (-1, -1, -1, -1))
        height, width, n_phi, rank = self.weights.shape
        check_shape("gdm.maps", self.maps, (rank, -1, -1))
        _, rows, layers = self.maps.shape
        if layers < 2 or min(height, width, rank) < 1:
            raise ShapeError(
                "gdm.weights: expected at least one component of two layers of one voxel, got "
                f"rank {rank}, {width} x {height} x {layers} voxels"
            )
        check_shape("gdm.scale", self.scale, (rank,))
        check_shape("gdm.offset", self.offset, (rank,))
        check_shape("gdm.left", self.left, (layers, height, width, rows, -(-n_phi // 8)))
        check_shape("gdm.occupancy", self.occupancy, (layers, height, width))
        check_shape("gdm.matter", self.matter, (layers, height, width, 10))
        for name in ("scale", "offset", "maps"):
            check_finite(f"gdm.{name}", getattr(self, name))
        check_finite("gdm.occupancy", self.occupancy, 0, 1)
        check_range("gdm.h", self.h, 1e-6, 1e3)
        check_range("gdm.cap", self.cap, 1e-6, 1e3)
        SphereGrid(n_theta=rows - 2, n_phi=n_phi)

    @property
    def rank(self) -> int:
        """Components of the sum."""
        return self.weights.shape[3]

    @property
    def voxels(self) -> tuple[int, int, int]:
        """Layers, height and width."""
        z, height, width = self.occupancy.shape
        return z, height, width

    @property
    def directions(self) -> SphereGrid:
        """The directions of travel."""
        return SphereGrid(n_theta=self.maps.shape[1] - 2, n_phi=self.weights.shape[2])

    @property
    def held_bytes(self) -> int:
        """Bytes of weights and eigen-maps in memory, without the bits and the material."""
        return self.weights.numel() + 4 * (self.maps.numel() + 2 * self.rank)

    @property
    def solid(self) -> Float[Tensor, "voxel"]:
        """1 where a voxel is inside of material."""
        return self._solid

    @cached_property
    def _solid(self) -> Tensor:
        return (self.occupancy > 0.5).to(torch.float32).flatten()

    def evaluate(self, place: Float[Tensor, "*batch 3"], w: Float[Tensor, "*batch 3"]) -> Query:
        """Return how far it is from `place` along `w` to material; see `Gdm.evaluate`.

        Only the samples that are asked for are summed.
        """
        return gdm_query.query(self, place, w)

    def samples(
        self, voxel: Int[Tensor, "*batch 8"], node: Int[Tensor, "*batch 4"], dtype: torch.dtype
    ) -> tuple[Float[Tensor, "*batch 8 4"], Float[Tensor, "*batch 8 4"]]:
        """Return the distances of samples, tile units, and 1 where they are of a hit; see `Gdm.samples`."""
        n_phi, rows = self.directions.n_phi, self.maps.shape[1]
        plane = self.weights.shape[0] * self.weights.shape[1]
        row, column = (node // n_phi)[..., None, :], (node % n_phi)[..., None, :]
        texel, layer = (voxel % plane)[..., :, None], (voxel // plane)[..., :, None]
        codes = self.weights.flatten(0, 2)[texel * n_phi + column]
        weight = self.offset.to(dtype) + self.scale.to(dtype) * codes.to(dtype)
        distance = (weight * self.maps.to(dtype).permute(1, 2, 0)[row, layer]).sum(-1).clamp(0, self.cap)
        byte = self.left.flatten()[(voxel[..., :, None] * rows + row) * self.left.shape[4] + column // 8]
        return distance, 1 - (byte >> (7 - column % 8).to(torch.uint8) & 1).to(dtype)

    def expanded(self) -> Gdm:
        """Return the direct table of eight bits: what pictures are made from."""
        rings = slice(1, -1)
        left = unpacked_bits(self.left[..., rings, :], self.directions.n_phi)
        solid = self.occupancy > 0.5
        weight = self.offset + self.scale * self.weights.float()
        distance = torch.empty(left.shape, dtype=torch.uint8)
        for k in range(self.voxels[0]):
            layer = torch.einsum("hwpr,rt->hwtp", weight, self.maps[:, rings, k].float())
            met = ~left[k] & ~solid[k, ..., None, None]
            codes = (layer * (255 / self.cap)).round().clamp(0, 255)
            distance[k] = torch.where(met, codes, 0).to(torch.uint8)
        return Gdm(
            distance=distance, left=left, occupancy=self.occupancy, matter=self.matter, h=self.h, cap=self.cap,
        )  # fmt: skip


def packed_bits(bits: Bool[Tensor, "*batch phi"]) -> UInt8[Tensor, "*batch bytes"]:
    """Return bits eight to a byte, the first the highest."""
    return torch.from_numpy(np.packbits(bits.numpy(), axis=-1))


def unpacked_bits(packed: UInt8[Tensor, "*batch bytes"], n: int) -> Bool[Tensor, "*batch phi"]:
    """Return the first `n` bits of each row of bytes."""
    return torch.from_numpy(np.unpackbits(packed.numpy(), axis=-1, count=n)).bool()


def save(table: GdmSvd, path: str | Path, **meta: object) -> None:
    """Write a run-time model (.gdm.meso): a stream for each component, the bits and the material."""
    tensors = {f"svd.weights.{k}": gdm_streams.packed(table.weights[..., k]) for k in range(table.rank)}
    tensors |= {"svd.maps": table.maps, "svd.scale": table.scale, "svd.offset": table.offset}
    tensors |= gdm_streams.to_tensors(table.left, table.occupancy, table.matter)
    height, width, n_phi, rank = table.weights.shape
    about = {"rank": rank, "voxels": [table.voxels[0], height, width], "n_theta": table.directions.n_theta}
    about |= {"n_phi": n_phi, "h": table.h, "cap": table.cap}
    store.write_model(path, tensors, {"kind": "gdm svd", "svd": about, **meta})


def load(path: str | Path, *, rank: int | None = None) -> GdmSvd:
    """Return the factored GDM of a run-time model, reading only the first `rank` components where given.

    Raises:
        FormatError: the file is missing, damaged, or holds no factored GDM.
    """
    model = store.Model(path)
    about = model.meta.get("svd")
    if about is None:
        raise FormatError(f"{path}: expected a factored GDM, found {', '.join(model.names()) or 'nothing'}")
    with store.reading(path):
        kept = about["rank"] if rank is None else min(rank, about["rank"])
        if kept < 1:
            raise FormatError(f"{path}: expected at least one component, got {kept}; the copy may be incomplete")
        layers, height, width = about["voxels"]
        n_theta, n_phi = about["n_theta"], about["n_phi"]
        shape = (height, width, n_phi)
        weights = [gdm_streams.read(model, f"svd.weights.{k}", shape, torch.uint8) for k in range(kept)]
        bits = (layers, height, width, n_theta + 2, -(-n_phi // 8))
        left, occupancy, matter = gdm_streams.from_model(model, bits)
        return GdmSvd(
            weights=torch.stack(weights, -1),
            maps=model.read("svd.maps")[:kept],
            scale=model.read("svd.scale")[:kept],
            offset=model.read("svd.offset")[:kept],
            left=left,
            occupancy=occupancy,
            matter=matter,
            h=about["h"],
            cap=about["cap"],
        )
