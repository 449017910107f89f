"""All-layer rasteriser: every fragment of every triangle, sorted per pixel, in one go.

Depth peeling without passes: the k-th peel is the k-th fragment of a pixel. Vertices are snapped to 1/256
pixel and edge functions are exact integers (held in float64), so with the top-left rule each shared edge is
drawn once: a closed mesh gives every ray as many front as back faces. Triangles are cut at the near plane, and
at a guard band far outside the picture; a shared edge is cut at the same point from both sides. Any number of
layers, nothing dropped.

In torch the work goes triangle -> rows -> spans -> fragments, each step one repeat_interleave. On OpenCL
(`DeviceViews`) tiles of the picture are walked by triangles, 4 x 4 pixels at once; both draw the same fragments.

Kernels: kernels_cl/render/rasterize.cl
Test: tests/render/test_rasterize.py (against a brute-force A-buffer in float64)
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.backends import opencl
from torchmeso.geometry import clip
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.clip import Polygons

SUBPIXELS = 256
"""Sub-pixel positions per pixel and axis."""

GUARD_BAND = 16384.0
"""Pixels around the origin beyond which triangles are cut; keeps the integers of the edge functions below 2^52."""


TILE, STAMPS, ROOM, VECTORS = 64, 256, 4, 8
"""Side of a tile in pixels, its stamps, the layers a stamp begins with, and how many times sixteen faces a work-item sets
up, in kernels_cl/render/rasterize.clh."""

TRIANGLE_BYTES, SLOT_BYTES, LABEL_BYTES, LIMIT = 96, 48, 16, 1 << 30
"""Sizes of the kernels' structures, and what no box reaches."""

VIEW = np.dtype(
    [("eye", "f8", 3), ("axes", "f8", (3, 3)), ("pixel_size", "f8"), ("near", "f8")]
    + [(name, "i4") for name in ("width", "height", "perspective", "slots", "texels", "cull", "outside", "pad")]
)
"""A camera as the kernels read it."""

COUNTERS = (
    "used", "vectors", "slots", "tile", "crossing", "behind", "degenerate", "drawn", "fragments",
    "deepest", "covered", "intervals", "deep", "carved", "inside", "hidden", "looked", "spared", "empty_tiles",
    "beside", "turned", "losers", "bounded",
)  # fmt: skip
"""What the kernels count, in the order of `Counters` in kernels_cl/render/rasterize.clh; padded to 32."""


class Triangles(NamedTuple):
    """Triangles on the screen, after clipping.

    Attributes:
        xy: (T, 3, 2) float64 corners in sub-pixels, whole numbers.
        q: (T, 3) float64 what is linear on the screen: 1/w in perspective, depth in a parallel view.
        face: (T,) triangle of the mesh.
        corner: (T, 3, 3) float64 corners in barycentric coordinates of that triangle, or None: none was cut.
        front: (T,) whether the triangle faces the camera, by its corners on the screen.
        area: (T,) float64 twice the area in square sub-pixels, > 0.
    """

    xy: Float[Tensor, "T 3 2"]
    q: Float[Tensor, "T 3"]
    face: Int[Tensor, "T"]
    corner: Float[Tensor, "T 3 3"] | None
    front: Bool[Tensor, "T"]
    area: Float[Tensor, "T"]


class Layers(NamedTuple):
    """All fragments of a picture, pixel by pixel, near to far; ties in depth are ordered by triangle.

    Attributes:
        start: (height * width + 1,) first fragment of each pixel.
        pixel: (N,) row * width + column.
        triangle: (N,) row of `triangles`.
        t: (N,) float32 distance along the pixel's ray.
        triangles: the triangles that were drawn.
    """

    start: Int[Tensor, "pixels_and_one"]
    pixel: Int[Tensor, "N"]
    triangle: Int[Tensor, "N"]
    t: Float[Tensor, "N"]
    triangles: Triangles


