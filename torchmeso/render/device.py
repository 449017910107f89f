"""Geometry and lights as the kernels read them: vertices, faces and lamps in records of one cache line.

Kernels: kernels_cl/render/scene.clh          Test: tests/render/test_device.py
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.backends import opencl
from torchmeso.geometry.directions import normalize
from torchmeso.geometry.light import DirectionalLight, Light, SpotLight
from torchmeso.render.device_raster import DeviceMesh, upload_mesh
from torchmeso.render.scene import World

RECORD = ("n", "t", "uv", "scale", "sign")
"""What a vertex holds, in this order, in sixteen floats."""

FACET = np.dtype(
    [(name, "i4") for name in ("object", "entry")]
    + [(name, "f4") for name in ("turn", "scale")]
    + [("normal", "f4", 3), ("corner", "i4", 3), ("first", "f4", 3), ("second", "f4", 3)]
)
"""A face as kernels read it, in one line of the cache; see `Facet` in kernels_cl/render/scene.clh. What kernels call an
object is a surface here (`Scene.surfaces`): an object in one of its materials."""

LIGHT = np.dtype(
    [("kind", "i4"), ("faces", "i4"), ("first_face", "i4"), ("inner", "f4"), ("outer", "f4")]
    + [(name, "f4", 3) for name in ("place", "axis", "power")]
    + [("pad", "i4", 2)]
)  # fmt: skip


class DeviceGeometry(NamedTuple):
    """The meshes of a scene on the device.

    Attributes:
        mesh: all as one.
        records: (V, 16) float32, see `RECORD`.
        facets: (F,) see `FACET`.
    """

    mesh: DeviceMesh
    records: "opencl.Buffer"
    facets: "opencl.Buffer"


def upload_geometry(world: World) -> DeviceGeometry:
    """Return all meshes of a scene on the device.

    Raises:
        BackendError: there is no device.
    """
    dressed = torch.zeros(len(world.object), dtype=torch.bool)
    dressed[[s.surface for s in world.shells]] = True  # shells are left through faces that nobody asks for
    number = world.object[world.owner]
    number = torch.where(dressed[world.owner], ~number, number)
    tag = (world.component << 2) | (world.closed[world.component].long() << 1) | world.sunk.long()
    return DeviceGeometry(
        upload_mesh(world.vertices, world.faces, torch.stack([tag, number], 1)),
        opencl.upload(vertex_records(world)),
        opencl.upload(face_records(world, torch.stack([tag, world.owner], 1))),
    )


def vertex_records(world: World) -> Float[np.ndarray, "V 16"]:
    """Return what is interpolated over a face, per vertex."""
    records = np.zeros((len(world.vertices), 16), np.float32)
    parts = (world.normals, world.tangents, world.uv, world.scale[:, None], world.sign[:, None])
    records[:, :10] = torch.cat([x.float() for x in parts], 1).numpy()
    return records


def face_records(world: World, tags: Int[Tensor, "F 2"]) -> np.ndarray:
    """Return what is asked of each face, see `FACET`; `tags` are as those of `upload_mesh`, of surfaces."""
    p, n = world.vertices.double()[world.faces], normalize(world.normals.double())[world.faces]
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    normal = normalize(torch.linalg.cross(e1, e2))
    a, b, c = (e1 * e1).sum(-1), (e1 * e2).sum(-1), (e2 * e2).sum(-1)
    area = (a * c - b * b).clamp(min=1e-30)[:, None]
    facets = np.zeros(len(world.faces), FACET)
    facets["object"], facets["entry"] = tags[:, 1].numpy(), world.entry.numpy()
    facets["normal"], facets["corner"] = normal.numpy(), world.faces.numpy()
    facets["first"] = ((c[:, None] * e1 - b[:, None] * e2) / area).numpy()
    facets["second"] = ((a[:, None] * e2 - b[:, None] * e1) / area).numpy()
    facets["turn"] = (n - normal[:, None]).norm(dim=-1).amax(1).numpy() + 1e-5
    facets["scale"] = world.scale[world.faces].amax(1).numpy() * (1 + 1e-6)
    return facets


def light_records(lights: tuple[Light, ...]) -> np.ndarray:
    """Return the lights; those without shadow maps have no faces."""
    records = np.zeros(max(len(lights), 1), LIGHT)
    for r, light in zip(records, lights, strict=False):
        if isinstance(light, DirectionalLight):
            r["kind"], r["place"], r["power"] = 0, light.direction.numpy(), light.irradiance.numpy()
            continue
        r["kind"], r["place"], r["power"] = 1, light.position.numpy(), light.intensity.numpy()
        if isinstance(light, SpotLight):
            r["kind"], r["axis"] = 2, light.axis.numpy()
            r["inner"], r["outer"] = (math.cos(math.radians(x)) for x in (light.inner_deg, light.outer_deg))
    return records
