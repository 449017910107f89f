"""A-buffer by brute force: every pixel against every triangle, edge functions in exact integers, depth in float64.

Slow twin of torchmeso/render/rasterize.py. It shares the snapped corners (`Triangles`) and nothing else: spans,
sorting, float arithmetic and the fill rule are its own.
"""

from typing import NamedTuple

import numpy as np

from torchmeso.geometry.camera import Camera
from torchmeso.render.rasterize import SUBPIXELS, Triangles


class ABuffer(NamedTuple):
    """Fragments sorted by pixel, depth, triangle; all (N,)."""

    pixel: np.ndarray
    triangle: np.ndarray
    t: np.ndarray  # float64


def a_buffer(camera: Camera, triangles: Triangles) -> ABuffer:
    """Return all fragments of `triangles` on the pixels of `camera`."""
    rows, columns = np.mgrid[0 : camera.height, 0 : camera.width]
    x = (columns.ravel() * SUBPIXELS + SUBPIXELS // 2).astype(np.int64)
    y = (rows.ravel() * SUBPIXELS + SUBPIXELS // 2).astype(np.int64)
    size = camera.pixel_size
    across = (columns.ravel() + 0.5 - camera.width / 2) * size
    down = (rows.ravel() + 0.5 - camera.height / 2) * size
    stretch = np.sqrt(1 + across**2 + down**2) if camera.projection == "perspective" else None
    xy = triangles.xy.numpy().astype(np.int64)
    q = triangles.q.numpy()
    pixels, owners, depths = [], [], []
    for k in range(len(xy)):
        corner = xy[k]
        area = _twice_area(*corner)
        order = [0, 1, 2] if area > 0 else [0, 2, 1]  # clockwise on the screen, where y runs down
        corner, linear, area = corner[order], q[k][order], abs(area)
        covered = np.ones(len(x), dtype=bool)
        weighted = np.zeros(len(x))
        for i in range(3):
            (ax, ay), (bx, by) = corner[i], corner[(i + 1) % 3]
            edge = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
            # Clockwise with y down: a top edge runs level to the right, a left edge runs up.
            top_left = (ay == by and bx > ax) or by < ay
            covered &= (edge > 0) | ((edge == 0) & top_left)
            weighted += edge * (linear[(i + 2) % 3] / area)
        inside = covered.nonzero()[0]
        pixels.append(inside)
        owners.append(np.full(len(inside), k))
        depths.append(stretch[inside] / weighted[inside] if stretch is not None else weighted[inside])
    pixel, owner = (np.concatenate([np.zeros(0, int), *x]) for x in (pixels, owners))
    t = np.concatenate([np.zeros(0), *depths])
    order = np.lexsort((owner, t, pixel))
    return ABuffer(pixel[order], owner[order], t[order])


def _twice_area(a, b, c) -> int:
    return int((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))