def rasterize(camera: Camera, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Layers:
    """Return all layers of a mesh seen by `camera`.

    Args:
        camera: the view; nothing nearer than its near plane is drawn.
        vertices: (V, 3) world.
        faces: (F, 3).
    """
    return _fill(camera, set_up(camera, vertices, faces))


def barycentric(layers: Layers, camera: Camera, which: Int[Tensor, "n"]) -> Float[Tensor, "n 3"]:
    """Return perspective-correct barycentric coordinates, in the mesh's triangles, of fragments `which`."""
    tri = layers.triangles
    k = layers.triangle[which]
    pixel = layers.pixel[which]
    centre = torch.stack([pixel % camera.width, pixel // camera.width], -1).double() * SUBPIXELS + SUBPIXELS / 2
    to_corner = tri.xy[k] - centre[:, None]
    b, c = to_corner.roll(-1, 1), to_corner.roll(-2, 1)
    share = (b[..., 0] * c[..., 1] - b[..., 1] * c[..., 0]).abs()  # twice the area opposite each corner
    if camera.projection == "perspective":
        share = share * tri.q[k]
    share = share / share.sum(-1, keepdim=True).clamp(min=1e-300)
    if tri.corner is not None:
        share = (share.unsqueeze(-1) * tri.corner[k]).sum(1)
    return share.float()


def depth_at(
    triangles: Triangles, camera: Camera, which: Int[Tensor, "n"], xy: Float[Tensor, "n 2"]
) -> Float[Tensor, "n"]:
    """Return the depth t at which the rays through pixels `xy` meet the planes of triangles `which`.

    Outside a triangle its plane is followed only as far as its own depth range: no needle can extrapolate.
    """
    corner = triangles.xy[which] / SUBPIXELS
    to_corner = corner - xy.double()[:, None]
    b, c = to_corner.roll(-1, 1), to_corner.roll(-2, 1)
    share = b[..., 0] * c[..., 1] - b[..., 1] * c[..., 0]
    turn = torch.where(triangles.front[which], -1.0, 1.0).to(torch.float64)
    q_corner = triangles.q[which]
    q = (share * q_corner).sum(1) * turn * (SUBPIXELS**2 / triangles.area[which])
    q = q.clamp(min=q_corner.amin(1), max=q_corner.amax(1))
    if camera.projection == "orthographic":
        return q.float()
    return (camera.rays(xy.double())[2] / q).float()


def set_up(camera: Camera, vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Triangles:
    """Return the triangles of a mesh on the screen: projected, clipped, snapped, without those of no area."""
    projected = camera.project(vertices.double())
    w, depth = projected[:, 2], projected[:, 3]
    pixels = projected[:, :2] / w[:, None]
    linear = 1 / w if camera.projection == "perspective" else depth
    ahead = depth >= camera.near
    safe = ahead & (pixels.abs() <= GUARD_BAND).all(-1)
    whole = safe[faces].all(1)
    face = whole.nonzero()[:, 0]
    xy, q, corner = pixels[faces[face]], linear[faces[face]], None
    crossing = (ahead[faces].any(1) & ~whole).nonzero()[:, 0]
    if len(crossing):
        cut_xy, cut_q, cut_corner, source = _clip(camera, projected[faces[crossing]])
        face = torch.cat([face, crossing[source]])
        face, order = torch.sort(face, stable=True)
        xy, q = torch.cat([xy, cut_xy])[order], torch.cat([q, cut_q])[order]
        identity = torch.eye(3, dtype=torch.float64).expand(len(order) - len(cut_q), 3, 3)
        corner = torch.cat([identity, cut_corner])[order]
    xy = (xy * SUBPIXELS).round()
    area = _area(xy)
    front = area < 0  # counter-clockwise seen from outside turns clockwise where rows run down
    keep = (area != 0).nonzero()[:, 0]
    if len(keep) < len(area):
        xy, q, face, front, area = xy[keep], q[keep], face[keep], front[keep], area[keep]
        corner = None if corner is None else corner[keep]
    return Triangles(xy, q, face, corner, front, area.abs())


def _clip(camera: Camera, corners: Float[Tensor, "n 3 4"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Cut triangles in (x w, y w, w, depth) at the near plane and the guard band.

    Returns:
        corners in pixels (m, 3, 2), q (m, 3), barycentric coordinates in the whole triangle (m, 3, 3), source (m,).
    """
    weights = torch.eye(3, dtype=torch.float64).expand(len(corners), 3, 3)
    polygons = Polygons(torch.cat([corners, weights], -1), torch.full((len(corners),), 3))
    band = GUARD_BAND
    for x, y, w, depth, constant in (
        (0.0, 0.0, 0.0, 1.0, -camera.near),
        (1.0, 0.0, band, 0.0, 0.0),
        (-1.0, 0.0, band, 0.0, 0.0),
        (0.0, 1.0, band, 0.0, 0.0),
        (0.0, -1.0, band, 0.0, 0.0),
    ):
        plane = torch.tensor([x, y, w, depth], dtype=torch.float64)
        polygons = clip.cut(polygons, polygons.points[..., :4] @ plane + constant)
    triangles, source = clip.fan(polygons)
    w = triangles[..., 2]
    q = 1 / w if camera.projection == "perspective" else triangles[..., 3]
    return triangles[..., :2] / w[..., None], q, triangles[..., 4:], source


def _area(xy: Tensor) -> Tensor:
    a, b, c = xy.unbind(1)
    return (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])


def _fill(camera: Camera, tri: Triangles) -> Layers:
    """Walk triangles -> rows -> spans -> fragments and sort."""
    spans = _spans(camera, tri)

    # Fragments: every column of every span.
    span = torch.repeat_interleave(spans.length)
    step = torch.arange(len(span)) - spans.first.index_select(0, span)
    pixel = spans.pixel.index_select(0, span) + step
    q = spans.q.index_select(0, span) + spans.slope.index_select(0, span) * step
    t = (_stretch(camera, spans, span, step) / q if camera.projection == "perspective" else q).float()

    # Pixel first, then depth: positive floats are ordered like their bits. Stable: ties keep the triangles' order.
    order = torch.sort((pixel << 32) | t.view(torch.int32), stable=True).indices
    pixel = pixel.index_select(0, order)
    n_pixel = camera.height * camera.width
    start = torch.zeros(n_pixel + 1, dtype=torch.long)
    torch.cumsum(torch.bincount(pixel, minlength=n_pixel), 0, out=start[1:])
    triangle = spans.triangle.index_select(0, span.index_select(0, order))
    return Layers(start, pixel, triangle, t.index_select(0, order), tri)


class _Spans(NamedTuple):
    """Runs of covered pixels, one per triangle and row, all (R,)."""

    triangle: Tensor
    row: Tensor
    column: Tensor  # first pixel
    pixel: Tensor  # row * width + column
    length: Tensor  # 0 where nothing is covered
    first: Tensor  # first fragment
    q: Tensor  # at the first pixel
    slope: Tensor  # of q per pixel


def _spans(camera: Camera, tri: Triangles) -> _Spans:
    height, width = camera.height, camera.width
    half = SUBPIXELS // 2

    # Rows whose pixel centres lie between the triangle's top and bottom.
    x, y = tri.xy.unbind(-1)
    first_row = ((y.amin(1) - half) / SUBPIXELS).ceil().clamp(min=0)
    last_row = ((y.amax(1) - half) / SUBPIXELS).floor().clamp(max=height - 1)
    beside = (x.amax(1) < half) | (x.amin(1) > width * SUBPIXELS - half)
    n_row = (last_row - first_row + 1).clamp(min=0).masked_fill(beside, 0).long()
    owner = torch.repeat_interleave(n_row)
    row = torch.arange(len(owner)) - (n_row.cumsum(0) - n_row - first_row.long()).index_select(0, owner)

    # The columns between the rising and the falling edges. Edge k lies opposite corner k: inside where
    # n + a column >= 0. One float64 division is exact: numerators stay below 2^52, so a quotient that is no whole
    # number cannot round to one.
    low = torch.zeros(len(owner), dtype=torch.float64)
    high = torch.full_like(low, width - 1)
    at_0 = per_column = per_row = torch.zeros(len(x), dtype=torch.float64)
    turn = torch.where(tri.front, -1.0, 1.0).to(torch.float64)
    for k in range(3):
        b, c = (k + 1) % 3, (k + 2) % 3
        A, B = (y[:, b] - y[:, c]) * turn, (x[:, c] - x[:, b]) * turn
        C = -(A * x[:, b] + B * y[:, b])
        top_left = (A > 0) | ((A == 0) & (B > 0))
        centre = C + half * (A + B)
        a = (A * SUBPIXELS).index_select(0, owner)
        n = (centre - (~top_left).double()).index_select(0, owner)
        n += (B * SUBPIXELS).index_select(0, owner) * row
        bound = -n / a
        low = torch.where(a > 0, torch.maximum(low, bound.ceil()), low)
        high = torch.where(a < 0, torch.minimum(high, bound.floor()), high)
        high = torch.where((a == 0) & (n < 0), -1, high)  # a level edge, and the row lies outside
        share = tri.q[:, k] / tri.area
        at_0, per_column, per_row = at_0 + centre * share, per_column + A * share, per_row + B * share

    # q at both ends of each span, kept inside the corners' range: no needle can extrapolate.
    length = (high - low + 1).clamp(min=0)
    slope = (per_column * SUBPIXELS).index_select(0, owner)
    q_left = at_0.index_select(0, owner) + (per_row * SUBPIXELS).index_select(0, owner) * row + slope * low
    q_right = q_left + slope * (length - 1)
    q_min, q_max = tri.q.amin(1).index_select(0, owner), tri.q.amax(1).index_select(0, owner)
    q_left, q_right = q_left.clamp(min=q_min, max=q_max), q_right.clamp(min=q_min, max=q_max)
    slope = (q_right - q_left) / (length - 1).clamp(min=1)
    column, length = low.long(), length.long()
    return _Spans(owner, row, column, row * width + column, length, length.cumsum(0) - length, q_left, slope)


def _stretch(camera: Camera, spans: _Spans, span: Tensor, step: Tensor) -> Tensor:
    """Return the length of each fragment's ray per unit of view depth; `camera.rays` gives the same."""
    size = camera.pixel_size
    y = (spans.row + (0.5 - camera.height / 2)) * size
    x = (spans.column + (0.5 - camera.width / 2)) * size
    across = x.index_select(0, span) + size * step
    return torch.sqrt((1 + y.square()).index_select(0, span) + across.square())


class DeviceMesh(NamedTuple):
    """Triangles as the kernels read them.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) int32.
        tags: (F, 2) int32: component << 2 | 2 where it is closed; object.
        boxes: (object, 8, 3) float64 corners of the box around each object.
        bodies: (object,) whether an object has closed components.
        n_vertex: V.
        n_face: F.
    """

    vertices: "opencl.Buffer"
    faces: "opencl.Buffer"
    tags: "opencl.Buffer"
    boxes: Float[np.ndarray, "object 8 3"]
    bodies: Bool[np.ndarray, "object"]
    n_vertex: int
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
    boxes, bodies = [], []
    for i in range(int(tags[:, 1].max()) + 1 if len(tags) else 1):
        p = vertices[faces[tags[:, 1] == i].unique()].double()
        bodies.append(bool((tags[tags[:, 1] == i, 0] & 2).any()))
        box = torch.stack([p.amin(0), p.amax(0)]) if len(p) else torch.zeros(2, 3, dtype=torch.float64)
        boxes.append(torch.stack(torch.meshgrid(*box.unbind(1), indexing="ij"), -1).reshape(8, 3).numpy())
    return DeviceMesh(
        opencl.upload(vertices.double().numpy()), opencl.upload(faces.int().numpy()),
        opencl.upload(tags.int().numpy()), np.stack(boxes), np.array(bodies), len(vertices), len(faces),
    )  # fmt: skip


def _overlap(camera: Camera, boxes: Float[np.ndarray, "object 8 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return whether each box lies beside the view, ahead of the eye, and also within the guard band.

    In numpy, for its speed on a few numbers.
    """
    local = (boxes - camera.eye.double().numpy()) @ camera.axes.double().numpy().T
    depth = -local[..., 2]
    ahead = depth > camera.near
    # In pixels from the middle of the picture; each bound of the view leaves a pixel of room.
    across = local[..., :2] / camera.pixel_size
    w = depth[..., None] if camera.projection == "perspective" else 1.0
    room = np.array([camera.width / 2 + 1, camera.height / 2 + 1]) * w
    beside = ((across < -room).all(1) | (across > room).all(1)).any(-1) | ~ahead.any(1)
    safe = (np.abs(across) < (GUARD_BAND - max(camera.width, camera.height)) * w).all(-1)
    return beside, ahead.all(1), (ahead & safe).all(1)


class DeviceViews:
    """Cameras on one mesh: its triangles on their screens, on the device."""

    def __init__(self, mesh: DeviceMesh, count: int, *, cut_room: int = 0):
        """Make room for `count` views.

        Args:
            mesh: what is seen.
            count: cameras.
            cut_room: triangles that faces may become which cross the near plane or the guard band.
        """
        self.mesh, self.count, self.may_cut, self._was_cut = mesh, count, True, True
        self.padded = -(-max(mesh.n_face, 1) // 16) * 16
        self.stride = self.padded + -(-max(cut_room, 1024) // 16) * 16
        vectors = -(-(self.stride // 16) // 16) * 16
        self._views = opencl.Shared(np.zeros(count, VIEW))
        self._counters = opencl.Shared(np.zeros((count, 32), np.int32))
        self._beside = opencl.Shared(np.zeros((count, len(mesh.boxes)), np.int32))
        self.views, self.counters = self._views.buffer, self._counters.buffer
        self.triangles = opencl.allocate(count * self.stride * TRIANGLE_BYTES)
        self.slots = opencl.allocate(count * self.stride * SLOT_BYTES)
        self.labels = opencl.allocate(count * self.stride * LABEL_BYTES)
        self.boxes = opencl.upload(np.full(count * self.stride * 4, LIMIT, np.int32))
        self.coarse = opencl.upload(np.full(count * vectors * 4, LIMIT, np.int32))
        crossing = opencl.allocate(count * self.padded)
        sizes = (np.int32(mesh.n_face), np.int32(self.padded), np.int32(self.stride), np.int32(len(mesh.boxes)))
        screen = (
            self.triangles,
            self.slots,
            self.labels,
            self.boxes,
            self.coarse,
            crossing,
            self.counters,
            self._beside.buffer,
        )
        path = "render/rasterize.cl"
        self.steps = {
            "triangles": opencl.Call(
                path, "set_up", (-(-(self.padded // 16) // VECTORS), count), (1, 1),
                (self.views, mesh.vertices, mesh.faces, mesh.tags, *screen, *sizes),
            ),
            "cut triangles": opencl.Call(
                path, "cut_faces", (count,), (1,), (self.views, mesh.vertices, mesh.faces, mesh.tags, *screen, *sizes)
            ),
        }  # fmt: skip

    def aim(self, cameras: Sequence[Camera], *, taken: int, frustum: bool = True, cull: bool = False) -> None:
        """Set the cameras and put the set-up of all triangles into the queue.

        Args:
            cameras: `count` of them.
            taken: layers that the tiles begin with.
            frustum: whether objects beside a view are left out.
            cull: whether faces of bodies that are turned away are left out, as long as the eye is outside.
        """
        texels, self.may_cut = 0, False
        for i, (r, camera) in enumerate(zip(self._views.array, cameras, strict=True)):
            r["eye"], r["axes"] = camera.eye.double().numpy(), camera.axes.double().numpy()
            r["pixel_size"], r["near"] = camera.pixel_size, camera.near
            r["width"], r["height"] = camera.width, camera.height
            r["perspective"] = camera.projection == "perspective"
            r["slots"] = i * self.stride
            beside, ahead, whole = _overlap(camera, self.mesh.boxes)
            outside = bool((ahead | beside | ~self.mesh.bodies).all())
            r["texels"], r["cull"], r["outside"] = texels, cull and outside, outside
            # What lies beside is behind the eye as a whole, or needs no cutting: only what is seen can cross.
            self._beside.array[i] = beside & frustum
            self.may_cut |= not (whole | (beside & frustum)).all()
            texels += camera.width * camera.height
        counters = self._counters.array
        counters[:] = 0
        counters[:, COUNTERS.index("used")] = taken
        counters[:, COUNTERS.index("vectors")] = self.padded // 16
        for shared in (self._views, self._counters, self._beside):
            shared.send()
        self.steps["triangles"]()
        if self.may_cut or self._was_cut:
            self.steps["cut triangles"]()
        self._was_cut = self.may_cut

    def counts(self) -> list[dict[str, int]]:
        """Wait, and return what each view did."""
        return [dict(zip(COUNTERS, row, strict=False)) for row in self._counters.receive().tolist()]

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

    def lists(self, camera: Camera) -> DeviceLists:
        """Draw, and return the fragments."""
        self.draw(camera)
        width, height = self._size
        across, down = -(-width // 4), -(-height // 4)
        begin, layers = (opencl.fetch(x, np.zeros(across * down, np.int32)) for x in (self._begin, self._layers))
        key = opencl.fetch(self._key, np.zeros((self._capacity, 16), np.float32))
        slot = opencl.fetch(self._slot, np.zeros((self._capacity, 16), np.int32))
        faces = opencl.fetch(self.views.labels, np.zeros((self.views.stride, LABEL_BYTES // 4), np.int32))[:, 2]
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
