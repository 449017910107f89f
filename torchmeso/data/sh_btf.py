"""The double-SH BTF, a run-time model: T(uv, wi, wo) = sum_ij C_ij(uv) y_i(wi) y_j(wo).

leung2007tileable, section 3.1: every texel and channel holds a matrix of k_l x k_v coefficients of real spherical
harmonics (`algebra.spherical_harmonics`), stored as uint8 with a scale and an offset per coefficient and channel, or
as float16 or float32. Interpolation is linear, so it runs on the codes. In a file uint8 codes may be streams
(`data.code_stream`).

The coefficients describe the measured part of the hemisphere. Beyond the last ring of directions T is the ring's
value, times cos(theta_i) / cos(last) along the light: as for every BTF of this package, and C0 at the horizon, which
the harmonics alone are not.

Test: tests/data/test_sh_btf.py
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchmeso.algebra.spherical_harmonics import basis, degree_of
from torchmeso.data import address, code_stream, mdf, model_writer, pyramid, store
from torchmeso.data.btf import horizon_falloff
from torchmeso.data.mdf import Mdf
from torchmeso.data.pyramid import Footprint
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.errors import FormatError, ShapeError, check_finite, check_shape
from torchmeso.geometry import hemisphere
from torchmeso.geometry.directions import from_angles, to_angles
from torchmeso.geometry.hemisphere import DirectionSet

POINTS = 4096
"""Evaluated at a time: their coefficients stay in the cache."""


@dataclass(frozen=True, eq=False, kw_only=True)
class ShBtf:
    """Coefficients of a BTF in spherical harmonics of light and view.

    Attributes:
        maps: (k_l, k_v, H, W, 3) codes of C: uint8, float16, float32 or float64.
        scale: (k_l, k_v, 3) C = offset + scale * code.
        offset: (k_l, k_v, 3).
        lights: directions towards the light that it was fitted to.
        views: directions towards the viewer that it was fitted to.
        quilting: a larger texture made of the maps' texels, or None: the maps repeat.
    """

    maps: Shaped[Tensor, "k_l k_v H W 3"]
    scale: Float[Tensor, "k_l k_v 3"]
    offset: Float[Tensor, "k_l k_v 3"]
    lights: DirectionSet
    views: DirectionSet
    quilting: QuiltingMap | None = None

    def __post_init__(self) -> None:
        """Raise ShapeError or ConfigError unless the parts match."""
        check_shape("sh.maps", self.maps, (-1, -1, -1, -1, 3))
        check_shape("sh.scale", self.scale, (*self.terms, 3))
        check_shape("sh.offset", self.offset, (*self.terms, 3))
        for terms in self.terms:
            degree_of(terms)
        if self.maps.dtype != torch.uint8 and not self.maps.is_floating_point():
            raise ShapeError(f"sh.maps: expected uint8 or a float type, got {self.maps.dtype}")
        if min(self.texels) < 1:
            raise ShapeError(f"sh.maps: expected at least one texel, got {self.texels[1]} x {self.texels[0]}")
        check_finite("sh.scale", self.scale)
        check_finite("sh.offset", self.offset)
        if self.maps.is_floating_point():
            check_finite("sh.maps", self.maps)

    @property
    def terms(self) -> tuple[int, int]:
        """Coefficients over light and view, k_l and k_v."""
        return self.maps.shape[0], self.maps.shape[1]

    @property
    def texels(self) -> tuple[int, int]:
        """Height and width of the texture."""
        return self.maps.shape[2], self.maps.shape[3]

    def truncated(self, light_terms: int, view_terms: int) -> "ShBtf":
        """Return the model with its first coefficients only, whole bands: 1, 4, 9, ..."""
        part = slice(light_terms), slice(view_terms)
        return replace(self, maps=self.maps[part], scale=self.scale[part], offset=self.offset[part])

    def evaluate(
        self,
        uv: Float[Tensor, "*batch 2"],
        wi: Float[Tensor, "*batch 3"],
        wo: Float[Tensor, "*batch 3"],
        seen: Footprint | None = None,
    ) -> Float[Tensor, "*batch 3"]:
        """Return T(uv, wi, wo), linear RGB; 0 for wi below the horizon.

        Args:
            uv: (..., 2) texture coordinates, unbounded.
            wi: (..., 3) unit direction to the light, local frame.
            wo: (..., 3) unit direction to the viewer, local frame; held below the last ring.
            seen: what is to be averaged over, of (n, 2) uv; None = the point.

        Returns:
            (..., 3); few coefficients can make it slightly negative, which is left to the caller.
        """
        light = held_basis(self.lights, wi, self.terms[0])
        return self._summed(uv, light, wo, seen) * horizon_falloff(self.lights, wi)

    def ambient(
        self, uv: Float[Tensor, "*batch 2"], wo: Float[Tensor, "*batch 3"], seen: Footprint | None = None
    ) -> Float[Tensor, "*batch 3"]:
        """Return L_a(uv, wo) = (1/pi) times the integral of T over the light hemisphere (white: 1)."""
        light = self.everywhere.to(wo.dtype).expand(*wo.shape[:-1], -1)
        return self._summed(uv, light, wo, seen, most=1)

    def over_light(
        self, uv: Float[Tensor, "n 2"], wo: Float[Tensor, "n 3"], seen: Footprint | None = None
    ) -> Float[Tensor, "n k_l 3"]:
        """Return c_rho(uv, wo), T's coefficients over the light; `against` says what they are worth in a light."""
        each = torch.eye(self.terms[0], dtype=wo.dtype)
        return torch.stack([self._summed(uv, light.expand(len(uv), -1), wo, seen) for light in each], 1)

    def against(self, degree: int) -> Float[Tensor, "k_l n"]:
        """Return A: what T's coefficients reflect, times pi, of each harmonic of distant light; see `basis_against`."""
        return basis_against(self.lights, self.terms[0], degree)

    def decoded(self) -> Float[Tensor, "k_l k_v H W 3"]:
        """Return the coefficients C as floating-point values."""
        codes = self.maps.to(self.scale.dtype)
        return self.offset[:, :, None, None] + self.scale[:, :, None, None] * codes

    def _summed(
        self, uv: Tensor, light: Tensor, wo: Tensor, seen: Footprint | None, most: int = pyramid.MOST_PROBES
    ) -> Tensor:
        """Return the sum over coefficients, given the basis of the light."""
        view = held_basis(self.views, wo, self.terms[1])
        weight = (light.unsqueeze(-1) * view.unsqueeze(-2)).flatten(-2).reshape(-1, math.prod(self.terms))
        scale, offset = (x.to(uv.dtype).flatten(0, 1) for x in (self.scale, self.offset))

        def look_up(which: Tensor, uv: Tensor, level: int) -> Tensor:
            height, width = self.levels[level].shape[2:4]
            taps = address.of_level(uv, height, width, level, self.quilting)
            found = [
                torch.einsum("ptkc,pt,pk,kc->pc", self._texels[level][texel].to(uv.dtype), share, w, scale)
                for texel, share, w in zip(
                    taps.texel.split(POINTS), taps.weight.split(POINTS), weight[which].split(POINTS), strict=True
                )
            ]
            return torch.cat(found) if found else uv.new_zeros(0, 3)

        texels = max(self.texels), len(self.levels)
        summed = pyramid.average(look_up, uv, seen, *texels, most=most)
        return summed + (weight @ offset).reshape(summed.shape)

    @cached_property
    def levels(self) -> list[Shaped[Tensor, "k_l k_v _ _ 3"]]:
        """The maps, and their means over ever more texels."""
        return pyramid.build(self.maps, 2)

    @cached_property
    def _texels(self) -> list[Tensor]:
        """(texel, k_l k_v, 3) codes of each level: all that a texel needs in one place."""
        return [x.flatten(0, 1).flatten(1, 2).movedim(0, 1).contiguous() for x in self.levels]

    @cached_property
    def everywhere(self) -> Float[Tensor, "k_l"]:
        """Each harmonic of the light, held and falling off as in `evaluate`, over the hemisphere and pi."""
        return basis_everywhere(self.lights, self.terms[0])


