"""All-layer rasteriser: every fragment of every triangle, sorted per pixel, in one go.

Depth peeling without passes: the k-th peel is the k-th fragment of a pixel. Vertices are snapped to 1/256
pixel and edge functions are exact integers (held in float64), so with the top-left rule each shared edge is
drawn once: a closed mesh gives every ray as many front as back faces. Triangles are cut at the near plane, and
at a guard band far outside the picture; a shared edge is cut at the same point from both sides. Any number of
layers, nothing dropped.

The work goes triangle -> rows -> spans -> fragments, each step one repeat_interleave. `device_raster` draws the same
fragments on OpenCL.

Test: tests/render/test_rasterize.py (against a brute-force A-buffer in float64)
"""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchmeso.geometry import clip
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.clip import Polygons

SUBPIXELS = 256
"""Sub-pixel positions per pixel and axis."""

GUARD_BAND = 16384.0
"""Pixels around the origin beyond which triangles are cut; keeps the integers of the edge functions below 2^52."""


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
        t: (N,) distance along the pixel's ray, as precise as the vertices are given.
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
    return _fill(camera, set_up(camera, vertices, faces), vertices.dtype)


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
    return share.to(layers.t.dtype)


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
        return q.to(xy.dtype)
    return (camera.rays(xy.double())[2] / q).to(xy.dtype)


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


def _fill(camera: Camera, tri: Triangles, dtype: torch.dtype) -> Layers:
    """Walk triangles -> rows -> spans -> fragments and sort."""
    spans = _spans(camera, tri)

    # Fragments: every column of every span.
    span = torch.repeat_interleave(spans.length)
    step = torch.arange(len(span)) - spans.first.index_select(0, span)
    pixel = spans.pixel.index_select(0, span) + step
    q = spans.q.index_select(0, span) + spans.slope.index_select(0, span) * step
    t = (_stretch(camera, spans, span, step) / q if camera.projection == "perspective" else q).to(dtype)

    # Pixel first, then depth: positive floats are ordered like their bits. Stable: ties keep the triangles' order.
    if dtype == torch.float32:
        order = torch.sort((pixel << 32) | t.view(torch.int32), stable=True).indices
    else:
        order = torch.argsort(t, stable=True)
        order = order[torch.argsort(pixel[order], stable=True)]
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
    y = (spans.row + (0.5 + camera.shift[1] - camera.height / 2)) * size
    x = (spans.column + (0.5 + camera.shift[0] - camera.width / 2)) * size
    across = x.index_select(0, span) + size * step
    return torch.sqrt((1 + y.square()).index_select(0, span) + across.square())
