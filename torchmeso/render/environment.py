"""Radiance of surface points under distant light, in the frequency domain (leung2007tileable, section 4.2).

    L = (1/pi) c_rho(uv, wo)^T A R e

e are the coefficients of the light that arrives, in the world (`data.distant_light`); R turns them into the frame of
the point; c_rho are T's coefficients over the light and A what each reflects of each harmonic of a light, both told by
the BTF (`over_light`, `against`). R is analytic and acts on the vectors, once for all points of one frame. A plain
surface is Lambertian around its normal: its coefficients are those of a cosine, whatever the horizon cuts off a bump.

Test: tests/render/test_environment.py
"""

import math
from typing import Protocol, runtime_checkable

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra import spherical_harmonics
from torchmeso.data.btf import Evaluable
from torchmeso.data.pyramid import Footprint, footprint
from torchmeso.data.textured import Textured
from torchmeso.errors import ConfigError
from torchmeso.geometry.frames import Frame
from torchmeso.render.scene import Material, Points, Scene


@runtime_checkable
class Harmonic(Protocol):
    """A BTF that can be lit in the frequency domain."""

    def over_light(
        self, uv: Float[Tensor, "n 2"], wo: Float[Tensor, "n 3"], seen: Footprint | None = None
    ) -> Float[Tensor, "n k 3"]:
        """Return T's coefficients over the light."""
        ...

    def against(self, degree: int) -> Float[Tensor, "k n"]:
        """Return what each coefficient reflects of each harmonic of a light, times pi."""
        ...


def check(scene: Scene) -> None:
    """Raise ConfigError where a material of a scene with distant light cannot be lit in the frequency domain."""
    for material in scene.surfaces if scene.distant is not None else ():
        if material.gdm is not None or not _harmonic(material.btf):
            kind = "a GDM" if material.gdm is not None else f"a {type(material.btf).__name__}"
            raise ConfigError(
                f"environment: {kind} cannot be lit in the frequency domain; compress it, or use the method 'sampling'"
            )


def _harmonic(btf: Evaluable | None) -> bool:
    return btf is None or isinstance(btf, Textured | Harmonic)


def shade(
    scene: Scene,
    points: Points,
    wo: Float[Tensor, "n 3"],
    arriving: Float[Tensor, "n n_e 3"],
    *,
    samples: int | None = 1,
) -> Float[Tensor, "n 3"]:
    """Return the linear RGB radiance of `points` towards the local direction `wo` under distant light.

    Args:
        scene: materials.
        points: where, on the base surface.
        wo: (n, 3) unit, local, to the viewer.
        arriving: (n, n_e, 3) coefficients of the light at the points, world.
        samples: as in `btf_shade.shade`.
    """
    local = in_frames(arriving.to(wo.dtype), points.frame)
    result = torch.zeros_like(points.position)
    for i, material in enumerate(scene.surfaces):
        mine = (points.owner == i).nonzero()[:, 0]
        if not len(mine):
            continue
        seen = None
        if samples is not None:
            seen = footprint(wo[mine], points.pixel[mine] / (points.scale[mine] * samples))
        result[mine] = _reflect(material, points.uv[mine], wo[mine], seen, local[mine]) / math.pi
    return result.clamp(min=0)


def in_frames(e: Float[Tensor, "n n_e 3"], frame: Frame) -> Float[Tensor, "n n_e 3"]:
    """Return world coefficients in the local frames of points; right- and left-handed ones."""
    b = torch.linalg.cross(frame.n, frame.t)
    mirrored = (b * frame.b).sum(-1) < 0
    R = torch.stack([frame.t, b, frame.n], -2)
    local = spherical_harmonics.rotate(e.mT, R[:, None]).mT
    return torch.where(mirrored[:, None, None], spherical_harmonics.mirror_y(local.mT).mT, local)


def _reflect(material: Material, uv: Tensor, wo: Tensor, seen: Footprint | None, e: Tensor) -> Tensor:
    """Return pi times the radiance."""
    btf, degree = material.btf, spherical_harmonics.degree_of(e.shape[1])
    if isinstance(btf, Textured) or btf is None:
        up = torch.tensor([0.0, 0.0, 1.0], dtype=e.dtype).expand(len(e), 3)
        normal = up if btf is None else btf.normal(uv, seen)
        share = torch.einsum(
            "nj,j,njc->nc",
            spherical_harmonics.basis(normal, degree),
            spherical_harmonics.cosine_lobe(degree).to(e.dtype),
            e,
        )
        return share * (torch.tensor(material.albedo, dtype=e.dtype) if btf is None else btf.colour(uv, seen))
    assert isinstance(btf, Harmonic)
    return torch.einsum("nkc,kj,njc->nc", btf.over_light(uv, wo, seen), btf.against(degree).to(e.dtype), e)