def held_basis(directions: DirectionSet, w: Float[Tensor, "*batch 3"], terms: int) -> Float[Tensor, "*batch n"]:
    """Return the basis at w, below the last ring at that ring's direction of the same azimuth."""
    theta, phi = to_angles(w)
    inside = (theta <= directions.last).unsqueeze(-1)
    return basis(torch.where(inside, w, from_angles(theta.clamp(max=directions.last), phi)), degree_of(terms))


def basis_everywhere(lights: DirectionSet, terms: int) -> Float[Tensor, "n"]:
    """Return each harmonic of the light, held and falling off below the last ring, over the hemisphere and pi."""
    w, weight = _hemisphere_points(lights.last, degree_of(terms))
    return (weight / math.pi) @ (held_basis(lights, w, terms) * horizon_falloff(lights, w))


@lru_cache(maxsize=16)
def basis_against(lights: DirectionSet, terms: int, degree: int) -> Float[Tensor, "n_l n"]:
    """Return A_ij = integral over the hemisphere of y_i, held and falling off as in `evaluate`, times y_j; float64.

    leung2007tileable, eq. (2). Where the last ring lies on the horizon it is the matrix of plain harmonics; below, T is
    another function than they are, and this one integrates it. It is the same for coefficients of a hemisphere's fit
    and of a sphere's projection, because `evaluate` reads both on the upper hemisphere alone.
    """
    w, weight = _hemisphere_points(lights.last, max(degree_of(terms), degree))
    T = held_basis(lights, w, terms) * horizon_falloff(lights, w)
    return T.mT @ (weight[:, None] * basis(w, degree))


