"""Lights: directional, point and spot, each as (wi, E) at a surface point.

E is the irradiance on a surface that faces the light; radiance = (1/pi) E T with T the BTF value. A
directional light's default E = pi makes a white diffuser at normal incidence come out as 1.

Test: tests/geometry/test_light.py
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.errors import check_finite, check_range, check_shape
from torchmeso.geometry.directions import dot, normalize

MOST_POWER = 1e20
"""Of a light: the radiance of the largest reflectance (`data.btf.LARGEST`) beside it is still a float32."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class DirectionalLight:
    """A light at infinity.

    Attributes:
        direction: (3,) unit direction towards the light, world.
        irradiance: (3,) linear RGB at normal incidence.
    """

    direction: Float[Tensor, "3"]
    irradiance: Float[Tensor, "3"]

    def __post_init__(self) -> None:
        """Raise ShapeError unless both are RGB or xyz triples that mean a light."""
        check_shape("light.direction", self.direction, (3,))
        check_shape("light.irradiance", self.irradiance, (3,))
        _check_unit("light.direction", self.direction)
        check_finite("light.irradiance", self.irradiance, 0, MOST_POWER)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PointLight:
    """A small light that shines in all directions.

    Attributes:
        position: (3,) world.
        intensity: (3,) linear RGB radiant intensity; E = intensity / r^2.
    """

    position: Float[Tensor, "3"]
    intensity: Float[Tensor, "3"]

    def __post_init__(self) -> None:
        """Raise ShapeError unless both are triples that mean a light."""
        check_shape("light.position", self.position, (3,))
        check_shape("light.intensity", self.intensity, (3,))
        check_finite("light.position", self.position)
        check_finite("light.intensity", self.intensity, 0, MOST_POWER)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class SpotLight:
    """A small light with a cone, full inside `inner_deg` of the axis and smoothly 0 at `outer_deg`.

    Attributes:
        position: (3,) world.
        axis: (3,) unit direction the light shines along, world.
        intensity: (3,) linear RGB radiant intensity on the axis; E = intensity / r^2.
        inner_deg: half angle of the full cone.
        outer_deg: half angle of the whole cone, below 85.
    """

    position: Float[Tensor, "3"]
    axis: Float[Tensor, "3"]
    intensity: Float[Tensor, "3"]
    inner_deg: float = 25.0
    outer_deg: float = 30.0

    def __post_init__(self) -> None:
        """Raise ShapeError or ConfigError for a malformed light."""
        check_shape("light.position", self.position, (3,))
        check_shape("light.axis", self.axis, (3,))
        check_shape("light.intensity", self.intensity, (3,))
        check_finite("light.position", self.position)
        _check_unit("light.axis", self.axis)
        check_finite("light.intensity", self.intensity, 0, MOST_POWER)
        check_range("light.outer_deg", self.outer_deg, 0.1, 85)
        check_range("light.inner_deg", self.inner_deg, 0, self.outer_deg)


Light = DirectionalLight | PointLight | SpotLight


def _check_unit(name: str, w: Tensor) -> None:
    """Raise ShapeError unless `w` is a direction."""
    check_finite(name, w)
    check_finite(f"{name} (its length)", w.norm()[None], 1 - 1e-3, 1 + 1e-3)


def illuminate(
    light: Light, points: Float[Tensor, "*batch 3"]
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"], Float[Tensor, "*batch 3"]]:
    """Return what `light` sends to `points`, unoccluded.

    Returns:
        wi_world (..., 3) unit direction towards the light; distance (...) to it, inf for a directional light;
        E (..., 3) irradiance at normal incidence.
    """
    if isinstance(light, DirectionalLight):
        wi_world = light.direction.to(points.dtype).expand_as(points)
        return wi_world, torch.full_like(points[..., 0], math.inf), light.irradiance.to(points.dtype).expand_as(points)
    offset = light.position.to(points.dtype) - points
    distance = offset.norm(dim=-1)
    wi_world = normalize(offset)
    E = light.intensity.to(points.dtype) / distance.square().clamp(min=1e-12).unsqueeze(-1)
    if isinstance(light, SpotLight):
        E = E * _spot_falloff(light, wi_world).unsqueeze(-1)
    return wi_world, distance, E


def _spot_falloff(light: SpotLight, wi_world: Tensor) -> Tensor:
    """Return 1 inside the inner cone, 0 outside the outer one, a smoothstep of the cosine between them."""
    cosine = -dot(light.axis.to(wi_world.dtype), wi_world)
    outer, inner = math.cos(math.radians(light.outer_deg)), math.cos(math.radians(light.inner_deg))
    x = ((cosine - outer) / max(inner - outer, 1e-6)).clamp(0, 1)
    return x * x * (3 - 2 * x)
