"""The environment of a configuration as light on a scene: a sum over lights, harmonics, or harmonics at every vertex.

A turning environment is sampled once and its lights turn with it, so that they do not flicker.

Test: tests/pipeline/test_environment.py
"""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra import spherical_harmonics
from torchmeso.config_sections import Config, Vector
from torchmeso.data.distant_light import DistantLight
from torchmeso.pipeline.bake import Report, silent
from torchmeso.render.scene import Scene
from torchmeso.transport import light_sampling

Lit = Callable[[float], Scene]
"""Returns a scene under its environment turned by an angle in degrees."""


def prepare(config: Config, scene: Scene, report: Report = silent) -> Lit:
    """Return `scene` as the environment of `config` lights it; as it is, where there is none.

    Raises:
        MesoError: the map is missing or unreadable.
    """
    settings = config.environment
    if settings is None:
        return lambda _: scene
    environment, up = settings.build(), config.camera.up
    if settings.method == "sampling":
        lights = light_sampling.lights(environment, settings.lights, method=settings.sampling)

        def under_lights(angle_deg: float) -> Scene:
            R = about(up, angle_deg).float()
            return replace(scene, lights=scene.lights + tuple(replace(x, direction=R @ x.direction) for x in lights))

        return under_lights
    c = environment.harmonics(settings.degree)

    def under_harmonics(angle_deg: float) -> Scene:
        turned = spherical_harmonics.rotate(c.mT, about(up, angle_deg)).mT
        return replace(scene, distant=DistantLight(coefficients=turned))

    return under_harmonics


def about(axis: Vector, angle_deg: float) -> Float[Tensor, "3 3"]:
    """Return the rotation around `axis`, float64."""
    k = torch.tensor(axis, dtype=torch.float64)
    x, y, z = (k / k.norm()).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    a = math.radians(angle_deg)
    return torch.eye(3, dtype=torch.float64) + math.sin(a) * cross + (1 - math.cos(a)) * cross @ cross
