"""The eigen BTF, a run-time model: T(uv, wi, wo) = sum_k W_k(wo) E_k(uv, wi).

wang2005mdf, section 5: the BTF as a matrix with rows (x, y, light, rgb) and columns view, cut to a few singular
vectors. E_k are maps over lights and texels (the eigen maps), W_k weights over views; one W serves all three
channels. Maps are stored as uint8 with a scale and an offset per component and channel, or as float16 or
float32. Interpolation is linear, so it runs on the codes and decodes once. Weights have no texels: they are
interpolated on a finer set (`geometry.kriging`). In a file uint8 codes may be streams (`data.code_stream`).

Test: tests/data/test_eigen_btf.py
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchmeso.algebra import spherical_harmonics
from torchmeso.data import address, code_stream, mdf, model_writer, pyramid, store
from torchmeso.data.btf import horizon_falloff
from torchmeso.data.mdf import Mdf
from torchmeso.data.pyramid import Footprint
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.errors import FormatError, ShapeError, check_finite, check_shape
from torchmeso.geometry import hemisphere, kriging
from torchmeso.geometry.directions import from_angles
from torchmeso.geometry.hemisphere import DirectionSet

AROUND = 720
"""Steps around the pole in integrals of what is interpolated between directions."""


@dataclass(frozen=True, eq=False, kw_only=True)
class EigenBtf:
    """Eigen maps and view weights.

    Attributes:
        maps: (light, H, W, rank, 3) codes of E: uint8, float16, float32 or float64.
        weights: (view, rank) W, largest component first.
        scale: (rank, 3) E = offset + scale * code.
        offset: (rank, 3).
        lights: directions towards the light.
        views: directions towards the viewer.
        quilting: a larger texture made of the maps' texels, or None: the maps repeat.
    """

    maps: Shaped[Tensor, "light H W rank 3"]
    weights: Float[Tensor, "view rank"]
    scale: Float[Tensor, "rank 3"]
    offset: Float[Tensor, "rank 3"]
    lights: DirectionSet
    views: DirectionSet
    quilting: QuiltingMap | None = None

    def __post_init__(self) -> None:
        """Raise ShapeError unless the parts match."""
        rank = self.weights.shape[-1]
        check_shape("eigen.maps", self.maps, (len(self.lights), -1, -1, rank, 3))
        check_shape("eigen.weights", self.weights, (len(self.views), rank))
        check_shape("eigen.scale", self.scale, (rank, 3))
        check_shape("eigen.offset", self.offset, (rank, 3))
        if self.maps.dtype != torch.uint8 and not self.maps.is_floating_point():
            raise ShapeError(f"eigen.maps: expected uint8 or a float type, got {self.maps.dtype}")
        if rank < 1 or min(self.texels) < 1:
            raise ShapeError(f"eigen.maps: expected at least one component and texel, got {tuple(self.maps.shape)}")
        floats = {"weights": self.weights, "scale": self.scale, "offset": self.offset}
        for name, values in (
            floats.items() if self.maps.dtype == torch.uint8 else (*floats.items(), ("maps", self.maps))
        ):
            check_finite(f"eigen.{name}", values)

    @property
    def rank(self) -> int:
        """Number of components."""
        return self.weights.shape[1]

    @property
    def texels(self) -> tuple[int, int]:
        """Height and width of the texture."""
        return self.maps.shape[1], self.maps.shape[2]

    def truncated(self, rank: int) -> "EigenBtf":
        """Return the model with its first `rank` components only."""
        return replace(
            self,
            maps=self.maps[..., :rank, :],
            weights=self.weights[:, :rank],
            scale=self.scale[:rank],
            offset=self.offset[:rank],
        )

    def evaluate(
        self,
        uv: Float[Tensor, "*batch 2"],
        wi: Float[Tensor, "*batch 3"],
        wo: Float[Tensor, "*batch 3"],
        seen: Footprint | None = None,
    ) -> Float[Tensor, "*batch 3"]:
        """Return T(uv, wi, wo), linear RGB: 4 lights x 4 texels of E, 4 fine views of W; C0, differentiable.

        Args:
            uv: (..., 2) texture coordinates, unbounded.
            wi: (..., 3) unit direction to the light, local frame; T = 0 below the horizon.
            wo: (..., 3) unit direction to the viewer, local frame; held below the last ring.
            seen: what is to be averaged over, of (n, 2) uv; None = the point.

        Returns:
            (..., 3); a low rank can make it slightly negative, which is left to the caller.
        """
        light = hemisphere.interpolate(self.lights, wi)

        def look_up(which: Tensor, uv: Tensor, level: int) -> Tensor:
            height, width = self.levels[level].shape[1:3]
            taps = address.of_level(uv, height, width, level, self.quilting)
            node, share = light.node.reshape(-1, 4)[which], light.weight.reshape(-1, 4)[which]
            index = (node[..., :, None] * (height * width) + taps.texel[..., None, :]).flatten(-2)
            weight = (share[..., :, None] * taps.weight[..., None, :]).flatten(-2)
            return (self._nodes[level][index].to(uv.dtype) * weight[..., None, None]).sum(-3)

        E = self.offset.to(wo.dtype) + self.scale.to(wo.dtype) * pyramid.average(look_up, uv, seen, *self._size)
        return self._weighted(E, wo) * horizon_falloff(self.lights, wi)

    def ambient(
        self, uv: Float[Tensor, "*batch 2"], wo: Float[Tensor, "*batch 3"], seen: Footprint | None = None
    ) -> Float[Tensor, "*batch 3"]:
        """Return L_a(uv, wo) = (1/pi) times the integral of T over the light hemisphere (white: 1).

        What is `seen` is read at one place: light from everywhere shows little of what is small.
        """

        def look_up(which: Tensor, uv: Tensor, level: int) -> Tensor:
            E = self.ambient_maps[level]
            taps = address.of_level(uv, E.shape[0], E.shape[1], level, self.quilting)
            return (E.flatten(0, 1)[taps.texel].to(uv.dtype) * taps.weight[..., None, None]).sum(-3)

        return self._weighted(pyramid.average(look_up, uv, seen, *self._size, most=1), wo)

    def over_light(
        self, uv: Float[Tensor, "n 2"], wo: Float[Tensor, "n 3"], seen: Footprint | None = None
    ) -> Float[Tensor, "n light 3"]:
        """Return T(uv, w_l, wo) at all directions of light; `against` says what each is worth in a light."""
        directions = self.lights.directions(wo.dtype)
        return torch.stack([self.evaluate(uv, wi.expand(len(uv), 3), wo, seen) for wi in directions], 1)

    def against(self, degree: int) -> Float[Tensor, "light n"]:
        """Return, of each harmonic of distant light, what each direction's share of T reflects, times pi."""
        return hats_against(self.lights, degree)

    def view_weights(self, wo: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch rank"]:
        """Return W(wo), interpolated on a finer set than was measured."""
        view = hemisphere.interpolate(self.fine_weights[0], wo)
        return (self._weight_nodes.to(wo.dtype)[view.node] * view.weight.unsqueeze(-1)).sum(-2)

    def decoded(self) -> Float[Tensor, "light H W rank 3"]:
        """Return the eigen maps E as floating-point values."""
        return _decode(self.maps, self.scale, self.offset)

    @property
    def _size(self) -> tuple[int, int]:
        """Texels along the longer side, and levels."""
        return max(self.texels), len(self.levels)

    def _weighted(self, E: Tensor, wo: Tensor) -> Tensor:
        return (E * self.view_weights(wo).unsqueeze(-1)).sum(-2)

    @cached_property
    def levels(self) -> list[Shaped[Tensor, "light _ _ rank 3"]]:
        """The maps, and their means over ever more texels."""
        return pyramid.build(self.maps, 1)

    @cached_property
    def _nodes(self) -> list[Tensor]:
        """(nodes of light x texel, rank, 3) codes of each level, the pole appended."""
        return [hemisphere.with_pole(maps, self.lights).flatten(0, 2).contiguous() for maps in self.levels]

    @cached_property
    def fine_weights(self) -> tuple[DirectionSet, Float[Tensor, "view rank"]]:
        """W on a finer set of views, of which linear interpolation is nearer to views that were not measured."""
        views, weights = kriging.finer(self.views)
        return views, (weights @ self.weights.double()).to(self.weights.dtype)

    @cached_property
    def _weight_nodes(self) -> Tensor:
        views, weights = self.fine_weights
        return hemisphere.with_pole(weights, views)

    @cached_property
    def ambient_maps(self) -> list[Float[Tensor, "_ _ rank 3"]]:
        """E integrated over the light hemisphere, over pi; each level of the pyramid."""
        share = (hemisphere.quadrature(self.lights) / math.pi).to(self.scale.dtype)
        total = torch.zeros(self.maps.shape[1:], dtype=self.scale.dtype)
        for l in range(len(self.lights)):
            total += share[l] * _decode(self.maps[l], self.scale, self.offset)
        return pyramid.build(total, 0)


@lru_cache(maxsize=16)
def hats_against(lights: DirectionSet, degree: int) -> Float[Tensor, "light n"]:
    """Return H_lj = integral over the hemisphere of direction l's share of the interpolated T times y_j; float64.

    With the fall-off below the last ring. Gauss points between rings, many equal steps around.
    """
    edges = torch.cat([hemisphere.rings(lights).theta, torch.tensor([math.pi / 2], dtype=torch.float64)])
    nodes, shares = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(degree + 6))
    low, high = edges[:-1, None], edges[1:, None]
    theta = (low + (nodes + 1) / 2 * (high - low)).reshape(-1)
    weight = (shares / 2 * (high - low)).reshape(-1) * theta.sin() * (2 * math.pi / AROUND)
    phi = (torch.arange(AROUND, dtype=torch.float64) + 0.5) * (2 * math.pi / AROUND)
    H = torch.zeros(lights.n_nodes, spherical_harmonics.size(degree), dtype=torch.float64)
    for angle, part in zip(theta, weight, strict=True):
        w = from_angles(angle.expand(AROUND), phi)
        found = hemisphere.interpolate(lights, w)
        y = part * horizon_falloff(lights, w) * spherical_harmonics.basis(w, degree)
        H.index_add_(0, found.node.flatten(), (found.weight[..., None] * y[:, None]).flatten(0, 1))
    if lights.needs_pole:  # the mean of the first ring
        first = lights.count[0]
        H[:first] += H[-1] / first
    return H[: len(lights)]


