"""The bidirectional texture function as measured or baked: one picture per light and view.

Values are T = pi f_r cos(theta_i), linear RGB, unclamped. Pictures may lie in memory or on disk; `rows` reads
a band of texels either way, so that fits can stream. Pictures that came as sRGB codes stay codes, a quarter of the
floats they stand for, and are decoded where they are read.

Test: tests/data/test_btf.py
"""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import torch
import zarr
from jaxtyping import Float, Shaped
from torch import Tensor
from zarr.buffer import cpu

from torchmeso.data import address, image, store
from torchmeso.data.pyramid import Footprint
from torchmeso.errors import FormatError, ShapeError, check_finite, check_shape
from torchmeso.geometry import hemisphere
from torchmeso.geometry.hemisphere import DirectionSet

LARGEST = 1e15
"""Values of T beyond it are damage, not light: their squares would not fit into the float32 sums of a fit."""


Encoding = Literal["linear", "srgb"]


@runtime_checkable
class Evaluable(Protocol):
    """Anything that shading can ask for reflectance: `Btf`, `EigenBtf`."""

    def evaluate(
        self,
        uv: Float[Tensor, "*batch 2"],
        wi: Float[Tensor, "*batch 3"],
        wo: Float[Tensor, "*batch 3"],
        seen: Footprint | None = None,
    ) -> Float[Tensor, "*batch 3"]:
        """Return T(uv, wi, wo), linear RGB; local frame, 0 for wi below the horizon; a mean over what is `seen`."""
        ...

    def ambient(
        self, uv: Float[Tensor, "*batch 2"], wo: Float[Tensor, "*batch 3"], seen: Footprint | None = None
    ) -> Float[Tensor, "*batch 3"]:
        """Return L_a(uv, wo) = (1/pi) times the integral of T over the light hemisphere (white: 1)."""
        ...


