"""The ray-traced truth of a configuration: every mesostructure laid over its mesh as triangles, path-traced.

It shares with the product only the ray caster, `transport` and the prism mapping. One path bundle goes
through each pixel's centre, because that is what the product samples; the ambient term is a uniform sky. An
environment shines as so many directional lights as its configuration says.

Test: tests/pipeline/test_truth.py
"""

import hashlib
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.config_sections import Config, MaterialConfig, ObjectConfig
from torchmeso.data import store, textured, tile_atlas
from torchmeso.data.quilting_map import QuiltingMap
from torchmeso.data.tile_set import TileSet
from torchmeso.errors import ConfigError
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.light import Light, illuminate
from torchmeso.geometry.mesh import Mesh
from torchmeso.geometry.mesh_file import Finish, Picture
from torchmeso.meso.displace import displace
from torchmeso.meso.mesostructure import Mesostructure, palette
from torchmeso.pipeline.bake import Report, code_hash, describe_meso, file_hash, prepare_material, silent, tiles_path
from torchmeso.pipeline.scene import Body, read_bodies, read_body
from torchmeso.transport import light_sampling
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
    objects, parts = zip(*_surfaces(config), strict=True)
    tracer = MeshTracer(*parts)
    report("truth: displaced mesh", 1)
    camera, lights = config.camera.build(), [light.build() for light in config.lights]
    if config.environment is not None:
        lights += light_sampling.lights(config.environment.build(), config.environment.lights)
    found = _trace(config, tracer, camera, lights, report)
    found = replace(found, owner=torch.tensor([*objects, -1])[found.owner])
    store.write_model(path, {"rgb": found.rgb, "depth": found.depth, "owner": found.owner}, {"kind": "truth"})
    return found


def geometries(config: Config) -> list[Geometry]:
    """Return the triangles of every object, one for each of its materials: displaced, or plain with its colours."""
    return [geometry for _, geometry in _surfaces(config)]


def _surfaces(config: Config) -> Iterator[tuple[int, Geometry]]:
    """Yield geometries with the number of the object that each belongs to, as `pipeline.scene` counts them."""
    mesos = {name: m.meso.build() for name, m in config.materials.items() if m.meso is not None}
    tiles = {}
    for name, m in config.materials.items():
        if m.tiled and m.meso is not None:
            raise ConfigError(
                f"truth: '{name}' is laid out by tiles, its mesostructure by none; only pictures are both"
            )
        if m.tiled and (found := prepare_material(name, m).tiles) is not None:
            tiles[name] = found
    first = 0
    for item, body in zip(config.objects, read_bodies(config, tiles), strict=True):
        places = item.places()
        # A similarity carries displaced triangles as it carries the mesh: each body is displaced once.
        for k, look in enumerate(body.looks):
            for geometry in _geometries(config, mesos, _only(body, k), look, tiles.get(str(look))):
                for i, matrix in enumerate(places):
                    vertices = geometry.vertices.double() @ matrix[:3, :3].double().T + matrix[:3, 3].double()
                    yield first + i, replace(geometry, vertices=vertices.float())
        first += len(places)


def _only(body: Body, k: int) -> Mesh:
    """Return the faces of a body that have its look `k`."""
    if body.part is None:
        return body.mesh
    mine = body.part == k
    return replace(body.mesh, faces=body.mesh.faces[mine], component=body.mesh.component[mine])


def _geometries(
    config: Config, mesos: dict[str, Mesostructure], body: Mesh, look: str | Finish, tiles: TileSet | None
) -> Iterator[Geometry]:
    """Yield what a body is made of: its surface, displaced, and the floor of a solid shell."""
    material = config.materials[look] if isinstance(look, str) else None
    if material is None or material.gdm is None:
        geometry = _geometry(config, mesos, body, look)
        yield geometry if tiles is None else _laid_out(geometry, tile_atlas.build(tiles).map)
        return
    h = mesos[str(look)].h
    lift = h if material.shell.side == "outward" else 0.0
    yield _geometry(config, mesos, _moved(body, lift), look)
    if material.shell.base == "solid":
        floor = _moved(body, lift - h)
        yield Geometry(
            vertices=floor.vertices.float(),
            faces=floor.faces,
            part=torch.zeros(len(floor.faces), dtype=torch.long),
            palette=palette((material.floor, 1.0, 0.0)),
            albedo_map=None,
            uv=floor.uv,
        )