def _decode(codes: Tensor, scale: Tensor, offset: Tensor) -> Tensor:
    return offset + scale * codes.to(scale.dtype)


def save(
    eigen: EigenBtf, path: str | Path, *, silhouette: Mdf | None = None, coded: bool = False, **meta: object
) -> None:
    """Write a run-time model (.meso): one tensor per component, and the material's MDF where it has one.

    Where it is `coded`, components of uint8 codes are streams, and those whose codes are all 0 are not stored.
    """
    tensors: dict[str, Tensor] = {}
    for k in range(eigen.rank):
        codes = eigen.maps[..., k, :]
        tensors |= _stream(k, codes) if coded else {f"eigen.map.{k}": codes}
    tensors |= {"eigen.weights": eigen.weights, "eigen.scale": eigen.scale, "eigen.offset": eigen.offset}
    parts = _meta(eigen.lights, eigen.views, eigen.rank, eigen.texels if coded else None, meta)
    if silhouette is not None:
        mdf_tensors, parts["mdf"] = mdf.to_tensors(silhouette)
        tensors |= mdf_tensors
    store.write_model(path, tensors, parts)


def write(
    path: str | Path,
    component: Callable[[int], tuple[Tensor, Tensor, Tensor]],
    *,
    weights: Float[Tensor, "view rank"],
    texels: tuple[int, int],
    dtype: torch.dtype,
    lights: DirectionSet,
    views: DirectionSet,
    silhouette: Mdf | None = None,
    coded: bool = False,
    **meta: object,
) -> None:
    """Write a run-time model (.meso) as `save` does, one component at a time.

    Args:
        path: of the model.
        component: called with k = 0, 1, ...; returns codes (light, H, W, 3), scale (3) and offset (3).
        weights: W.
        texels: height and width.
        dtype: of the codes.
        lights: directions towards the light.
        views: directions towards the viewer.
        silhouette: the material's MDF.
        coded: whether codes are streams, which are kept in memory until all are there.
        meta: what else the file says about itself.

    Raises:
        StorageError: the disk is full, or the place cannot be written to.
    """
    rank = weights.shape[1]
    depth: dict[str, Tensor] = {}
    parts = _meta(lights, views, rank, texels if coded else None, meta)
    if silhouette is not None:
        depth, parts["mdf"] = mdf.to_tensors(silhouette)
    if coded:
        streams: dict[str, Tensor] = {}
        scales, offsets = torch.empty(rank, 3), torch.empty(rank, 3)
        for k in range(rank):
            codes, scales[k], offsets[k] = component(k)
            streams |= _stream(k, codes)
        tensors = {"eigen.weights": weights, "eigen.scale": scales, "eigen.offset": offsets}
        store.write_model(path, {**streams, **tensors, **depth}, parts)
        return
    layout: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {
        f"eigen.map.{k}": (dtype, (len(lights), *texels, 3)) for k in range(rank)
    }
    layout |= dict.fromkeys(("eigen.scale", "eigen.offset"), (torch.float32, (rank, 3)))
    whole = {"eigen.weights": weights, **depth}
    layout |= {name: (x.dtype, tuple(x.shape)) for name, x in whole.items()}
    with model_writer.in_parts(path, layout, parts) as put:
        for k in range(rank):
            codes, scale, offset = component(k)
            put(f"eigen.map.{k}", codes, 0)
            put("eigen.scale", scale[None], k)
            put("eigen.offset", offset[None], k)
        for name, x in whole.items():
            put(name, x, 0)


