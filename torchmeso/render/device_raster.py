"""All layers of a mesh on OpenCL: its triangles on the screens of cameras, and tiles filled with every fragment.

Tiles of a picture are walked by triangles, 4 x 4 pixels at once; the fragments are those of `rasterize`, which is the
formula of all of this. Frames (`renderer`) and shadow maps fill their tiles in kernels of their own.

Kernels: kernels_cl/render/rasterize.cl          Test: tests/render/test_device_raster.py
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchmeso.backends import opencl
from torchmeso.geometry.camera import Camera
from torchmeso.render.rasterize import GUARD_BAND

TILE, STAMPS, ROOM, VECTORS = 64, 256, 4, 8
"""Side of a tile in pixels, its stamps, layers a stamp begins with, and sixteens of faces that a work-item sets up; in
kernels_cl/render/rasterize.clh."""

TRIANGLE_BYTES, SLOT_BYTES, LABEL_BYTES, LIMIT = 96, 64, 8, 1 << 30
"""Sizes of the kernels' structures, and what no box reaches."""

VIEW = np.dtype(
    [("eye", "f8", 3), ("axes", "f8", (3, 3)), ("pixel_size", "f8"), ("near", "f8"), ("shift", "f8", 2)]
    + [
        (name, "i4")
        for name in ("width", "height", "perspective", "slots", "stamps", "frustum", "cull", "sunk", "before", "pad")
    ]
)
"""A camera as the kernels read it."""

BOX = np.dtype([("centre", "f8", 3), ("reach", "f8", 3), ("body", "i4"), ("pad", "i4", 3)])
"""The box around an object, and whether some of it is closed."""

COUNTERS = (
    "used", "vectors", "slots", "tile", "crossing", "behind", "degenerate", "drawn", "fragments",
    "deepest", "covered", "intervals", "deep", "carved", "inside", "hidden", "looked", "spared", "empty",
    "beside", "turned", "losers", "bounded", "near_bodies", "averted", "kept",
    "stamps", "asked", "prisms", "tets", "endless", "carried",
)  # fmt: skip
"""What the kernels count, in the order of `Counters` in kernels_cl/render/rasterize.clh: 32."""

OF_SET_UP = [
    COUNTERS.index(x)
    for x in ("vectors", "slots", "crossing", "behind", "degenerate", "drawn", "beside", "turned", "near_bodies")
]
"""Those that are known once the triangles stand on the screen."""


class DeviceMesh(NamedTuple):
    """Triangles as the kernels read them.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) int32.
        tags: (F, 2) int32: component << 2 | 2 where it is closed | 1 where it is sunk (see `World`); object, or
            ~object where a face is only there for rays that meet its front.
        objects: (object,) see `BOX`.
        balls: (object, 4) centre and radius of a ball around each object.
        ball: of one around all.
        n_face: F.
    """

    vertices: "opencl.Buffer"
    faces: "opencl.Buffer"
    tags: "opencl.Buffer"
    objects: "opencl.Buffer"
    balls: Float[np.ndarray, "object 4"]
    ball: tuple[float, float, float, float]
    n_face: int


class DeviceLists(NamedTuple):
    """All fragments of a picture, pixel by pixel, near to far; ties in depth are ordered by triangle.

    Attributes:
        pixel: (N,) row * width + column, ascending.
        face: (N,) triangle of the mesh.
        t: (N,) float32 distance along the pixel's ray, near to far in each pixel.
    """

    pixel: Int[Tensor, "N"]
    face: Int[Tensor, "N"]
    t: Float[Tensor, "N"]


def upload_mesh(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], tags: Int[Tensor, "F 2"] | None = None
) -> DeviceMesh:
    """Return a mesh on the device; without `tags` an open surface.

    Raises:
        BackendError: there is no OpenCL device.
    """
    tags = torch.zeros(len(faces), 2, dtype=torch.int32) if tags is None else tags
    number = torch.where(tags[:, 1] < 0, ~tags[:, 1], tags[:, 1])
    n_object = int(number.max()) + 1 if len(tags) else 1
    objects, balls = np.zeros(n_object, BOX), np.zeros((n_object, 4))
    order = torch.argsort(number, stable=True)  # faces object by object: each is looked at once
    for i, own in enumerate(order.split(torch.bincount(number, minlength=n_object).tolist())):
        objects["centre"][i], objects["reach"][i], radius = _around(vertices[faces[own]])
        objects["body"][i] = bool((tags[own, 0] & 2).any())
        balls[i] = *objects["centre"][i], radius
    centre, _, radius = _around(vertices[faces])
    return DeviceMesh(
        opencl.upload(vertices.double().numpy()), opencl.upload(faces.int().numpy()),
        opencl.upload(tags.int().numpy()), opencl.upload(objects), balls, (*centre.tolist(), radius),
        len(faces),
    )  # fmt: skip