def _moved(body: Mesh, height: float) -> Mesh:
    """Return a mesh moved along its normals, by tile units."""
    shift = height * body.scale.double()[:, None] * body.normals.double()
    return replace(body, vertices=(body.vertices.double() + shift).to(body.vertices.dtype))


def _geometry(config: Config, mesos: dict[str, Mesostructure], body: Mesh, look: str | Finish) -> Geometry:
    material = config.materials[look] if isinstance(look, str) else None
    finish = look if isinstance(look, Finish) else config.materials[look].finish
    if material is not None and material.meso is not None:
        return displace(body, mesos[str(look)], max_edge=config.truth.max_edge)
    if finish is None:
        raise ConfigError(
            f"truth: expected the mesostructure of '{look}', got a finished model; "
            "name its source with 'meso' to compare with the truth"
        )
    if finish.normal_map is not None:
        warnings.warn("truth: a normal map has no geometry; it is left out", stacklevel=2)
    colours = textured.from_finish(replace(finish, normal_map=None))
    return Geometry(
        vertices=body.vertices.float(),
        faces=body.faces,
        part=torch.zeros(len(body.faces), dtype=torch.long),
        palette=palette(((1.0, 1.0, 1.0), 1.0, 0.0)),
        albedo_map=colours.albedo,
        uv=body.uv,
    )


def _laid_out(geometry: Geometry, quilting: QuiltingMap) -> Geometry:
    """Return triangles whose picture is laid out by a map, once for all of it."""
    assert geometry.albedo_map is not None and geometry.uv is not None
    uv = geometry.uv / torch.tensor(quilting.periods)
    return replace(geometry, albedo_map=quilting.apply(geometry.albedo_map), uv=uv)


def first_hits(
    tracer: MeshTracer, camera: Camera
) -> tuple[Int[Tensor, "H W"], Float[Tensor, "H W"], Float[Tensor, "pixel 3"], Float[Tensor, "pixel 3"]]:
    """Return for each pixel the geometry hit (-1 = none), the distance, and all ray origins and directions."""
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
    used = {name: config.materials[name] for o in config.objects for name in o.used_materials}
    meshes = [[file_hash(o.mesh), _own_looks(o)] if o.mesh else None for o in config.objects]
    about = config.model_dump(include={"objects", "lights", "environment", "ambient", "background", "camera", "truth"})
    if config.environment is not None and config.environment.map is not None:
        meshes.append([file_hash(config.environment.map)])
    return store.content_hash(about, meshes, {n: _describe(m) for n, m in used.items()}, code_hash(CODE))


def _own_looks(item: ObjectConfig) -> list:
    """Return the looks that a mesh's file gives it, its pictures by content, for a content hash."""
    if item.material is not None:
        return []
    looks = [look for look in read_body(item).looks if isinstance(look, Finish)]
    return [
        [look.albedo, *(p if p is None else _picture_hash(p) for p in (look.albedo_map, look.normal_map))]
        for look in looks
    ]


def _picture_hash(picture: Picture) -> str:
    return file_hash(picture) if isinstance(picture, Path) else hashlib.sha256(picture).hexdigest()


def _describe(material: MaterialConfig) -> object:
    if material.meso is not None:
        meso = describe_meso(material.meso)
        in_shell = [material.shell.side, material.shell.base, material.floor]
        return meso if material.gdm is None else [meso, in_shell]
    pictures = [file_hash(p) for p in (material.albedo_map, material.normal_map) if p is not None]
    laid = None if material.wang is None else tiles_path(material).name
    return [material.albedo, laid, *pictures, *([file_hash(material.quilting)] if material.quilting else [])]