def _hemisphere_points(last: float, degree: int) -> tuple[Tensor, Tensor]:
    """Return points and solid angles over the hemisphere, exact for harmonics within `last` and close beyond it."""
    import numpy as np

    nodes, weights = (torch.from_numpy(x) for x in np.polynomial.legendre.leggauss(degree + 4))
    z, dz = [], []
    for low, high in ((0.0, math.cos(last)), (math.cos(last), 1.0)):
        z.append(low + (nodes + 1) * ((high - low) / 2))
        dz.append(weights * ((high - low) / 2))
    steps = 2 * degree + 1
    phi = torch.arange(steps, dtype=torch.float64) * (2 * math.pi / steps)
    theta = torch.cat(z).clamp(-1, 1).acos()
    w = from_angles(*torch.broadcast_tensors(theta[:, None], phi))
    weight = (torch.cat(dz) * (2 * math.pi / steps))[:, None].expand(-1, steps)
    return w.reshape(-1, 3), weight.reshape(-1)


def bands(terms: int) -> list[slice]:
    """Return the coefficients of each band l = 0, 1, ...: 2 l + 1 of them."""
    return [slice(l * l, (l + 1) ** 2) for l in range(degree_of(terms) + 1)]


def save(model: ShBtf, path: str | Path, *, silhouette: Mdf | None = None, coded: bool = False, **meta: object) -> None:
    """Write a run-time model (.meso): one tensor per band of light and view, and the material's MDF if it has one.

    Where it is `coded`, the bands of the view of each coefficient of the light are streams of uint8 codes, and those
    whose codes are all 0 are not stored.
    """
    tensors: dict[str, Tensor] = {}
    if coded:
        for i in range(model.terms[0]):
            tensors |= _streams(i, model.maps[i])
    else:
        for a, light in enumerate(bands(model.terms[0])):
            for b, view in enumerate(bands(model.terms[1])):
                tensors[f"sh.map.{a}.{b}"] = model.maps[light, view]
    tensors |= {"sh.scale": model.scale, "sh.offset": model.offset}
    parts = _meta(model.lights, model.views, model.terms, model.texels if coded else None, meta)
    if silhouette is not None:
        mdf_tensors, parts["mdf"] = mdf.to_tensors(silhouette)
        tensors |= mdf_tensors
    store.write_model(path, tensors, parts)