@runtime_checkable
class Bands(Protocol):
    """A table of T that is read in bands of texel rows: `Btf`, `btfdbb.BonnBtf`."""

    @property
    def lights(self) -> DirectionSet:
        """Directions towards the light."""
        ...

    @property
    def views(self) -> DirectionSet:
        """Directions towards the viewer."""
        ...

    @property
    def texels(self) -> tuple[int, int]:
        """Height and width of the texture."""
        ...

    def rows(self, start: int, stop: int) -> Float[Tensor, "light view rows W 3"]:
        """Return T of texel rows start .. stop of all pictures as float32, reading no others."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Btf:
    """A table of T over light, view and texel.

    Attributes:
        images: (light, view, H, W, 3), in memory or a Zarr array on disk.
        lights: directions towards the light.
        views: directions towards the viewer.
        h: slab depth of the mesostructure in tile units; 0 where it is unknown.
        encoding: of the images: linear values, or uint8 codes in sRGB.
    """

    images: Shaped[Tensor, "light view H W 3"] | zarr.Array
    lights: DirectionSet
    views: DirectionSet
    h: float = 0.0
    encoding: Encoding = "linear"

    def __post_init__(self) -> None:
        """Raise ShapeError unless the directions match the images, and codes are uint8."""
        check_shape("btf.images", self.images, (len(self.lights), len(self.views), -1, -1, 3))
        if (self.encoding == "srgb") != (str(self.images.dtype).removeprefix("torch.") == "uint8"):
            raise ShapeError(
                f"btf.images: expected uint8 codes (encoding srgb) or floats (linear), "
                f"got {self.images.dtype} and {self.encoding}"
            )
        if min(self.texels) < 1:
            raise ShapeError(f"btf.images: expected at least one texel, got {self.texels[1]} x {self.texels[0]}")

    @property
    def texels(self) -> tuple[int, int]:
        """Height and width of the texture."""
        return self.images.shape[2], self.images.shape[3]

    def rows(self, start: int, stop: int) -> Float[Tensor, "light view rows W 3"]:
        """Return texel rows start .. stop of all pictures as float32, reading no others.

        Raises:
            FormatError: the file on disk is damaged.
            ShapeError: a value is not finite, or beyond `LARGEST` (the place is named, the others are counted).
        """
        return self.linear(self.stored_rows(start, stop), start)

    def stored_rows(
        self, start: int, stop: int, room: np.ndarray | None = None
    ) -> Shaped[Tensor, "light view rows W 3"]:
        """Return texel rows start .. stop as they are stored, reading no others; from disk into the bytes `room`.

        Raises:
            FormatError: the file on disk is damaged.
        """
        if isinstance(self.images, Tensor):
            return self.images[:, :, start:stop]
        with store.reading(str(self.images.store_path)):
            wanted = slice(None), slice(None), slice(start, stop)
            if room is None:
                return torch.from_numpy(np.asarray(self.images[wanted]))
            kind = np.dtype(self.images.dtype)
            shape = (*self.images.shape[:2], stop - start, *self.images.shape[3:])
            found = room[: math.prod(shape) * kind.itemsize].view(kind).reshape(shape)
            self.images.get_basic_selection(wanted, out=cpu.NDBuffer.from_numpy_array(found))
            return torch.from_numpy(found)

    def linear(self, stored: Shaped[Tensor, "light view rows W 3"], start: int) -> Float[Tensor, "light view rows W 3"]:
        """Return T as float32 of what is stored of the rows from `start` on.

        Raises:
            ShapeError: a value is not finite, or beyond `LARGEST` (the place is named, the others are counted).
        """
        if self.encoding == "srgb":
            return image.decode_codes(stored)
        band = stored.float()
        wrong = ~((band <= LARGEST) & (band >= -LARGEST))
        if bool(wrong.any()):
            light, view, row, column, channel = wrong.nonzero()[0].tolist()
            value = float(band[light, view, row, column, channel])
            raise ShapeError(
                f"btf.images: expected finite values up to {LARGEST:g}, got {value:g} at light {light}, view {view}, "
                f"row {start + row}, column {column}, and {int(wrong.sum()) - 1} more "
                f"in rows {start} to {start + band.shape[2] - 1}; repair or mask them before fitting"
            )
        return band

    def seen_from(self, view: int) -> Float[Tensor, "light H W 3"]:
        """Return the pictures of one view as linear float32, reading no others.

        Raises:
            FormatError: the file on disk is damaged.
        """
        if isinstance(self.images, Tensor):
            stored = self.images[:, view]
        else:
            with store.reading(str(self.images.store_path)):
                stored = torch.from_numpy(np.asarray(self.images[:, view]))
        return image.decode_codes(stored) if self.encoding == "srgb" else stored.float()

    def pictures(self) -> Float[Tensor, "light view H W 3"]:
        """Return all pictures, read into memory: in the dtype they are stored in, of codes the linear float32 values.

        Raises:
            ShapeError: a value is not finite.
        """
        stored = self._stored()
        if self.encoding == "srgb":
            return image.decode_codes(stored)
        check_finite("btf.images", stored)
        return stored

    def _stored(self) -> Tensor:
        if isinstance(self.images, Tensor):
            return self.images
        with store.reading(str(self.images.store_path)):
            return torch.from_numpy(np.asarray(self.images[:]))

    def evaluate(
        self,
        uv: Float[Tensor, "*batch 2"],
        wi: Float[Tensor, "*batch 3"],
        wo: Float[Tensor, "*batch 3"],
        seen: Footprint | None = None,
    ) -> Float[Tensor, "*batch 3"]:
        """Return T(uv, wi, wo): 4 lights x 4 views x 4 texels, C0 everywhere, 0 for wi below the horizon."""
        light = hemisphere.interpolate(self.lights, wi)
        return self._sum_taps(uv, wo, light.node, light.weight, self._nodes) * horizon_falloff(self.lights, wi)

    def ambient(
        self,
        uv: Float[Tensor, "*batch 2"],
        wo: Float[Tensor, "*batch 3"],
        seen: Footprint | None = None,
    ) -> Float[Tensor, "*batch 3"]:
        """Return L_a(uv, wo) = (1/pi) times the integral of T over the light hemisphere (white: 1)."""
        zero = torch.zeros_like(uv[..., :1], dtype=torch.long)
        return self._sum_taps(uv, wo, zero, torch.ones_like(uv[..., :1]), self._ambient_nodes)

    def _sum_taps(self, uv: Tensor, wo: Tensor, light: Tensor, light_weight: Tensor, table: Tensor) -> Tensor:
        height, width = self.texels
        taps = address.bilinear(uv, height, width)
        view = hemisphere.interpolate(self.views, wo)
        picture = light[..., :, None] * self.views.n_nodes + view.node[..., None, :]
        index = picture[..., None] * (height * width) + taps.texel[..., None, None, :]
        weight = light_weight[..., :, None, None] * view.weight[..., None, :, None] * taps.weight[..., None, None, :]
        values = table[index.flatten(-3)]
        values = (image.decode_codes(values) if values.dtype == torch.uint8 else values).to(uv.dtype)
        return (values * weight.flatten(-3).unsqueeze(-1)).sum(-2)

    @cached_property
    def _nodes(self) -> Tensor:
        """(nodes of light x nodes of view x texel, 3), the poles appended; codes stay codes where there are none."""
        poles = self.lights.needs_pole or self.views.needs_pole
        images = self._stored() if self.encoding == "srgb" and not poles else self.pictures()
        with_light_pole = hemisphere.with_pole(images, self.lights, dim=0)
        return hemisphere.with_pole(with_light_pole, self.views, dim=1).reshape(-1, 3)

    @cached_property
    def _ambient_nodes(self) -> Tensor:
        """(nodes of view x texel, 3): the light hemisphere integrated."""
        images = self.pictures()
        weights = (hemisphere.quadrature(self.lights) / math.pi).float()
        total = torch.zeros(images.shape[1:], dtype=torch.float32)
        for l, weight in enumerate(weights):
            total += weight * images[l].float()
        return hemisphere.with_pole(total, self.views).reshape(-1, 3)


def horizon_falloff(lights: DirectionSet, wi: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 1"]:
    """Return the factor of T beyond the last ring of lights: cos(theta_i) / cos(last), 0 below the horizon."""
    return (wi[..., 2:] / math.cos(lights.last)).clamp(0, 1)


def load(path: str | Path) -> Btf:
    """Return the BTF of a raw table (.btf.zarr); its pictures stay on disk until they are read.

    Raises:
        FormatError: the table is missing, damaged or of another kind.
    """
    group = store.open_table(path, "btf")
    with store.reading(path):
        about, images = store.attributes(group), group["images"]
        encoding = about.get("encoding", "linear")
        if encoding not in ("linear", "srgb"):
            raise FormatError(f"{path}: expected the encoding 'linear' or 'srgb', got '{encoding}'; update torchmeso")
        if not isinstance(images, zarr.Array):
            raise FormatError(f"{path}: expected an array 'images', got a group; the copy may be incomplete")
        lights, views = hemisphere.parse(about["lights"]), hemisphere.parse(about["views"])
        return Btf(images=images, lights=lights, views=views, h=about["h"], encoding=encoding)


def save(btf: Btf, path: str | Path, *, dtype: str = "float16", **attributes: object) -> None:
    """Write `btf` as a raw table (.btf.zarr), whole.

    Raises:
        ShapeError: a value does not fit `dtype` (float16 ends at 65,504; float32 holds all).
    """
    images = btf.pictures().to(getattr(torch, dtype))
    if not bool(torch.isfinite(images).all()):
        raise ShapeError(f"btf.images: expected values that fit {dtype}, got one beyond it; store float32")
    attributes = {**table_attributes(btf.lights, btf.views, btf.h), **attributes}
    with store.writing(path):
        writer = store.open_blocks(path, specs(tuple(images.shape), dtype), attributes)
        writer["images"][:] = images.numpy()
        writer.finish()


def specs(
    shape: tuple[int, ...], dtype: str = "float16", *, chunk: tuple[int, ...] = (4, 1, 32, 32, 3)
) -> dict[str, store.ArraySpec]:
    """Return the layout of a raw table: one shard per view (a block of a bake), chunks of 4 lights x 32 x 32 texels."""
    light, _, height, width, _ = shape
    chunk = (min(light, chunk[0]), 1, min(height, chunk[2]), min(width, chunk[3]), 3)
    whole = (-(-n // c) * c for n, c in zip((light, 1, height, width, 3), chunk, strict=True))
    spec = store.ArraySpec(
        shape=tuple(shape), dtype=dtype, chunks=chunk, shards=tuple(whole), axes=("light", "view", "H", "W", "C")
    )
    return {"images": spec}


def table_attributes(
    lights: DirectionSet, views: DirectionSet, h: float, encoding: Encoding = "linear"
) -> dict[str, object]:
    """Return what a raw table says about itself."""
    unit = f"T = pi f_r cos(theta_i), {'sRGB codes' if encoding == 'srgb' else 'linear RGB'}"
    about: dict[str, object] = {"kind": "btf", "lights": lights.name, "views": views.name, "h": h, "unit": unit}
    return about if encoding == "linear" else {**about, "encoding": encoding}