def _stream(k: int, codes: Tensor) -> dict[str, Tensor]:
    return code_stream.named(f"eigen.code.{k}", codes, first=k == 0)


def _meta(
    lights: DirectionSet, views: DirectionSet, rank: int, coded: tuple[int, int] | None, more: dict[str, object]
) -> dict:
    """Return what the file says about itself; of streams it has to say the texels."""
    about: dict[str, object] = {"lights": lights.name, "views": views.name, "rank": rank}
    if coded is not None:
        about["texels"] = list(coded)
    return {"kind": "eigen", "eigen": about, **more}


def load(path: str | Path, *, rank: int | None = None) -> EigenBtf:
    """Return the eigen BTF of a run-time model, reading only the first `rank` components where that is given.

    Raises:
        FormatError: the file is missing, damaged, or holds no eigen BTF.
    """
    model = store.Model(path)
    about = model.meta.get("eigen")
    if about is None:
        raise FormatError(f"{path}: expected an eigen BTF, found {', '.join(model.names()) or 'nothing'}")
    with store.reading(path):
        kept = about["rank"] if rank is None else min(rank, about["rank"])
        if kept < 1:
            raise FormatError(f"{path}: expected at least one component, got {kept}; the copy may be incomplete")
        lights, scale = hemisphere.parse(about["lights"]), model.read("eigen.scale")
        check_shape("eigen.scale", scale, (about["rank"], 3))
        if "texels" in about:
            shape = len(lights), *about["texels"], 3
            maps = [code_stream.read(model, f"eigen.code.{k}", shape, first=k == 0) for k in range(kept)]
        else:
            maps = [model.read(f"eigen.map.{k}") for k in range(kept)]
        return EigenBtf(
            maps=torch.stack(maps, -2),
            weights=model.read("eigen.weights")[:, :kept],
            scale=scale[:kept],
            offset=model.read("eigen.offset")[:kept],
            lights=lights,
            views=hemisphere.parse(about["views"]),
        )
