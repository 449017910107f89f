"""Frames with a view-dependent displacement map (`bench.vdm`), as wang2003vdm draws them: a look-up per pixel.

The bare mesh is drawn, all layers of it. From the front layers of a pixel, near to far, the first counts whose look-up
meets material; where it leaves, what lies behind is seen. The material is that of the voxel there, lit by one distant
light without shadows, in the frame of the pixel.

Kernels: kernels_cl/bench/vdm_frame.cl          Test: tests/bench/test_vdm_frame.py
"""

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso.backends import opencl
from torchmeso.bench import vdm
from torchmeso.bench.vdm import Vdm
from torchmeso.data.gdm import Gdm
from torchmeso.geometry import frames
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.directions import normalize
from torchmeso.geometry.light import DirectionalLight
from torchmeso.geometry.mesh import Mesh
from torchmeso.render import device_tables
from torchmeso.render.device_raster import DeviceRaster, upload_mesh
from torchmeso.render.rasterize import barycentric, rasterize

LEFT = 65535
"""The code of a sample that leaves."""


class Seen(NamedTuple):
    """What is seen.

    Attributes:
        t: (H, W) way along each pixel's ray; inf where nothing is met.
        place: (H, W, 3) texture coordinates there.
    """

    t: Float[Tensor, "H W"]
    place: Float[Tensor, "H W 3"]


def per_vertex(mesh: Mesh) -> Float[Tensor, "V 18"]:
    """Return position, u v, t, b, n, scale and curvature of each vertex: what is interpolated."""
    frame = frames.orthonormal(mesh.normals.double(), mesh.tangents.double(), mesh.sign.double())
    parts = [mesh.vertices, mesh.uv, *frame, mesh.scale[:, None], vdm.curvature(mesh)]
    return torch.cat([x.double() for x in parts], 1)


def look(mesh: Mesh, table: Vdm, camera: Camera) -> Seen:
    """Return what a frame shows: the formula, in float64."""
    layers = rasterize(camera, mesh.vertices.double(), mesh.faces)
    front = layers.triangles.front[layers.triangle].nonzero()[:, 0]
    pixel = layers.pixel[front]
    corner = per_vertex(mesh)[mesh.faces[layers.triangles.face[layers.triangle[front]]]]
    at = (barycentric(layers, camera, front).double()[..., None] * corner).sum(1)
    _, direction, _ = camera.rays(camera.pixel_centres(torch.float64).reshape(-1, 2))
    wo = normalize(-(at[:, 5:14].unflatten(1, (3, 3)) * direction[pixel][:, None]).sum(-1))
    found = table.evaluate(at[:, 3:5], wo, vdm.along(at[:, 15:], wo))
    met = found.way.isfinite().nonzero()[:, 0]
    n = camera.width * camera.height
    first = torch.full((n,), len(pixel)).scatter_reduce_(0, pixel[met], met, "amin")  # fragments stand near to far
    seen = first < len(pixel)
    t, place = torch.full((n,), torch.inf, dtype=torch.float64), torch.zeros(n, 3, dtype=torch.float64)
    which = first[seen]
    t[seen], place[seen] = layers.t[front[which]].double() + at[which, 14] * found.way[which], found.place[which]
    return Seen(t.reshape(camera.height, camera.width), place.reshape(camera.height, camera.width, 3))


class VdmFrames:
    """A mesh with a VDM on the device.

    Attributes:
        seen: of the last picture.
        rgb: (H, W, 3) of the last picture, linear.
    """

    def __init__(self, mesh: Mesh, table: Vdm, gdm: Gdm, camera: Camera, light: DirectionalLight, ambient: float = 0.1):
        """Upload them; the material is that of `gdm`, the picture's size that of `camera`.

        Raises:
            BackendError: there is no device.
        """
        self._size, self._pixels = (camera.height, camera.width), camera.height * camera.width
        self._raster = DeviceRaster(upload_mesh(mesh.vertices, mesh.faces), camera.width, camera.height)
        ways, left = table.nodes
        cap = float(ways.max().clamp(min=1e-6))
        codes = torch.where(left > 0.5, LEFT, (ways * ((LEFT - 1) / cap)).round()).numpy().astype(np.uint16)
        pairs = codes.astype(np.uint32) | np.roll(codes, -1, 0).astype(np.uint32) << 16
        rings = device_tables.ring_records(table.views)
        lighting = np.zeros((3, 4), np.float32)
        lighting[0, :3], lighting[1, :3], lighting[2, 3] = light.direction.numpy(), light.irradiance.numpy(), ambient
        lighting[2, :3] = 0.6
        self._out = opencl.allocate(32 * self._pixels)
        self._view = opencl.Shared(np.zeros(12, np.float32))
        self._arguments = (
            opencl.upload(mesh.faces.int().numpy()), opencl.upload(per_vertex(mesh).float().numpy()),
            opencl.upload(pairs), opencl.upload(rings),
            opencl.upload(gdm.matter.float().numpy()), self._view.buffer, opencl.upload(lighting),
            np.float32(cap / (LEFT - 1)), np.float32(table.most), np.float32(table.h), np.int32(ways.shape[0]),
            np.int32(ways.shape[1]), np.int32(len(rings)), np.int32(ways.shape[2]), np.int32(ways.shape[3]),
            *(np.int32(n) for n in gdm.voxels), np.int32(camera.width), np.int32(camera.height), self._out,
        )  # fmt: skip
        self._lists: tuple[opencl.Buffer, ...] = ()

    def draw(self, camera: Camera) -> None:
        """Draw the picture, and wait for it; cameras are perspective, meshes before the near plane."""
        view = self._view.array
        view[:9], view[9:] = camera.axes.reshape(-1).numpy() * camera.pixel_size, camera.eye.numpy()
        view[6:9] /= camera.pixel_size
        self._view.send()
        self._raster.draw(camera)
        lists = self._raster.buffers
        if lists != self._lists:
            self._lists = lists
            stamps = -(-self._size[0] // 4) * -(-self._size[1] // 4)
            self._shade = opencl.Call("bench/vdm_frame.cl", "shade", (stamps,), (1,), (*lists, *self._arguments))
        self._shade()
        opencl.queue().finish()

    @property
    def seen(self) -> Seen:
        """What is seen, float32."""
        out = self._fetched()
        return Seen(torch.where(out[..., 0] > 0, out[..., 0], torch.inf), out[..., 1:4])

    @property
    def rgb(self) -> Float[Tensor, "H W 3"]:
        """Colour of the last picture."""
        return self._fetched()[..., 4:7]

    def _fetched(self) -> Tensor:
        return torch.from_numpy(opencl.fetch(self._out, np.zeros((*self._size, 8), np.float32)))
