"""A scene and its side on the device; of the scene before it, what did not change stays there.

Test: tests/render/test_device_scene.py
"""

import operator
from collections.abc import Iterator
from typing import NamedTuple

from torchmeso.backends import opencl
from torchmeso.geometry import shell
from torchmeso.geometry.camera import Camera
from torchmeso.render import device, device_environment, device_gdm, device_shell, device_tables, environment
from torchmeso.render.casters import Corners, corners_of
from torchmeso.render.frame import FrameOptions, Skips
from torchmeso.render.scene import Material, Scene, World, assemble


class SceneOnDevice(NamedTuple):
    """A scene and its side on the device."""

    scene: Scene
    world: World
    geometry: device.DeviceGeometry
    materials: device_tables.DeviceMaterials
    corners: Corners
    object_of: list[int]  # of each surface
    shells: device_shell.DeviceShells | None
    gdms: device_gdm.DeviceGdms | None
    distant: device_environment.DeviceDistant | None

    def starts(self, camera: Camera) -> Iterator[tuple[int, int, list[float]]]:
        """Yield the tetrahedra that the eye is in, their surfaces, and its texture coordinates there."""
        for placed in self.world.shells if camera.projection == "perspective" else ():
            for tet, place in zip(*shell.around(placed.shell, camera.eye), strict=True):
                yield int(tet) + placed.first_tet, placed.surface, place.tolist()

    @property
    def of_shells(self) -> "tuple[opencl.Buffer, ...]":
        """What kernels are given of them."""
        if self.shells is None or self.gdms is None:
            return ()
        return (*self.shells, self.gdms.tables, self.gdms.gdms)

    @property
    def of_distant(self) -> "tuple[opencl.Buffer, ...]":
        """What kernels are given of distant light."""
        return () if self.distant is None else self.distant.arguments

    @property
    def mixed(self) -> bool:
        """Return whether an interval can have different mesostructures at its ends."""
        return any(len({id(m.mdf) for m in o.materials}) > 1 for o in self.scene.objects)

    def since(self, before: "SceneOnDevice | None") -> dict[str, int]:
        """Return what was uploaded that was not there before."""
        meshes = before is None or self.geometry is not before.geometry
        return {"faces uploaded": self.geometry.mesh.n_face * meshes, "tables uploaded": self.materials.packed}


def upload_scene(scene: Scene, options: FrameOptions, before: SceneOnDevice | None = None) -> SceneOnDevice:
    """Return `scene` on the device, with what it shares with the one before.

    Raises:
        BackendError: a material is of a kind that kernels do not read.
    """
    environment.check(scene)
    materials = device_tables.upload_materials(
        scene.surfaces,
        silhouettes=options.silhouette != "none",
        ambient=scene.ambient > 0,
        before=None if before is None else before.materials,
    )
    gdms = device_gdm.upload_gdms(
        [_dressing(m, options.skips) for m in scene.surfaces], None if before is None else before.gdms
    )
    object_of = [i for i, o in enumerate(scene.objects) for _ in o.materials]
    same = before is not None and are(_meshes(scene), _meshes(before.scene)) and object_of == before.object_of
    if before is not None and same:
        distant = device_environment.upload_distant(scene, before.world, before.distant)
        return before._replace(scene=scene, materials=materials, gdms=gdms, distant=distant)
    world = assemble(scene)
    corners = corners_of(world)
    shells = None
    if world.shells:
        shells = device_shell.upload_shells([(s.shell, s.mesh, s.first_vertex) for s in world.shells])
    return SceneOnDevice(
        scene, world, device.upload_geometry(world), materials, corners, object_of, shells, gdms if shells else None,
        device_environment.upload_distant(scene, world, None if before is None else before.distant),
    )  # fmt: skip


def _dressing(material: Material, skips: Skips) -> device_gdm.Dressing | None:
    gdm, form = material.gdm, material.shell
    if gdm is None:
        return None
    bend = device_gdm.BEND * gdm.voxel if skips.carried else 0.0
    return device_gdm.Dressing(gdm, gdm.h, form.queries, form.base == "solid", material.albedo, bend)


def _meshes(scene: Scene) -> list[object]:
    shells: list[object] = [x for m in scene.surfaces for x in (m.gdm, m.shell)]
    return [*shells, *(x for o in scene.objects for x in (o.mesh, o.part))]


def depths(scene: Scene) -> list[object]:
    """Return the MDFs of all surfaces."""
    return [m.mdf for m in scene.surfaces]


def are(a: list[object], b: list[object]) -> bool:
    """Return whether two lists hold the same objects."""
    return len(a) == len(b) and all(map(operator.is_, a, b))