def _around(points: Float[Tensor, "*n 3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"], float]:
    """Return the middle of the box around `points`, half its sides, and the farthest distance from there."""
    if len(points) == 0:
        return np.zeros(3), np.zeros(3), 0.0
    p = points.double().reshape(-1, 3).T.contiguous()
    low, high = p.amin(1), p.amax(1)
    centre = (low + high) / 2
    radius = (p - centre[:, None]).square().sum(0).max().sqrt()
    return centre.numpy(), ((high - low) / 2).numpy(), float(radius)


def _uncut(camera: Camera, mesh: DeviceMesh) -> bool:
    """Return whether no face can cross the near plane or the guard band; in doubt one can.

    By one ball and in plain numbers, because it is asked for every frame.
    """
    x, y, z, radius = mesh.ball
    ex, ey, ez = camera.eye.tolist()
    local = [a * (x - ex) + b * (y - ey) + c * (z - ez) for a, b, c in camera.axes.tolist()]
    near = -local[2] - radius
    room = (GUARD_BAND - max(camera.width, camera.height)) * camera.pixel_size
    room *= near if camera.projection == "perspective" else 1.0
    return near > camera.near and max(abs(local[0]), abs(local[1])) + radius < room


class DeviceViews:
    """Cameras on one mesh: its triangles on their screens, on the device."""

    def __init__(self, mesh: DeviceMesh, count: int, *, cut_room: int = 0):
        """Make room for `count` views.

        Args:
            mesh: what is seen.
            count: cameras.
            cut_room: triangles that faces may become which cross the near plane or the guard band.
        """
        self.mesh, self.count, self.may_cut, self._was_cut, self._aimed = mesh, count, True, True, b""
        self.padded = -(-max(mesh.n_face, 1) // 16) * 16
        self.stride = self.padded + -(-max(cut_room, 1024) // 16) * 16
        vectors = -(-(self.stride // 16) // 16) * 16
        self._views = opencl.Shared(np.zeros(count, VIEW))
        self._views.array["slots"] = np.arange(count) * self.stride
        self._counters = opencl.Shared(np.zeros((count, 32), np.int32))
        self.views, self.counters = self._views.buffer, self._counters.buffer
        self.triangles = opencl.allocate(count * self.stride * TRIANGLE_BYTES)
        self.slots = opencl.allocate(count * self.stride * SLOT_BYTES)
        self.labels = opencl.allocate(count * self.stride * LABEL_BYTES)
        self.boxes = opencl.upload(np.full(count * self.stride * 4, LIMIT, np.int32))
        self.coarse = opencl.upload(np.full(count * vectors * 4, LIMIT, np.int32))
        crossing = opencl.allocate(count * self.padded)
        sizes = (np.int32(mesh.n_face), np.int32(self.padded), np.int32(self.stride))
        screen = (
            self.triangles,
            self.slots,
            self.labels,
            self.boxes,
            self.coarse,
            crossing,
            self.counters,
        )
        path = "render/rasterize.cl"
        self.steps = {
            "triangles": opencl.Call(
                path, "set_up", (-(-(self.padded // 16) // VECTORS), count), (1, 1),
                (self.views, mesh.vertices, mesh.faces, mesh.tags, *screen, mesh.objects, *sizes),
            ),
            "cut triangles": opencl.Call(
                path, "cut_faces", (count,), (1,), (self.views, mesh.vertices, mesh.faces, mesh.tags, *screen, *sizes)
            ),
        }  # fmt: skip

    def aim(
        self,
        cameras: Sequence[Camera],
        *,
        taken: int,
        frustum: bool = True,
        cull: bool = False,
        sunk: bool = False,
        before: bool = False,
        rest: bool = False,
    ) -> bool:
        """Set the cameras and put the set-up of all triangles into the queue.

        Args:
            cameras: `count` of them.
            taken: layers that the tiles begin with.
            frustum: whether objects beside a view are left out.
            cull: whether faces of bodies that are turned away are left out, of bodies the eye is outside of.
            sunk: whether faces that lie below others are left out, of bodies the eye is outside of.
            before: whether orthographic views have all bodies ahead of them, as those of distant lights do.
            rest: whether triangles stay where they are when the cameras are those of the last time.

        Returns:
            whether they stayed.
        """
        stamps, self.may_cut = 0, False
        for r, camera in zip(self._views.array, cameras, strict=True):
            r["eye"], r["axes"] = camera.eye.double().numpy(), camera.axes.double().numpy()
            r["pixel_size"], r["near"], r["shift"] = camera.pixel_size, camera.near, camera.shift
            r["width"], r["height"] = camera.width, camera.height
            r["perspective"] = camera.projection == "perspective"
            r["stamps"], r["frustum"], r["cull"], r["sunk"] = stamps, frustum, cull, sunk
            r["before"] = before and camera.projection == "orthographic"
            self.may_cut |= not _uncut(camera, self.mesh)
            stamps += -(-camera.width // 4) * -(-camera.height // 4)
        aimed = self._views.array.tobytes()
        stays, self._aimed = rest and aimed == self._aimed, aimed
        counters = self._counters.array
        kept = counters[:, OF_SET_UP]
        counters[:] = 0
        counters[:, COUNTERS.index("used")] = taken
        counters[:, COUNTERS.index("vectors")] = self.padded // 16
        if stays:
            counters[:, OF_SET_UP] = kept
        self._views.send()
        self._counters.send()
        if stays:
            return True
        self.steps["triangles"]()
        if self.may_cut or self._was_cut:
            self.steps["cut triangles"]()
        self._was_cut = self.may_cut
        return False

    def counts(self) -> list[dict[str, int]]:
        """Wait, and return what each view did."""
        return [dict(zip(COUNTERS, row, strict=False)) for row in self._counters.receive().tolist()]

    def total(self, name: str) -> int:
        """Wait, and return one of `COUNTERS` of all views together."""
        return int(self._counters.receive()[:, COUNTERS.index(name)].sum())

    def room_for_cuts(self) -> int:
        """Return triangles that cut faces may become."""
        return self.stride - self.padded


class DeviceRaster:
    """All layers of a mesh from one camera, again and again; as many as there are."""

    def __init__(self, mesh: DeviceMesh, width: int, height: int):
        """Make room for pictures of width x height pixels."""
        self._mesh, self._size, self._extra, self._cut_room = mesh, (width, height), 4096, 0
        self._make()

    def _make(self) -> None:
        width, height = self._size
        self.views = DeviceViews(self._mesh, 1, cut_room=self._cut_room)
        self._taken = -(-width // TILE) * -(-height // TILE) * STAMPS * ROOM
        self._capacity = self._taken + self._extra
        n_stamp = -(-width // 4) * -(-height // 4)
        self._begin, self._layers = opencl.allocate(4 * n_stamp), opencl.allocate(4 * n_stamp)
        self._key, self._slot = (opencl.allocate(64 * self._capacity) for _ in range(2))
        v = self.views
        self._fill = opencl.Call(
            "render/rasterize.cl", "fill_tiles", (opencl.units(),), (1,),
            (v.views, v.triangles, v.boxes, v.coarse, v.counters, np.int32(v.stride), np.int32(self._capacity),
             self._begin, self._layers, self._key, self._slot),
        )  # fmt: skip

    def draw(self, camera: Camera) -> None:
        """Fill the picture of `camera` and wait for it."""
        while True:
            self.views.aim([camera], taken=self._taken)
            self._fill()
            count = self.views.counts()[0]
            if count["used"] <= self._capacity and count["slots"] <= self.views.room_for_cuts():
                return
            self._extra = max(self._extra, 2 * (count["used"] - self._taken))
            self._cut_room = max(self._cut_room, count["slots"])
            self._make()

    @property
    def buffers(self) -> "tuple[opencl.Buffer, ...]":
        """First layer and number of layers of each stamp; key and slot of the layers; labels of the slots."""
        return self._begin, self._layers, self._key, self._slot, self.views.labels

    def lists(self, camera: Camera) -> DeviceLists:
        """Draw, and return the fragments."""
        self.draw(camera)
        width, height = self._size
        across, down = -(-width // 4), -(-height // 4)
        begin, layers = (opencl.fetch(x, np.zeros(across * down, np.int32)) for x in (self._begin, self._layers))
        key = opencl.fetch(self._key, np.zeros((self._capacity, 16), np.float32))
        slot = opencl.fetch(self._slot, np.zeros((self._capacity, 16), np.int32))
        faces = opencl.fetch(self.views.labels, np.zeros((self.views.stride, 2), np.int32))[:, 0]
        stamp = np.repeat(np.arange(across * down), layers)
        layer = np.arange(len(stamp)) - np.repeat(np.cumsum(layers) - layers, layers)
        key, slot = key[begin[stamp] + layer], slot[begin[stamp] + layer]
        lane = np.arange(16)
        x, y = 4 * (stamp % across)[:, None] + lane % 4, 4 * (stamp // across)[:, None] + lane // 4
        there = np.isfinite(key) & (x < width) & (y < height)
        pixel = (y * width + x)[there]
        order = np.argsort(pixel, kind="stable")
        pixel, face = torch.from_numpy(pixel[order]), torch.from_numpy(faces[slot[there][order]]).long()
        q = torch.from_numpy(key[there][order])
        if camera.projection == "orthographic":
            return DeviceLists(pixel, face, q)
        xy = torch.stack([pixel % width, pixel // width], -1) + 0.5
        return DeviceLists(pixel, face, (-camera.rays(xy.double())[2] / q).float())
