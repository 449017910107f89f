"""The peer that wang2004gdm measured itself against: the same volume drawn as a stack of textured slices.

Section 5: "the mesostructure is rendered under local illumination and without shadowing". The mesh is drawn once per
layer of the volume, moved along its normals to the layer's height, and a fragment counts where the layer is solid
(alpha test at one half, bilinear). What is nearest is kept by a depth buffer. Here bottom first, then from the top
down, so that most of what is hidden is never looked up.

Kernels: kernels_cl/bench/slices.cl          Test: tests/bench/test_slices.py
"""

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso.backends import opencl
from torchmeso.data import address
from torchmeso.data.gdm import Gdm
from torchmeso.geometry import frames
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.light import DirectionalLight
from torchmeso.geometry.mesh import Mesh
from torchmeso.render.rasterize import barycentric, rasterize

BAND = 8
"""Rows of the picture that a work-item draws."""

VIEW = np.dtype(
    [("axes", "f4", 9), ("eye", "f4", 3), ("size", "f4"), ("half_width", "f4"), ("half_height", "f4"), ("near", "f4")]
)


class Slices:
    """A mesh with a volume on the device, one slice per layer.

    Attributes:
        depth: (H, W) of the last picture, along the axis of the view; inf where nothing is seen.
        rgb: (H, W, 3) of the last picture, linear.
    """

    def __init__(
        self, mesh: Mesh, gdm: Gdm, camera: Camera, light: DirectionalLight, *, floor: bool = True, ambient: float = 0.1
    ):
        """Upload them; the picture's size is that of `camera`.

        Raises:
            BackendError: there is no device.
        """
        self._slices, rows, columns = gdm.voxels
        self._n_vertex, n_face, self._size = len(mesh.vertices), len(mesh.faces), (camera.height, camera.width)
        self._bands = -(-camera.height // BAND)
        shift = mesh.scale[:, None] * mesh.normals
        frame = frames.orthonormal(mesh.normals, mesh.tangents, mesh.sign)
        faces = opencl.upload(mesh.faces.int().numpy())
        corners = opencl.allocate(16 * self._slices * self._n_vertex)
        self._view = opencl.Shared(np.zeros(1, VIEW))
        self._counts = opencl.Shared(np.zeros((self._bands, self._slices), np.int32))
        self._begins = opencl.Shared(np.zeros((self._bands, self._slices + 1), np.int32))
        self._next = opencl.Shared(np.zeros((self._bands, self._slices), np.int32))
        size, pixels = (np.int32(camera.width), np.int32(camera.height)), camera.width * camera.height
        n_vertex = np.int32(self._n_vertex)
        self._project = opencl.Call(
            "bench/slices.cl", "project", (self._slices * self._n_vertex,), (1,),
            (opencl.upload(mesh.vertices.float().numpy()), opencl.upload(shift.float().numpy()), self._view.buffer,
             n_vertex, np.int32(self._slices), np.float32(gdm.h), corners), self._options,
        )  # fmt: skip
        each = (self._slices * n_face,)
        self._count = opencl.Call(
            "bench/slices.cl", "count_triangles", each, (1,),
            (faces, corners, n_vertex, np.int32(n_face), *size, self._counts.buffer), self._options,
        )  # fmt: skip
        codes = (gdm.occupancy * 255).round().to(torch.uint8).numpy()
        self._depth, self._rgb = opencl.allocate(4 * pixels), opencl.allocate(16 * pixels)
        volume = (
            opencl.upload(codes), opencl.upload(gdm.matter.float().numpy()),
            opencl.upload(torch.stack([frame.t, frame.b, frame.n], 1).float().numpy()),
        )  # fmt: skip
        lighting = np.zeros((3, 4), np.float32)
        lighting[0, :3], lighting[1, :3] = light.direction.numpy(), light.irradiance.numpy()
        lighting[2] = 0.6, 0.6, 0.6, ambient
        self._for_lists = (faces, corners, n_vertex, np.int32(n_face), *size, self._next.buffer), each
        self._for_bands = (
            (faces, corners, opencl.upload(mesh.uv.float().numpy()), self._begins.buffer),
            (*volume, n_vertex, np.int32(self._slices), np.int32(rows), np.int32(columns), *size, np.int32(floor),
             opencl.upload(lighting), self._depth, self._rgb),
        )  # fmt: skip
        self._make_room(1 << 16)

    @property
    def _options(self) -> tuple[str, ...]:
        return (f"-DMOST_ACROSS={-(-self._size[1] // 4)}",)

    def draw(self, camera: Camera) -> None:
        """Draw the picture, and wait for it."""
        view = self._view.array[0]
        view["axes"], view["eye"] = camera.axes.reshape(-1).numpy(), camera.eye.numpy()
        view["size"], view["near"] = camera.pixel_size, camera.near
        view["half_width"], view["half_height"] = camera.width / 2, camera.height / 2
        self._counts.array[...] = 0
        self._view.send()
        self._counts.send()
        self._project()
        self._count()
        flat = self._counts.receive().reshape(-1)
        ends = np.cumsum(flat, dtype=np.int32)
        begins = (ends - flat).reshape(self._bands, self._slices)
        self._begins.array[:, :-1] = self._next.array[...] = begins
        self._begins.array[:, -1] = ends.reshape(self._bands, self._slices)[:, -1]
        self._begins.send()
        self._next.send()
        if ends[-1] > self._lists_room:
            self._make_room(int(ends[-1]))
        self._list()
        self._draw()
        opencl.queue().finish()

    def _make_room(self, count: int) -> None:
        self._lists_room = count + count // 4
        lists = opencl.allocate(4 * self._lists_room)
        arguments, each = self._for_lists
        self._list = opencl.Call("bench/slices.cl", "list_triangles", each, (1,), (*arguments, lists), self._options)
        first, rest = self._for_bands
        self._draw = opencl.Call(
            "bench/slices.cl", "draw_band", (self._bands,), (1,), (*first, lists, *rest), self._options
        )

    @property
    def depth(self) -> Float[Tensor, "H W"]:
        """Depth of the last picture; inf where nothing is seen."""
        over = torch.from_numpy(opencl.fetch(self._depth, np.zeros(self._size, np.float32)))
        return torch.where(over > 0, 1 / over, torch.inf)

    @property
    def rgb(self) -> Float[Tensor, "H W 3"]:
        """Colour of the last picture."""
        return torch.from_numpy(opencl.fetch(self._rgb, np.zeros((*self._size, 4), np.float32)))[..., :3]


def nearest_solid(mesh: Mesh, gdm: Gdm, camera: Camera, *, floor: bool = True) -> Float[Tensor, "H W"]:
    """Return the depth of the nearest solid fragment of all slices: the slow formula, through all layers in float64.

    Args:
        mesh: the top of the volume.
        gdm: whose layers are drawn.
        camera: the view.
        floor: whether the bottom slice is solid throughout.
    """
    layers, n = gdm.voxels[0], len(mesh.vertices)
    z = -gdm.h + gdm.h * torch.arange(layers, dtype=torch.float64) / (layers - 1)
    shift = mesh.scale.double()[:, None] * mesh.normals.double()
    vertices = (mesh.vertices.double() + z[:, None, None] * shift).reshape(-1, 3)
    faces = (mesh.faces + n * torch.arange(layers)[:, None, None]).reshape(-1, 3)
    found = rasterize(camera, vertices, faces)
    which = torch.arange(len(found.t))
    face = found.triangles.face[found.triangle]
    uv = (barycentric(found, camera, which)[..., None] * mesh.uv.double().repeat(layers, 1)[faces[face]]).sum(1)
    solid = _solid(gdm, face // len(mesh.faces), uv)
    if floor:
        solid |= face < len(mesh.faces)
    nearest = torch.full((camera.height * camera.width,), torch.inf, dtype=torch.float64)
    stretch = camera.rays(camera.pixel_centres(torch.float64).reshape(-1, 2))[2]
    nearest.scatter_reduce_(0, found.pixel[solid], found.t[solid], "amin")
    return (nearest / stretch).reshape(camera.height, camera.width)


def _solid(gdm: Gdm, layer: Tensor, uv: Tensor) -> Bool[Tensor, "n"]:
    _, rows, columns = gdm.voxels
    taps = address.bilinear(uv, rows, columns)
    codes = (gdm.occupancy * 255).round().double().reshape(len(gdm.occupancy), -1)
    return (codes[layer[:, None], taps.texel] * taps.weight).sum(-1) > 127.5
