"""From a configuration to something that can be rendered: meshes read and placed, materials ready, lights, camera.

Test: tests/pipeline/test_scene.py
"""

import warnings
from dataclasses import replace

import torch

from torchmeso.config import Config, ObjectConfig
from torchmeso.geometry import mesh, unwrap
from torchmeso.geometry.mesh import Mesh
from torchmeso.pipeline.bake import Asset
from torchmeso.render.scene import Object, Scene


def build(config: Config, assets: dict[str, Asset]) -> Scene:
    """Return the scene of `config` with its prepared materials."""
    return Scene(
        objects=tuple(Object(mesh=build_mesh(o), material=assets[o.material].material) for o in config.objects),
        lights=tuple(light.build() for light in config.lights),
        ambient=config.ambient,
        ambient_rule=config.ambient_rule,
        background=config.background,
    )


def bare(scene: Scene) -> Scene:
    """Return the scene without its MDFs: what a BTF alone can show."""
    return replace(scene, objects=tuple(replace(o, material=replace(o.material, mdf=None)) for o in scene.objects))


def build_mesh(item: ObjectConfig) -> Mesh:
    """Return the mesh of an object where it stands.

    Raises:
        MesoError: the file is missing or unreadable, has no texture coordinates, or an option is out of range.
    """
    if item.shape is not None:
        return mesh.transform(item.build_shape(), item.matrix())
    assert item.mesh is not None
    vertices, faces, uv = mesh.read_arrays(item.mesh)
    if item.unwrap:
        assert item.tile_size is not None
        atlas = unwrap.unwrap(vertices, faces, tile_size=item.tile_size)
        share = atlas.seam_length / max(atlas.edge_length, 1e-30)
        warnings.warn(
            f"{item.mesh}: unwrapped; texture seams are {atlas.seam_length:.3g} world units long "
            f"({share:.0%} of all edges), the mesostructure does not continue across them",
            stacklevel=2,
        )
        vertices, faces, uv = atlas.vertices, atlas.faces, atlas.uv
    if uv is None:
        return mesh.load(item.mesh)  # says what is missing and what to do
    uv = uv * torch.tensor(item.tiles_pair)
    return mesh.transform(mesh.dress(vertices, faces, uv, name=item.mesh), item.matrix())
