"""The ray-traced truth of a configuration: every mesostructure laid over its mesh as triangles, path-traced.

It shares with the product only the ray caster, `transport` and the prism mapping. One path bundle goes
through each pixel's centre, because that is what the product samples; the ambient term is a uniform sky.

Test: tests/pipeline/test_truth.py
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.config import Config, MaterialConfig
from torchmeso.data import store
from torchmeso.errors import ConfigError
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.light import Light, illuminate
from torchmeso.meso.displace import displace
from torchmeso.meso.mesostructure import palette
from torchmeso.pipeline.bake import Report, code_hash, describe_meso, file_hash, silent
from torchmeso.pipeline.scene import build_mesh
from torchmeso.transport.path import radiance
from torchmeso.transport.tracer import Geometry, MeshTracer

CODE = ("meso", "transport", "geometry", "data", "pipeline")
"""Folders whose code decides what a truth shows."""

RAYS = 1 << 16
"""Camera rays handled at once."""


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class Truth:
    """A ray-traced picture; row 0 on top.

    Attributes:
        rgb: (H, W, 3) linear radiance.
        depth: (H, W) distance along the pixel's ray; inf where nothing is met.
        owner: (H, W) object seen, -1 = background.
    """

    rgb: Float[Tensor, "H W 3"]
    depth: Float[Tensor, "H W"]
    owner: Int[Tensor, "H W"]


def render(config: Config, report: Report = silent) -> Truth:
    """Return the truth of `config`, from the cache where it is there.

    Raises:
        ConfigError: a material is a finished model: its geometry is not known.
        MesoError: a file is missing, or the displaced mesh would not fit in memory.
    """
    path = store.cache_dir() / f"{_key(config)}.truth"
    if path.exists():
        kept = store.Model(path)
        return Truth(rgb=kept.read("rgb"), depth=kept.read("depth"), owner=kept.read("owner"))
    report("truth: displaced mesh", 0)
    tracer = MeshTracer(*geometries(config))
    report("truth: displaced mesh", 1)
    camera, lights = config.camera.build(), [light.build() for light in config.lights]
    found = _trace(config, tracer, camera, lights, report)
    store.write_model(path, {"rgb": found.rgb, "depth": found.depth, "owner": found.owner}, {"kind": "truth"})
    return found


def geometries(config: Config) -> list[Geometry]:
    """Return the triangles of every object: displaced where it has a mesostructure, plain else."""
    mesos = {name: m.meso.build() for name, m in config.materials.items() if m.meso is not None}
    result = []
    for item in config.objects:
        body, material = build_mesh(item), config.materials[item.material]
        if material.model is not None:
            raise ConfigError(
                f"truth: expected the mesostructure of '{item.material}', got a finished model; "
                "name its source with 'meso' to compare with the truth"
            )
        if material.meso is None:
            assert material.albedo is not None
            part = torch.zeros(len(body.faces), dtype=torch.long)
            colour = palette((material.albedo, 1.0, 0.0))
            result.append(Geometry(vertices=body.vertices.float(), faces=body.faces, part=part, palette=colour))
        else:
            result.append(displace(body, mesos[item.material], max_edge=config.truth.max_edge))
    return result


def first_hits(
    tracer: MeshTracer, camera: Camera
) -> tuple[Int[Tensor, "H W"], Float[Tensor, "H W"], Float[Tensor, "pixel 3"], Float[Tensor, "pixel 3"]]:
    """Return for each pixel the object hit (-1 = none), the distance, and all ray origins and directions."""
    origin, direction, _ = camera.rays(camera.pixel_centres().reshape(-1, 2))
    hits, owner = tracer.first_hits(origin, direction)
    size = (camera.height, camera.width)
    owner = torch.where(hits.face >= 0, owner, -1)
    return owner.reshape(size), hits.t.reshape(size), origin, direction


def shadows(tracer: MeshTracer, camera: Camera, light: Light) -> Bool[Tensor, "H W"]:
    """Return the pixels whose first surface is cut off from `light`; false where nothing is seen."""
    origin, direction, _ = camera.rays(camera.pixel_centres().reshape(-1, 2))
    surface = tracer.trace(origin, direction)
    start = tracer.leave(surface)
    towards, distance, _ = illuminate(light, start)
    dark = tracer.occluded(start, towards, distance)
    facing_away = (surface.normal * towards).sum(-1) <= 0
    return ((dark | facing_away) & surface.hit).reshape(camera.height, camera.width)


def _trace(config: Config, tracer: MeshTracer, camera: Camera, lights: list[Light], report: Report) -> Truth:
    owner, depth, origin, direction = first_hits(tracer, camera)
    rgb = torch.tensor(config.background).repeat(camera.width * camera.height, 1)
    seen = (owner.flatten() >= 0).nonzero()[:, 0]
    samples = config.truth.samples
    for k, part in enumerate(seen.split(RAYS)):
        rng = torch.Generator().manual_seed(k)
        total = torch.zeros(len(part), 3)
        for sample in range(samples):
            by_light, sky, _ = radiance(
                tracer, origin[part], direction[part], lights,
                bounces=config.truth.bounces, ambient=config.ambient, rng=rng,
            )  # fmt: skip
            total += by_light.sum(1) + sky
            report("truth: paths", (k + (sample + 1) / samples) * RAYS / max(len(seen), RAYS))
        rgb[part] = total / samples
    report("truth: paths", 1)
    return Truth(rgb=rgb.reshape(*owner.shape, 3), depth=depth, owner=owner)


def _key(config: Config) -> str:
    used = {o.material: config.materials[o.material] for o in config.objects}
    meshes = [file_hash(o.mesh) if o.mesh else None for o in config.objects]
    about = config.model_dump(include={"objects", "lights", "ambient", "background", "camera", "truth"})
    return store.content_hash(about, meshes, {n: _describe(m) for n, m in used.items()}, code_hash(CODE))


def _describe(material: MaterialConfig) -> object:
    return material.albedo if material.meso is None else describe_meso(material.meso)
