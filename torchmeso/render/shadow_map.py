"""Shadow maps that know the mesostructure, for directional, spot and point lights.

wang2005mdf, section 4.2. The map is a picture of the scene from the light, silhouettes included. Because the BTF
already holds the shadows of its own mesostructure, a blocker must not shadow the slab it lies in:

    closed surfaces:  shadow starts at t_b, where the ray leaves the body again
    open surfaces:    t_f + s_f h / cos(theta_l), the base of the slab (from behind, and plain ones: t_f)
    GDMs:             where the ray meets the material; a receiver in a shell lets pass what is nearer than s h

Whatever lies outside a body and behind it is behind t_b, and what lies inside (a receiver in a joint) is not: so
closed surfaces need no bias against self-shadowing at all, however steep or coarse. The base of the slab, which the
paper takes for them too, cuts off joints where the slab is thick against the curvature. A texel keeps its triangle:
depth is taken where the receiver's own light ray meets that plane, not at the texel's centre.

A map of the sun covers what can be shadowed (`casters`).

Test: tests/render/test_shadow_map.py
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso.data.mdf import MIN_COS
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.directions import dot, normalize
from torchmeso.geometry.light import DirectionalLight, Light, SpotLight
from torchmeso.render.casters import Corners, corners_of, extents
from torchmeso.render.rasterize import Triangles, depth_at, rasterize
from torchmeso.render.scene import Scene, World, interpolate, rays
from torchmeso.render.silhouette import Silhouette, find_candidates, nearest


class ShadowMap(NamedTuple):
    """What one light sees, in one to six square pictures.

    Attributes:
        faces: the pictures; six for a point light.
    """

    faces: "tuple[ShadowFace, ...]"


class ShadowFace(NamedTuple):
    """One picture from a light.

    Attributes:
        camera: the view.
        triangle: (pixels,) row of `triangles` on which the nearest shadow starts, -1 = none.
        behind: (pixels,) distance from that triangle's plane to where the shadow starts.
        front: (pixels,) where the light first enters a closed body that stops it; inf = none does.
        triangles: what was drawn.
    """

    camera: Camera
    triangle: Tensor
    behind: Tensor
    front: Tensor
    triangles: Triangles


class Above(NamedTuple):
    """The surface that positions are seen through.

    Attributes:
        position: (n, 3) on it.
        lean: (n,) cosine between its normal and the light.
    """

    position: Float[Tensor, "n 3"]
    lean: Float[Tensor, "n"]


SLOPE_BIAS, STEEPEST = 2.0, 0.03
"""Bias in texels per texel of depth that a surface falls by across one; cosines are taken no smaller than this."""

FINEST = 64
"""A map is fitted to no less than this part of the scene: a texel stays well above what float32 resolves of it."""


def build(scene: Scene, world: World, light: Light, *, size: int, silhouette: Silhouette) -> ShadowMap:
    """Return the shadow map of `light`: size x size texels (half of that for each face of a point light)."""
    return ShadowMap(
        tuple(_draw(scene, world, camera, silhouette) for camera in cameras(corners_of(world), light, size))
    )


def blocked(
    shadow: ShadowMap,
    position: Float[Tensor, "n 3"],
    slack: Float[Tensor, "n"] | None = None,
    *,
    above: Above | None = None,
) -> Bool[Tensor, "n"]:
    """Return whether the light is blocked at world positions; positions outside the map are lit.

    A blocker nearer to a position than its `slack` does not count: in a shell, the GDM itself says what shadows near
    material casts.

    Where light enters a body, its front is known: a position deeper in it than twice its way from the surface `above`
    did not get there from that surface's outside. In a crease it has come to lie where there is no gap any more, and
    the surface decides. And a surface deeper in a body than its slope explains lies in a gap smaller than a texel, in
    the dark.
    """
    result = torch.zeros(len(position), dtype=torch.bool)
    deep = torch.zeros_like(result)
    way = torch.zeros(len(position)) if above is None else (position - above.position).norm(dim=-1)
    lean = torch.zeros(len(position)) if above is None else above.lean  # light does not enter at cosine 0
    enters, slope = lean > 0, _slope(lean)
    for face in shadow.faces:
        camera = face.camera
        x_w, y_w, w, depth = camera.project(position).unbind(-1)
        ahead = depth > camera.near
        xy = torch.stack([x_w, y_w], -1) / torch.where(ahead, w, 1).unsqueeze(-1)
        column, row = xy.floor().long().unbind(-1)
        inside = ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        inside = inside.nonzero()[:, 0]
        triangle = face.triangle[row[inside] * camera.width + column[inside]]
        seen, triangle = inside[triangle >= 0], triangle[triangle >= 0]
        perspective = camera.projection == "perspective"
        t = (position[seen] - camera.eye.to(position.dtype)).norm(dim=-1) if perspective else depth[seen]
        start = depth_at(face.triangles, camera, triangle, xy[seen])
        texel = row[seen] * camera.width + column[seen]
        if bool(enters.any()):
            texels = torch.where(way[seen] > 0, 1, slope[seen]) * (t if perspective else 1.0)
            deep[seen] |= enters[seen] & (t > face.front[texel] + 2 * way[seen] + camera.pixel_size * texels)
        start = start + face.behind[texel]
        result[seen] |= t > (start if slack is None else start + slack[seen])
    if above is None:
        return result
    result |= deep & (way == 0)
    asked = (deep & ~result).nonzero()[:, 0]
    if len(asked):  # once: a surface is nothing's inside
        result[asked] = blocked(shadow, above.position[asked], above=Above(above.position[asked], above.lean[asked]))
    return result


def _slope(cosine: Tensor) -> Tensor:
    """Return how far along the light, in texels, a surface may lie from where the centre of its texel shows it."""
    steep = cosine.clamp(min=STEEPEST)
    return 1 + SLOPE_BIAS * (1 - steep.square()).clamp(min=0).sqrt() / steep


def _draw(scene: Scene, world: World, camera: Camera, silhouette: Silhouette) -> ShadowFace:
    """Render the scene from the light and keep the nearest shadow start of each texel."""
    layers = rasterize(camera, world.vertices, world.faces)
    candidates, _ = find_candidates(scene, world, camera, layers, silhouette, depths=False)
    blockers = (candidates.fragment >= 0).nonzero()[:, 0]  # a light inside a solid lights that solid's surroundings
    candidates = candidates.select(blockers)
    closed = candidates.back >= 0
    surface = torch.where(closed, candidates.back, candidates.fragment)
    points = interpolate(world, layers, camera, surface)
    direction = rays(camera, candidates.pixel, layers.t.dtype)[1]
    cosine = dot(points.frame.n, -direction)
    corner = world.vertices[world.faces[layers.triangles.face[layers.triangle[surface]]]]
    facet = normalize(torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    t = layers.t[surface]
    texel = camera.pixel_size * (t if camera.projection == "perspective" else torch.ones_like(t))
    bias = texel * _slope(dot(facet, direction).abs())

    # Closed: a little before the back, so that the far side of a body is in its own shadow, but not before the middle.
    inside = -torch.minimum(bias, (t - candidates.t) / 2)
    slabs = [0.0 if m.mdf is None else m.mdf.h for m in scene.surfaces]
    h = torch.tensor(slabs, dtype=t.dtype)[points.owner]
    textured = layers.triangles.front[layers.triangle[surface]] & (silhouette != "none")
    slab = torch.where(textured, points.scale * h / cosine.clamp(min=MIN_COS), 0)
    met = candidates.prism >= 0
    behind = torch.where(closed, inside, torch.where(met, candidates.depth - t + bias, slab + bias))
    first = nearest(candidates, t + behind)
    n_pixel = camera.width * camera.height
    triangle = torch.full((n_pixel,), -1)
    offset, front = torch.zeros(n_pixel, dtype=behind.dtype), torch.full((n_pixel,), torch.inf, dtype=behind.dtype)
    triangle[candidates.pixel[first]] = layers.triangle[surface[first]]
    offset[candidates.pixel[first]] = behind[first]
    front.scatter_reduce_(0, candidates.pixel[closed], candidates.t[closed].to(front.dtype), "amin")
    return ShadowFace(camera, triangle, offset, front, layers.triangles)


def sizes(light: Light, size: int) -> list[int]:
    """Return the sides in texels of the pictures that `cameras` takes from a light."""
    if isinstance(light, DirectionalLight | SpotLight):
        return [size]
    return [max(size // 2, 1)] * 6


def cameras(corners: Corners, light: Light, size: int) -> list[Camera]:
    """Return the views from a light: one around all that casts shadows, one along a cone, or six faces of a cube.

    In numpy, whose calls are short: a light may move in every frame.

    Args:
        corners: of the scene.
        light: any.
        size: side of the map in texels; of a face of a cube, half of it.
    """
    if isinstance(light, DirectionalLight):
        axes = _axes(light.direction)
        whole, cast = extents(corners, axes.numpy())
        reach = float((whole.high - whole.low).max())
        extent = max(float((cast.high - cast.low)[:2].max()), reach / FINEST) * (1 + 4 / size) + 1e-9
        # Nothing is nearer to the light than the nearest of all vertices, wherever the map looks.
        near = 1e-3 * reach + 1e-9
        middle = (cast.low + cast.high) / 2
        middle[2] = whole.high[2] + 2 * near
        eye = torch.from_numpy(middle @ axes.numpy())
        return [
            Camera(eye=eye, axes=axes, projection="orthographic", view_height=extent, width=size, height=size,
                   near=near)
        ]  # fmt: skip
    eye = light.position.double()
    far = max(float(np.linalg.norm(x - eye.numpy()[:, None], axis=0).max()) for x in corners.sets)
    near = max(1e-4 * far, 1e-9)
    if isinstance(light, SpotLight):
        axes = _axes(-light.axis)
        # A texel more on every side, so that the rim of the cone is covered.
        fov = 2 * math.degrees(math.atan(math.tan(math.radians(light.outer_deg)) * (1 + 4 / size)))
        return [Camera(eye=eye, axes=axes, fov_deg=fov, width=size, height=size, near=near)]
    side = sizes(light, size)[0]
    fov = 2 * math.degrees(math.atan(1 + 2 / side))
    cube = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            back = torch.zeros(3)
            back[axis] = sign
            cube.append(Camera(eye=eye, axes=_axes(back), fov_deg=fov, width=side, height=side, near=near))
    return cube


def _axes(back: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Return axes of a camera that looks along -`back`, as `frames.around`; in floats, for lights that move."""
    n = _unit(back.tolist())
    least = min(range(3), key=lambda k: abs(n[k]))
    t = _unit(_cross(n, [float(k == least) for k in range(3)]))
    return torch.tensor([t, _cross(n, t), n], dtype=torch.float64)


def _unit(a: list[float]) -> list[float]:
    length = math.sqrt(sum(x * x for x in a))
    return [x / length for x in a]


def _cross(a: list[float], b: list[float]) -> list[float]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