def write(
    path: str | Path,
    coefficients: Callable[[int], tuple[Tensor, Tensor, Tensor]],
    *,
    terms: tuple[int, int],
    texels: tuple[int, int],
    dtype: torch.dtype,
    lights: DirectionSet,
    views: DirectionSet,
    silhouette: Mdf | None = None,
    coded: bool = False,
    **meta: object,
) -> None:
    """Write a run-time model (.meso) as `save` does, one coefficient of the light at a time.

    Args:
        path: of the model.
        coefficients: called with i = 0, 1, ...; returns codes (k_v, H, W, 3), scale (k_v, 3) and offset of (i, 0), ...
        terms: k_l and k_v.
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
    parts = _meta(lights, views, terms, texels if coded else None, meta)
    depth: dict[str, Tensor] = {}
    if silhouette is not None:
        depth, parts["mdf"] = mdf.to_tensors(silhouette)
    if coded:
        streams: dict[str, Tensor] = {}
        scales, offsets = torch.empty(*terms, 3), torch.empty(*terms, 3)
        for i in range(terms[0]):
            codes, scales[i], offsets[i] = coefficients(i)
            streams |= _streams(i, codes)
        store.write_model(path, {**streams, "sh.scale": scales, "sh.offset": offsets, **depth}, parts)
        return
    layout: dict[str, tuple[torch.dtype, tuple[int, ...]]] = {
        f"sh.map.{a}.{b}": (dtype, (2 * a + 1, 2 * b + 1, *texels, 3))
        for a in range(len(bands(terms[0])))
        for b in range(len(bands(terms[1])))
    }
    layout |= dict.fromkeys(("sh.scale", "sh.offset"), (torch.float32, (*terms, 3)))
    layout |= {name: (x.dtype, tuple(x.shape)) for name, x in depth.items()}
    with model_writer.in_parts(path, layout, parts) as put:
        for a, light in enumerate(bands(terms[0])):
            for i in range(light.start, light.stop):
                codes, scale, offset = coefficients(i)
                put("sh.scale", scale[None], i)
                put("sh.offset", offset[None], i)
                for b, view in enumerate(bands(terms[1])):
                    put(f"sh.map.{a}.{b}", codes[None, view], i - light.start)
        for name, x in depth.items():
            put(name, x, 0)


def _streams(i: int, codes: Tensor) -> dict[str, Tensor]:
    """Return the streams of coefficient i of the light, one for each band of the view."""
    found: dict[str, Tensor] = {}
    for b, view in enumerate(bands(len(codes))):
        found |= code_stream.named(f"sh.code.{i}.{b}", codes[view], first=i == b == 0)
    return found


def _meta(
    lights: DirectionSet,
    views: DirectionSet,
    terms: tuple[int, int],
    coded: tuple[int, int] | None,
    more: dict[str, object],
) -> dict:
    """Return what the file says about itself; of streams it has to say the texels."""
    about = {"lights": lights.name, "views": views.name, "terms": list(terms), "domain": "hemisphere_fit"}
    if coded is not None:
        about["texels"] = list(coded)
    return {"kind": "sh", "sh": about, **more}


def load(path: str | Path, *, degree: int | None = None) -> ShBtf:
    """Return the double-SH BTF of a run-time model, reading only bands up to `degree` where that is given.

    Raises:
        FormatError: the file is missing, damaged, or holds no double-SH BTF.
    """
    model = store.Model(path)
    about = model.meta.get("sh")
    if about is None:
        raise FormatError(f"{path}: expected a double-SH BTF, found {', '.join(model.names()) or 'nothing'}")
    with store.reading(path):
        scale = model.read("sh.scale")
        check_shape("sh.scale", scale, (*about["terms"], 3))
        kept = [n if degree is None else min(n, (degree + 1) ** 2) for n in about["terms"]]
        views = bands(kept[1])
        if "texels" in about:
            rows = [_opened(model, i, views, about["texels"])[None] for i in range(kept[0])]
        else:
            rows = [
                torch.cat([model.read(f"sh.map.{a}.{b}") for b in range(len(views))], 1)
                for a in range(len(bands(kept[0])))
            ]
        return ShBtf(
            maps=torch.cat(rows),
            scale=scale[: kept[0], : kept[1]],
            offset=model.read("sh.offset")[: kept[0], : kept[1]],
            lights=hemisphere.parse(about["lights"]),
            views=hemisphere.parse(about["views"]),
        )


def _opened(model: store.Model, i: int, views: list[slice], texels: list[int]) -> Tensor:
    """Return the codes (k_v, H, W, 3) of coefficient i of the light."""
    height, width = texels
    return torch.cat([
        code_stream.read(model, f"sh.code.{i}.{b}", (view.stop - view.start, height, width, 3), first=i == b == 0)
        for b, view in enumerate(views)
    ])  # fmt: skip
