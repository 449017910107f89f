"""The SH + PCA BTF, a run-time model: T(uv, wi, wo) = sum_km W_k(uv, wo) b_kmc y_m(wi).

kawasaki2005quilting, eq. (1): light-dependent looks as real spherical harmonics (`algebra.spherical_harmonics`), views
discrete. Over a set of views every texel has K weights W_k, which serve all three channels; b_k are the principal
components of the vectors of coefficients. As in eq. (1) there is no mean besides. The three views around the viewer
are blended (`geometry.triangulation`). Weights are stored as uint8 with a scale and an offset per component, or as
float16 or float32; interpolation is linear, so it runs on the codes.

`domain` says what the harmonics describe: the measured part of the hemisphere (`hemisphere_fit`), or the whole sphere,
nothing below the horizon (`sphere_projection`). Both are held below the last ring of lights and fall off with
cos(theta_i) / cos(last) there: as for every BTF of this package, and C0 at the horizon, which harmonics alone are not.

Kernel: kernels_cl/data/sh_pca_btf.clh          Test: tests/data/test_sh_pca_btf.py
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, get_args

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchmeso.algebra.spherical_harmonics import degree_of
from torchmeso.data import address, mdf, model_writer, pyramid, store
from torchmeso.data.btf import horizon_falloff
from torchmeso.data.mdf import Mdf
from torchmeso.data.pyramid import Footprint
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.data.sh_btf import basis_against, basis_everywhere, held_basis
from torchmeso.errors import FormatError, ShapeError, check_finite, check_shape
from torchmeso.geometry import hemisphere, triangulation
from torchmeso.geometry.hemisphere import DirectionSet

Domain = Literal["hemisphere_fit", "sphere_projection"]


@dataclass(frozen=True, eq=False, kw_only=True)
class ShPcaBtf:
    """Weights over views and texels, and what each of them weighs.

    Attributes:
        maps: (view, H, W, rank) codes of W: uint8, float16, float32 or float64; largest component first.
        scale: (rank) W = offset + scale * code.
        offset: (rank).
        basis: (rank, k_l, 3) b_kmc, coefficients over the light.
        lights: directions towards the light that it was fitted to.
        views: directions towards the viewer.
        domain: what the coefficients describe.
        quilting: a larger texture made of the maps' texels, or None: the maps repeat.
    """

    maps: Shaped[Tensor, "view H W rank"]
    scale: Float[Tensor, "rank"]
    offset: Float[Tensor, "rank"]
    basis: Float[Tensor, "rank k_l 3"]
    lights: DirectionSet
    views: DirectionSet
    domain: Domain = "hemisphere_fit"
    quilting: QuiltingMap | None = None

    def __post_init__(self) -> None:
        """Raise ShapeError or ConfigError unless the parts match."""
        check_shape("sh_pca.maps", self.maps, (len(self.views), -1, -1, -1))
        check_shape("sh_pca.scale", self.scale, (self.rank,))
        check_shape("sh_pca.offset", self.offset, (self.rank,))
        check_shape("sh_pca.basis", self.basis, (self.rank, -1, 3))
        degree_of(self.terms)
        if self.maps.dtype != torch.uint8 and not self.maps.is_floating_point():
            raise ShapeError(f"sh_pca.maps: expected uint8 or a float type, got {self.maps.dtype}")
        if self.rank < 1 or min(self.texels) < 1:
            raise ShapeError(f"sh_pca.maps: expected at least one component and texel, got {tuple(self.maps.shape)}")
        floats = {"scale": self.scale, "offset": self.offset, "basis": self.basis}
        for name, values in floats.items():
            check_finite(f"sh_pca.{name}", values)
        if self.maps.is_floating_point():
            check_finite("sh_pca.maps", self.maps)

    @property
    def rank(self) -> int:
        """Number of components K."""
        return self.maps.shape[3]

    @property
    def terms(self) -> int:
        """Coefficients over the light."""
        return self.basis.shape[1]

    @property
    def texels(self) -> tuple[int, int]:
        """Height and width of the texture."""
        return self.maps.shape[1], self.maps.shape[2]

    def truncated(self, rank: int) -> "ShPcaBtf":
        """Return the model with its first `rank` components only."""
        return replace(
            self,
            maps=self.maps[..., :rank],
            scale=self.scale[:rank],
            offset=self.offset[:rank],
            basis=self.basis[:rank],
        )

    def evaluate(
        self,
        uv: Float[Tensor, "*batch 2"],
        wi: Float[Tensor, "*batch 3"],
        wo: Float[Tensor, "*batch 3"],
        seen: Footprint | None = None,
    ) -> Float[Tensor, "*batch 3"]:
        """Return T(uv, wi, wo), linear RGB: 3 views x 4 texels of W, harmonics of the light; C0, differentiable.

        Args:
            uv: (..., 2) texture coordinates, unbounded.
            wi: (..., 3) unit direction to the light, local frame; T = 0 below the horizon.
            wo: (..., 3) unit direction to the viewer, local frame; held below the last ring.
            seen: what is to be averaged over, of (n, 2) uv; None = the point.

        Returns:
            (..., 3); few components can make it slightly negative, which is left to the caller.
        """
        light = held_basis(self.lights, wi, self.terms)
        T = torch.einsum("...k,kmc,...m->...c", self.weights(uv, wo, seen), self.basis.to(uv.dtype), light)
        return T * horizon_falloff(self.lights, wi)

    def ambient(
        self, uv: Float[Tensor, "*batch 2"], wo: Float[Tensor, "*batch 3"], seen: Footprint | None = None
    ) -> Float[Tensor, "*batch 3"]:
        """Return L_a(uv, wo) = (1/pi) times the integral of T over the light hemisphere (white: 1).

        What is `seen` is read at one place: light from everywhere shows little of what is small.
        """
        each = torch.einsum("kmc,m->kc", self.basis.to(uv.dtype), self.everywhere.to(uv.dtype))
        return self.weights(uv, wo, seen, most=1) @ each

    def over_light(
        self, uv: Float[Tensor, "n 2"], wo: Float[Tensor, "n 3"], seen: Footprint | None = None
    ) -> Float[Tensor, "n k_l 3"]:
        """Return c_rho(uv, wo), T's coefficients over the light; `against` says what they are worth in a light."""
        return torch.einsum("nk,kmc->nmc", self.weights(uv, wo, seen), self.basis.to(uv.dtype))

    def against(self, degree: int) -> Float[Tensor, "k_l n"]:
        """Return A: what T's coefficients reflect, times pi, of each harmonic of distant light; see `basis_against`."""
        return basis_against(self.lights, self.terms, degree)

    def weights(
        self,
        uv: Float[Tensor, "*batch 2"],
        wo: Float[Tensor, "*batch 3"],
        seen: Footprint | None = None,
        *,
        most: int = pyramid.MOST_PROBES,
    ) -> Float[Tensor, "*batch rank"]:
        """Return W(uv, wo), blended from three views; at `most` so many places are read along a pixel."""
        view = triangulation.interpolate(self.views, wo)
        nodes, shares = view.node.reshape(-1, 3), view.weight.reshape(-1, 3)

        def look_up(which: Tensor, uv: Tensor, level: int) -> Tensor:
            height, width = self.levels[level].shape[1:3]
            taps = address.of_level(uv, height, width, level, self.quilting)
            index = (nodes[which][..., None] * (height * width) + taps.texel[..., None, :]).flatten(-2)
            share = (shares[which][..., None] * taps.weight[..., None, :]).flatten(-2)
            return (self._nodes[level][index].to(uv.dtype) * share.unsqueeze(-1)).sum(-2)

        codes = pyramid.average(look_up, uv, seen, max(self.texels), len(self.levels), most)
        return self.offset.to(uv.dtype) + self.scale.to(uv.dtype) * codes

    def decoded(self) -> Float[Tensor, "view H W rank"]:
        """Return the weights W as floating-point values."""
        return self.offset + self.scale * self.maps.to(self.scale.dtype)

    @cached_property
    def levels(self) -> list[Shaped[Tensor, "view _ _ rank"]]:
        """The maps, and their means over ever more texels."""
        return pyramid.build(self.maps, 1)

    @cached_property
    def _nodes(self) -> list[Tensor]:
        """(nodes of view x texel, rank) codes of each level, the pole appended."""
        return [hemisphere.with_pole(maps, self.views).flatten(0, 2).contiguous() for maps in self.levels]

    @cached_property
    def everywhere(self) -> Float[Tensor, "k_l"]:
        """Each harmonic of the light, held and falling off as in `evaluate`, over the hemisphere and pi."""
        return basis_everywhere(self.lights, self.terms)


