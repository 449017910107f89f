"""The path integrator: radiance along rays from every light, with shadows and interreflection.

At each vertex of a path all lights are asked at once (a shadow ray each), so that one set of paths serves a
whole BTF column; the path then goes on in a direction drawn from the material. A uniform environment of
radiance `ambient` is met by paths that escape. The number of bounces is a dial: 0 is direct light only, exact
up to the footprint.

Test: tests/transport/test_path.py
"""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso.geometry import frames
from torchmeso.geometry.light import Light, illuminate
from torchmeso.transport import materials
from torchmeso.transport.tracer import Surface, Tracer

RAY_BATCH = 1 << 21
"""Shadow rays handled at once; bounds the memory of a bake with many lights."""


def radiance(
    tracer: Tracer,
    origin: Float[Tensor, "n 3"],
    direction: Float[Tensor, "n 3"],
    lights: Sequence[Light],
    *,
    bounces: int,
    ambient: float = 0.0,
    rng: torch.Generator,
) -> tuple[Float[Tensor, "n light 3"], Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Return the radiance that arrives along rays, light by light.

    Args:
        tracer: the scene.
        origin: (n, 3).
        direction: (n, 3) unit, away from the viewer.
        lights: the lights; each is sampled at every vertex.
        bounces: reflections after the first surface that are followed.
        ambient: radiance of a uniform environment.
        rng: draws the directions of bounces.

    Returns:
        (n, light, 3) linear RGB of each light, (n, 3) of the environment as reflected (0 where a ray escapes at once),
        and (n,) whether the ray meets a surface.
    """
    by_light = torch.zeros(len(origin), len(lights), 3)
    from_sky = torch.zeros(len(origin), 3)
    path = torch.arange(len(origin))
    throughput = torch.ones(len(origin), 3)
    seen = torch.zeros(len(origin), dtype=torch.bool)
    for depth in range(bounces + 1):
        surface = tracer.trace(origin, direction)
        if depth == 0:
            seen = surface.hit
        else:
            from_sky.index_add_(0, path[~surface.hit], ambient * throughput[~surface.hit])
        hit = surface.hit
        path, throughput, wo_world = path[hit], throughput[hit], -direction[hit]
        surface = _select(surface, hit)
        frame = frames.around(surface.normal)
        wo = frames.to_local(frame, wo_world)
        origin = tracer.leave(surface)
        by_light.index_add_(0, path, throughput[:, None] * _direct(tracer, surface, origin, frame, wo, lights))
        if depth == bounces and ambient == 0:
            break
        drawn = materials.sample(surface.material, wo, rng)
        throughput, direction = throughput * drawn.weight, frames.to_world(frame, drawn.wi)
        useful = throughput.amax(-1) > 0
        path, throughput, origin, direction = path[useful], throughput[useful], origin[useful], direction[useful]
    if ambient > 0:  # the last reflection is only asked whether it sees the sky
        free = ~tracer.occluded(origin, direction, torch.full((len(origin),), torch.inf))
        from_sky.index_add_(0, path[free], ambient * throughput[free])
    return by_light, from_sky, seen


def _direct(
    tracer: Tracer, surface: Surface, origin: Tensor, frame: frames.Frame, wo: Tensor, lights: Sequence[Light]
) -> Tensor:
    """Return (n, light, 3): what each light sends towards wo by way of the surface, shadows included."""
    n = len(wo)
    result = torch.zeros(n, len(lights), 3)
    group = max(1, RAY_BATCH // max(n, 1))
    for first in range(0, len(lights), group):
        sent = [illuminate(light, surface.position) for light in lights[first : first + group]]
        wi_world, distance, E = (torch.stack(x) for x in zip(*sent, strict=True))  # (g, n, ...)
        wi = frames.to_local(frame, wi_world)
        reflected = materials.evaluate(surface.material, wi, wo) * wi[..., 2:].clamp(min=0) * E
        lit = (reflected.amax(-1) > 0).flatten().nonzero()[:, 0]
        start = origin[lit % max(n, 1)]
        blocked = tracer.occluded(start, wi_world.reshape(-1, 3)[lit], distance.flatten()[lit] * (1 - 1e-5))
        reflected.view(-1, 3)[lit[blocked]] = 0
        result[:, first : first + group] = reflected.transpose(0, 1)
    return result


def _select(surface: Surface, keep: Tensor) -> Surface:
    """Return the surface points where `keep` holds."""
    material = materials.Reflectance(*(x[keep] for x in surface.material))
    return Surface(surface.hit[keep], surface.t[keep], surface.position[keep], surface.normal[keep], material)
