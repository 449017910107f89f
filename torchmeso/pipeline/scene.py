"""From a configuration to something that can be rendered: meshes read and placed, materials ready, lights, camera.

Test: tests/pipeline/test_scene.py
"""

import warnings
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from torchmeso.config_sections import Config, ObjectConfig
from torchmeso.data import tiled_surface
from torchmeso.data.tile_set import TileSet
from torchmeso.errors import ConfigError, did_you_mean
from torchmeso.geometry import mesh, mesh_file, unwrap
from torchmeso.geometry.mesh import Mesh
from torchmeso.geometry.mesh_file import Finish, Group, MeshFile
from torchmeso.pipeline import dress
from torchmeso.pipeline.bake import Asset, plain
from torchmeso.render.scene import Material, Object, Scene
from torchmeso.synthesize.parameterize import SurfaceOptions


class Body(NamedTuple):
    """A mesh, not yet placed, and what its parts look like.

    Attributes:
        mesh: dressed.
        part: (F,) row of `looks`; None = all faces have the first.
        looks: the name of a material of the configuration, or the look that the file gives.
    """

    mesh: Mesh
    part: Int[Tensor, "F"] | None
    looks: tuple[str | Finish, ...]


def build(config: Config, assets: dict[str, Asset]) -> Scene:
    """Return the scene of `config` with its prepared materials; an object for each place of each body.

    Raises:
        MesoError: a mesh or a picture is missing or unreadable, or a part of a mesh has no material.
    """
    found: dict[Finish, Material] = {}

    def material(look: str | Finish) -> Material:
        if isinstance(look, str):
            return assets[look].material
        if look not in found:
            found[look] = plain(look)
        return found[look]

    objects = []
    tiles = {name: asset.tiles for name, asset in assets.items() if asset.tiles is not None}
    for item, body in zip(config.objects, read_bodies(config, tiles), strict=True):
        first, *others = (material(look) for look in body.looks)
        objects += [
            Object(mesh=mesh.transform(body.mesh, matrix), material=first, others=tuple(others), part=body.part)
            for matrix in item.places()
        ]
    return Scene(
        objects=tuple(objects),
        lights=tuple(light.build() for light in config.lights),
        ambient=config.ambient,
        ambient_rule=config.ambient_rule,
        background=config.background,
    )


def bare(scene: Scene) -> Scene:
    """Return the scene without its MDFs: what a BTF alone can show."""
    return replace(
        scene,
        objects=tuple(
            replace(o, material=replace(o.material, mdf=None), others=tuple(replace(m, mdf=None) for m in o.others))
            for o in scene.objects
        ),
    )


def read_bodies(config: Config, tiles: dict[str, TileSet] | None = None) -> list[Body]:
    """Return the body of each object of `config`; those that ask for the same are read once.

    Args:
        config: the configuration.
        tiles: those of materials that are laid out by tiles.

    Raises:
        MesoError: a file is missing or unreadable, has no texture coordinates, or a part has no material.
    """
    kept: dict[str, Body] = {}
    bodies = []
    for item in config.objects:
        key = item.model_dump_json(exclude={"scale", "rotate_deg", "translate", "instances"})
        if key not in kept:
            kept[key] = read_body(item, (tiles or {}).get(str(item.material)))
        bodies.append(kept[key])
    return bodies


def read_body(item: ObjectConfig, tiles: TileSet | None = None) -> Body:
    """Return the mesh of an object, not yet placed, and what its parts look like; `tiles` lie on one in quads.

    Raises:
        MesoError: the file is missing or unreadable, has no texture coordinates, or a part has no material.
    """
    if item.shape is not None:
        assert item.material is not None
        return _in_regions(item, Body(item.build_shape(), None, (item.material,)))
    assert item.mesh is not None
    if item.in_quads:
        return _in_quads(item, tiles)
    found = mesh_file.read(item.mesh, uv_set=item.uv_set)
    looks = _looks(item, found.groups)
    if item.unwrap:
        found = _unwrapped(item, found)
    dressed, part = mesh.dress_parts(found, tiles=item.tiles_pair, name=item.mesh)
    kinds = list(dict.fromkeys(looks))
    part = torch.tensor([kinds.index(look) for look in looks])[part]
    return _in_regions(item, Body(dressed, part if len(kinds) > 1 else None, tuple(kinds)))