def save(model: ShPcaBtf, path: str | Path, *, silhouette: Mdf | None = None, **meta: object) -> None:
    """Write a run-time model (.meso): one tensor per component, and the material's MDF where it has one."""
    tensors = {f"sh_pca.map.{k}": model.maps[..., k] for k in range(model.rank)}
    tensors |= {"sh_pca.scale": model.scale, "sh_pca.offset": model.offset, "sh_pca.basis": model.basis}
    parts = _meta(model.lights, model.views, model.rank, model.terms, model.domain, meta)
    if silhouette is not None:
        mdf_tensors, parts["mdf"] = mdf.to_tensors(silhouette)
        tensors |= mdf_tensors
    store.write_model(path, tensors, parts)


def write(
    path: str | Path,
    component: Callable[[int], tuple[Tensor, Tensor, Tensor]],
    *,
    basis: Float[Tensor, "rank m 3"],
    texels: tuple[int, int],
    dtype: torch.dtype,
    lights: DirectionSet,
    views: DirectionSet,
    domain: Domain,
    silhouette: Mdf | None = None,
    **meta: object,
) -> None:
    """Write a run-time model (.meso) as `save` does, one component at a time.

    Args:
        path: of the model.
        component: called with k = 0, 1, ...; returns codes (view, H, W), scale () and offset ().
        basis: b.
        texels: height and width.
        dtype: of the codes.
        lights: directions towards the light.
        views: directions towards the viewer.
        domain: of the coefficients.
        silhouette: the material's MDF.
        meta: what else the file says about itself.

    Raises:
        StorageError: the disk is full, or the place cannot be written to.
    """
    rank, terms, _ = basis.shape
    parts = _meta(lights, views, rank, terms, domain, meta)
    whole = {"sh_pca.basis": basis}
    if silhouette is not None:
        depth, parts["mdf"] = mdf.to_tensors(silhouette)
        whole |= depth
    layout: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {
        f"sh_pca.map.{k}": (dtype, (len(views), *texels)) for k in range(rank)
    }
    layout |= dict.fromkeys(("sh_pca.scale", "sh_pca.offset"), (torch.float32, (rank,)))
    layout |= {name: (x.dtype, tuple(x.shape)) for name, x in whole.items()}
    with model_writer.in_parts(path, layout, parts) as put:
        for k in range(rank):
            codes, scale, offset = component(k)
            put(f"sh_pca.map.{k}", codes, 0)
            put("sh_pca.scale", scale.reshape(1), k)
            put("sh_pca.offset", offset.reshape(1), k)
        for name, x in whole.items():
            put(name, x, 0)


