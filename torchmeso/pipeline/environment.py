"""The environment of a configuration as light on a scene: a sum over lights, harmonics, or harmonics at every vertex.

A turning environment is sampled once and its lights turn with it, so that they do not flicker.

Test: tests/pipeline/test_environment.py
"""

import hashlib
import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.algebra import spherical_harmonics
from torchmeso.config_sections import Config, Vector
from torchmeso.data import store
from torchmeso.data import transfer as transfers
from torchmeso.data.distant_light import DistantLight
from torchmeso.data.transfer import Transfer
from torchmeso.geometry.directions import normalize
from torchmeso.pipeline.bake import Report, code_hash, silent
from torchmeso.render import environment as environments
from torchmeso.render.scene import Material, Object, Scene
from torchmeso.transport import light_sampling, transfer
from torchmeso.transport.transfer import Bodies, TransferOptions

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
    followed = None
    degree = settings.degree
    if settings.method == "transfer":
        degree = 5 if degree is None else degree
        options = TransferOptions(degree=degree, rays=settings.rays, bounces=settings.bounces)
        followed = transfer_of(scene, options, report)
    c = environment.harmonics(7 if degree is None else degree)

    def under_harmonics(angle_deg: float) -> Scene:
        turned = spherical_harmonics.rotate(c.mT, about(up, angle_deg)).mT
        light = DistantLight(coefficients=turned) if followed is None else followed.arriving(turned)
        return replace(scene, distant=light)

    return under_harmonics


def transfer_of(scene: Scene, options: TransferOptions, report: Report = silent) -> Transfer:
    """Return the transfer of a scene's bodies, from the cache where nothing of them changed.

    Raises:
        MesoError: there is too little room, or a material cannot be lit in the frequency domain.
    """
    environments.check(scene)
    bodies = bodies_of(scene)
    content = hashlib.sha256()
    for x in bodies:
        content.update(str(tuple(x.shape)).encode() + x.contiguous().numpy().tobytes())
    key = store.content_hash(content.hexdigest(), repr(options), code_hash(("transport", "geometry", "algebra")))
    path = store.cache_dir() / f"{key}.transfer.meso"
    if path.exists():
        return transfers.load(path)
    found = transfer.bake(bodies, options, progress=lambda share: report("transfer", share))
    path.parent.mkdir(parents=True, exist_ok=True)
    transfers.save(found, path)
    return found


def bodies_of(scene: Scene) -> Bodies:
    """Return the bodies of a scene, each of the mean colour of its materials."""
    meshes = [o.mesh for o in scene.objects]
    first = [0, *itertools.accumulate(len(m.vertices) for m in meshes)]
    faces = torch.cat([m.faces + start for m, start in zip(meshes, first, strict=False)])
    vertices, normals = torch.cat([m.vertices.float() for m in meshes]), torch.cat([m.normals.float() for m in meshes])
    albedo = torch.cat([_albedo(o) for o in scene.objects])
    return Bodies(vertices, faces, normalize(normals), albedo)


def _albedo(body: Object) -> Float[Tensor, "V 3"]:
    """Return the mean colour of the material at each vertex: that under light from everywhere, seen from above."""
    each = torch.stack([_mean_colour(material) for material in body.materials])
    part = torch.zeros(len(body.mesh.vertices), dtype=torch.long)
    if body.part is not None:
        part[body.mesh.faces] = body.part.long()[:, None]
    return each[part]


def _mean_colour(material: Material) -> Float[Tensor, "3"]:
    if material.btf is None:
        return torch.tensor(material.albedo)
    steps = (torch.arange(16) + 0.5) / 16
    uv = torch.cartesian_prod(steps, steps)
    return material.btf.ambient(uv, torch.tensor([0.0, 0.0, 1.0]).expand(len(uv), 3)).mean(0).clamp(0, 1).float()


def about(axis: Vector, angle_deg: float) -> Float[Tensor, "3 3"]:
    """Return the rotation around `axis`, float64."""
    k = torch.tensor(axis, dtype=torch.float64)
    x, y, z = (k / k.norm()).tolist()
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    a = math.radians(angle_deg)
    return torch.eye(3, dtype=torch.float64) + math.sin(a) * cross + (1 - math.cos(a)) * cross @ cross