def _in_quads(item: ObjectConfig, tiles: TileSet | None) -> Body:
    """Return a body that is laid out in quads, a tile each."""
    assert item.mesh is not None and item.material is not None
    if tiles is None:
        raise ConfigError(
            f"objects: {item.mesh} is laid out in tiles, which this cannot show; render the configuration"
        )
    surface = dress.surface(item.mesh, tiles, item.surface or SurfaceOptions())
    dressed = tiled_surface.dress(tiled_surface.base(surface, item.mesh), surface, tiles)
    return Body(dressed.mesh, None, (item.material,))


def _in_regions(item: ObjectConfig, body: Body) -> Body:
    """Return a body whose faces in the regions of its object look as those say."""
    if not item.regions:
        return body
    looks = list(dict.fromkeys([*body.looks, *(region.material for region in item.regions)]))
    part = torch.zeros(len(body.mesh.faces), dtype=torch.long) if body.part is None else body.part.clone()
    middle = body.mesh.vertices[body.mesh.faces].double().mean(1)
    for region in item.regions:
        low, high = (torch.tensor(x, dtype=torch.float64) for x in (region.low, region.high))
        inside = ((middle >= low) & (middle <= high)).all(1)
        if not bool(inside.any()):
            raise ConfigError(
                f"objects.regions: expected faces between {region.low} and {region.high}, got none; the mesh lies "
                f"between {_short(middle.amin(0))} and {_short(middle.amax(0))}"
            )
        part[inside] = looks.index(region.material)
    return Body(body.mesh, part, tuple(looks))


def _short(point: Tensor) -> str:
    return "(" + ", ".join(f"{x:.3g}" for x in point.tolist()) + ")"


def build_mesh(item: ObjectConfig) -> Mesh:
    """Return the mesh of an object where it stands.

    Raises:
        MesoError: as `read_body`.
    """
    return mesh.transform(read_body(item).mesh, item.places()[0])


def _looks(item: ObjectConfig, groups: tuple[Group, ...]) -> list[str | Finish]:
    """Return what each part of a mesh looks like: as named, else the object's material, else as its file says."""
    names = [group.name for group in groups]
    for name in item.materials:
        if name not in names:
            raise ConfigError(f"objects.materials: {item.mesh} has no part '{name}'{did_you_mean(name, names)}")
    looks: list[str | Finish] = []
    for name, finish in groups:
        look = item.materials.get(name, item.material) or finish
        if look is None:
            raise ConfigError(
                f"objects: {item.mesh}: expected a material for the part '{name}', got none; "
                "name one in 'materials', or one for all parts in 'material'"
            )
        looks.append(look)
    return looks


def _unwrapped(item: ObjectConfig, found: MeshFile) -> MeshFile:
    """Return a mesh with an atlas in place of its texture coordinates, and say how much it cuts."""
    assert item.tile_size is not None
    options = item.unwrap if isinstance(item.unwrap, unwrap.UnwrapOptions) else None
    atlas = unwrap.unwrap(found.vertices, found.faces, tile_size=item.tile_size, options=options)
    warnings.warn(
        f"{item.mesh}: unwrapped into {atlas.charts} charts; texture seams are {atlas.seams}, "
        "the mesostructure does not continue across them",
        stacklevel=2,
    )
    return replace(
        found, vertices=atlas.vertices, faces=atlas.faces, uv=atlas.uv, normals=None, tangents=None, uv_sets=1
    )
