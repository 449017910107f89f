"""Radiance of surface points: lights that arrive times the BTF, plus the ambient term.

    L = (1/pi) sum over visible lights of E T(uv, wi, wo)  +  ambient L_a(uv, wo)

A plain material is Lambertian: T = albedo cos(theta_i), L_a = albedo. A pixel on which no light falls keeps the
ambient term alone; `ambient_rule` "paper" shows it only there.

Test: tests/render/test_btf_shade.py
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso.data.pyramid import Footprint, footprint
from torchmeso.geometry import frames
from torchmeso.geometry.light import illuminate
from torchmeso.render.scene import Material, Points, Scene


def shade(
    scene: Scene,
    points: Points,
    wo_world: Float[Tensor, "n 3"],
    shadowed: Bool[Tensor, "light n"],
    *,
    samples: int | None = 1,
) -> Float[Tensor, "n 3"]:
    """Return the linear RGB radiance of `points` towards `wo_world`.

    Args:
        scene: materials, lights and ambient.
        points: where, on the base surface.
        wo_world: (n, 3) unit, to the viewer.
        shadowed: (light, n) whether a light is blocked.
        samples: along a side of a pixel, which share what it covers of a texture; None = textures are not filtered.
    """
    total = torch.zeros_like(points.position)
    lit = torch.zeros(len(total), dtype=torch.bool)
    wo = frames.to_local(points.frame, wo_world)
    for light, blocked in zip(scene.lights, shadowed, strict=True):
        wi_world, _, E = illuminate(light, points.position)
        wi = frames.to_local(points.frame, wi_world)
        arrives = (~blocked & (wi[:, 2] > 0) & (E.amax(-1) > 0)).nonzero()[:, 0]
        lit[arrives] = True
        T = _per_material(scene, points.select(arrives), wi[arrives], wo[arrives], samples)
        total[arrives] += E[arrives] * T / math.pi
    dark = ~lit if scene.ambient_rule == "paper" else torch.ones_like(lit)
    which = dark.nonzero()[:, 0]
    if scene.ambient > 0 and len(which):
        total[which] += scene.ambient * _per_material(scene, points.select(which), None, wo[which], samples)
    return total


def _per_material(scene: Scene, points: Points, wi: Tensor | None, wo: Tensor, samples: int | None) -> Tensor:
    """Return T, or L_a where `wi` is None; a low-rank model's negative values become 0."""
    result = torch.zeros_like(points.position)
    for i, material in enumerate(scene.surfaces):
        mine = (points.owner == i).nonzero()[:, 0]
        if len(mine):
            from_light = None if wi is None else wi[mine]
            seen = None
            if samples is not None:
                seen = footprint(wo[mine], points.pixel[mine] / (points.scale[mine] * samples))
            result[mine] = _reflect(material, points.uv[mine], from_light, wo[mine], seen)
    return result.clamp(min=0)


def _reflect(material: Material, uv: Tensor, wi: Tensor | None, wo: Tensor, seen: Footprint | None) -> Tensor:
    if material.btf is not None:
        return material.btf.ambient(uv, wo, seen) if wi is None else material.btf.evaluate(uv, wi, wo, seen)
    albedo = torch.tensor(material.albedo, dtype=uv.dtype)
    return albedo.expand(len(uv), 3) if wi is None else albedo * wi[:, 2:].clamp(min=0)