def _meta(
    lights: DirectionSet, views: DirectionSet, rank: int, terms: int, domain: Domain, more: dict[str, object]
) -> dict[str, object]:
    about = {"lights": lights.name, "views": views.name, "rank": rank, "terms": terms, "domain": domain}
    return {"kind": "sh-pca", "sh_pca": about, **more}


def load(path: str | Path, *, rank: int | None = None) -> ShPcaBtf:
    """Return the SH + PCA BTF of a run-time model, reading only the first `rank` components where that is given.

    Raises:
        FormatError: the file is missing, damaged, or holds no SH + PCA BTF.
    """
    model = store.Model(path)
    about = model.meta.get("sh_pca")
    if about is None:
        raise FormatError(f"{path}: expected an SH + PCA BTF, found {', '.join(model.names()) or 'nothing'}")
    with store.reading(path):
        kept = about["rank"] if rank is None else min(rank, about["rank"])
        if kept < 1:
            raise FormatError(f"{path}: expected at least one component, got {kept}; the copy may be incomplete")
        if about["domain"] not in get_args(Domain):
            raise FormatError(
                f"{path}: expected the domain {' or '.join(get_args(Domain))}, got '{about['domain']}'; "
                "update torchmeso"
            )
        return ShPcaBtf(
            maps=torch.stack([model.read(f"sh_pca.map.{k}") for k in range(kept)], -1),
            scale=model.read("sh_pca.scale")[:kept],
            offset=model.read("sh_pca.offset")[:kept],
            basis=model.read("sh_pca.basis")[:kept],
            lights=hemisphere.parse(about["lights"]),
            views=hemisphere.parse(about["views"]),
            domain=about["domain"],
        )
