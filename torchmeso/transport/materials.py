"""Materials: Lambert under a GGX coat, per part of a surface.

    f_r = (1 - F(cos_i)) (1 - F(cos_o)) albedo / pi  +  D(wh) G2(wi, wo) F(wi.wh) / (4 cos_i cos_o)

with GGX D and height-correlated Smith G2 (walter2007microfacet, heitz2014understanding) and Schlick's F
(schlick1994inexpensive) whose grazing value fades out below f0 = 0.02, so that f0 = 0 is a pure diffuser. The
model is reciprocal and never sends out more than it receives. Directions are in a local frame around the
surface normal, away from the surface.

Test: tests/transport/test_materials.py
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import ConfigError, check_shape
from torchmeso.geometry.directions import dot, normalize


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Palette:
    """The materials of a surface's parts.

    Attributes:
        albedo: (part, 3) linear RGB diffuse albedo in [0, 1].
        alpha: (part,) GGX width in [0.02, 1]: not squared.
        f0: (part, 3) reflectance of the coat at normal incidence in [0, 1]; 0 = no coat.
    """

    albedo: Float[Tensor, "part 3"]
    alpha: Float[Tensor, "part"]
    f0: Float[Tensor, "part 3"]

    def __post_init__(self) -> None:
        """Raise ShapeError or ConfigError unless the parts are physical."""
        n = len(self.albedo)
        check_shape("palette.albedo", self.albedo, (n, 3))
        check_shape("palette.alpha", self.alpha, (n,))
        check_shape("palette.f0", self.f0, (n, 3))
        for name, low in (("albedo", 0.0), ("alpha", 0.02), ("f0", 0.0)):
            value = getattr(self, name)
            if not bool(((value >= low) & (value <= 1)).all()):
                raise ConfigError(f"palette.{name}: expected values from {low:g} to 1, got {value.flatten().tolist()}")


class Reflectance(NamedTuple):
    """Material parameters at n points: albedo (n, 3), alpha (n,), f0 (n, 3)."""

    albedo: Float[Tensor, "*n 3"]
    alpha: Float[Tensor, "*n"]
    f0: Float[Tensor, "*n 3"]


class Sample(NamedTuple):
    """A direction drawn from a material.

    Attributes:
        wi: (n, 3) unit direction.
        weight: (n, 3) f_r cos_i / pdf; 0 where the direction lies below the surface.
        pdf_w: (n,) density over solid angle.
    """

    wi: Float[Tensor, "n 3"]
    weight: Float[Tensor, "n 3"]
    pdf_w: Float[Tensor, "n"]


def evaluate(
    material: Reflectance, wi: Float[Tensor, "*#batch 3"], wo: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*#batch 3"]:
    """Return f_r(wi, wo); 0 where either direction is at or below the surface."""
    cos_i, cos_o = wi[..., 2:], wo[..., 2:]
    up = (cos_i > 0) & (cos_o > 0)
    cos_i, cos_o = cos_i.clamp(min=1e-6), cos_o.clamp(min=1e-6)
    through = (1 - fresnel(material.f0, cos_i)) * (1 - fresnel(material.f0, cos_o))
    diffuse = through * material.albedo / math.pi
    if not bool(material.f0.any()):
        return torch.where(up, diffuse, 0)
    wh = normalize(wi + wo)
    alpha = material.alpha.unsqueeze(-1)
    F = fresnel(material.f0, dot(wi, wh).unsqueeze(-1).clamp(0, 1))
    # G2 / (4 cos_i cos_o) in one expression: heitz2014understanding, eq. (99), stays finite at grazing angles.
    root_i = (alpha.square() + (1 - alpha.square()) * cos_i.square()).sqrt()
    root_o = (alpha.square() + (1 - alpha.square()) * cos_o.square()).sqrt()
    visible = 0.5 / (cos_o * root_i + cos_i * root_o)
    specular = ndf(wh[..., 2:], alpha) * visible * F
    return torch.where(up, diffuse + specular, 0)


def sample(material: Reflectance, wo: Float[Tensor, "n 3"], rng: torch.Generator) -> Sample:
    """Return directions drawn from a mixture of a cosine lobe and the visible GGX normals.

    heitz2018sampling for the coat. `wo` must lie above the surface.
    """
    xi = torch.rand(len(wo), 3, generator=rng, dtype=wo.dtype)
    share = _coat_share(material, wo)
    from_coat = xi[:, 2] < share
    wh = _visible_normal(wo, material.alpha, xi[:, 0], xi[:, 1])
    wi = torch.where(from_coat[:, None], 2 * dot(wo, wh).unsqueeze(-1) * wh - wo, _cosine(xi[:, 0], xi[:, 1]))
    pdf_w = pdf(material, wi, wo)
    usable = (wi[:, 2] > 0) & (pdf_w > 0)
    weight = evaluate(material, wi, wo) * (wi[:, 2] / pdf_w.clamp(min=1e-12)).unsqueeze(-1)
    return Sample(wi, torch.where(usable[:, None], weight, 0), pdf_w)


def pdf(material: Reflectance, wi: Float[Tensor, "n 3"], wo: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
    """Return the density with which `sample` draws `wi`, over solid angle; 0 below the surface."""
    share = _coat_share(material, wo)
    wh = normalize(wi + wo)
    cos_o = wo[..., 2].clamp(min=1e-6)
    alpha = material.alpha
    root = (alpha.square() + (1 - alpha.square()) * cos_o.square()).sqrt()
    # G1(wo) D(wh) / (4 cos_o), with G1 = 2 cos_o / (cos_o + root)
    coat = ndf(wh[..., 2], alpha) / (2 * (cos_o + root))
    density = share * coat + (1 - share) * wi[..., 2] / math.pi
    return torch.where(wi[..., 2] > 0, density, 0)


def ndf(cos_h: Float[Tensor, "*#batch"], alpha: Float[Tensor, "*#batch"]) -> Float[Tensor, "*#batch"]:
    """Return the GGX density D of microfacet normals; walter2007microfacet, eq. (33)."""
    a2 = alpha.square()
    # 1 - cos^2 (1 - a^2), written so that float32 keeps the peak of a narrow lobe
    inner = (1 - cos_h) * (1 + cos_h) + a2 * cos_h.square()
    return a2 / (math.pi * inner.square())


def fresnel(f0: Float[Tensor, "*#batch 3"], cosine: Float[Tensor, "*#batch 1"]) -> Float[Tensor, "*#batch 3"]:
    """Return Schlick's reflectance; its grazing value is min(1, 50 f0), so that no coat stays no coat."""
    f90 = (50 * f0.amax(-1, keepdim=True)).clamp(max=1)
    return f0 + (f90 - f0).clamp(min=0) * (1 - cosine) ** 5


