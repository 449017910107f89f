"""Which lights can brighten anything: neither without power, nor past every object, nor under every horizon.

In doubt a light reaches. What lies under the horizon of all vertices lies under that of every point between them, and
there a BTF is black; inside a shell nothing is known of normals.

Test: tests/render/test_reach.py
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

from torchmeso.geometry.light import DirectionalLight, Light, SpotLight
from torchmeso.render.scene import Object, Scene

FEW = 256
"""Normals of an object asked first: of a closed body's one in two reaches."""


def reaching(lights: Sequence[Light], scene: Scene, balls: Float[np.ndarray, "object 4"]) -> list[int]:
    """Return the numbers of the lights that may fall on an object.

    Args:
        lights: of the world that `balls` are in.
        scene: the objects; their normals alone are read.
        balls: centre and radius of a ball around each object.
    """
    return [i for i, light in enumerate(lights) if _reaches(light, scene, balls)]


def _reaches(light: Light, scene: Scene, balls: Float[np.ndarray, "object 4"]) -> bool:
    if isinstance(light, DirectionalLight):
        return float(light.irradiance.max()) > 0 and any(_rises(light, o) for o in scene.objects)
    if float(light.intensity.max()) <= 0:
        return False
    if not isinstance(light, SpotLight):
        return True
    centre, radius = balls[:, :3], balls[:, 3]
    way = centre - light.position.double().numpy()
    distance = np.maximum(np.linalg.norm(way, axis=-1), 1e-30)
    off_axis = np.arccos(np.clip(way @ light.axis.double().numpy() / distance, -1, 1))
    seen_under = np.arcsin(np.minimum(radius / distance, 1))
    return bool((off_axis <= np.radians(light.outer_deg) + seen_under + 1e-6).any())


def _rises(light: DirectionalLight, item: Object) -> bool:
    """Return whether a light stands above the horizon of any vertex."""
    if any(material.gdm is not None for material in item.materials):
        return True
    normals, w = item.mesh.normals, light.direction.to(item.mesh.normals)
    parts = normals[:: max(1, len(normals) // FEW)], normals
    return any(bool(torch.mv(n, w).max() > -1e-6) for n in parts)