def _coat_share(material: Reflectance, wo: Tensor) -> Tensor:
    """Return the probability of sampling the coat: its share of the reflected energy, kept away from 0 and 1."""
    F = fresnel(material.f0, wo[..., 2:].clamp(0, 1)).mean(-1)
    diffuse = (1 - F) * material.albedo.mean(-1)
    share = (F / (F + diffuse).clamp(min=1e-9)).clamp(0.1, 0.9)
    return torch.where(material.f0.amax(-1) > 0, share, 0)


def _cosine(xi_1: Tensor, xi_2: Tensor) -> Tensor:
    radius, phi = xi_1.sqrt(), 2 * math.pi * xi_2
    return torch.stack([radius * phi.cos(), radius * phi.sin(), (1 - xi_1).clamp(min=0).sqrt()], -1)


def _visible_normal(wo: Tensor, alpha: Tensor, xi_1: Tensor, xi_2: Tensor) -> Tensor:
    """Return a microfacet normal drawn from those `wo` sees; heitz2018sampling, section 3."""
    a = alpha.unsqueeze(-1)
    stretched = normalize(torch.cat([a * wo[:, :2], wo[:, 2:]], -1))
    flat = (stretched[:, 0].square() + stretched[:, 1].square()).clamp(min=1e-14)
    t1 = torch.stack([-stretched[:, 1], stretched[:, 0], torch.zeros_like(flat)], -1) / flat.sqrt().unsqueeze(-1)
    t1 = torch.where((flat > 1e-12)[:, None], t1, torch.tensor([1.0, 0.0, 0.0], dtype=wo.dtype))
    t2 = torch.linalg.cross(stretched, t1)
    radius, phi = xi_1.sqrt(), 2 * math.pi * xi_2
    p1, p2 = radius * phi.cos(), radius * phi.sin()
    s = 0.5 * (1 + stretched[:, 2])
    p2 = (1 - s) * (1 - p1.square()).clamp(min=0).sqrt() + s * p2
    p3 = (1 - p1.square() - p2.square()).clamp(min=0).sqrt()
    normal = p1[:, None] * t1 + p2[:, None] * t2 + p3[:, None] * stretched
    return normalize(torch.cat([a * normal[:, :2], normal[:, 2:].clamp(min=1e-7)], -1))
