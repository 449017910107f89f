"""One frame: shadow maps, layers, visibility, shading.

    scene -> shadow map per light -> all layers of the camera -> intervals, depth test -> nearest -> shade

Test: tests/render/test_frame.py
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchmeso.errors import check_memory, check_range
from torchmeso.geometry import frames
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.directions import dot
from torchmeso.geometry.light import illuminate
from torchmeso.render import environment, film, gdm_shade, shadow_map
from torchmeso.render.btf_shade import shade
from torchmeso.render.film import Picture
from torchmeso.render.rasterize import Layers, rasterize
from torchmeso.render.scene import Points, Scene, World, arriving_at, assemble, interpolate, rays
from torchmeso.render.silhouette import Candidates, Counts, Silhouette, find_candidates, nearest

MEMORY_LIMIT = 16 << 30


@dataclass(frozen=True, slots=True, kw_only=True)
class Skips:
    """What the kernels leave out because it cannot change the picture; each can be switched off to show that.

    Attributes:
        frustum: objects that lie beside the view are not set up.
        empty: what shows the background already, 4 x 4 pixels or texels of a map, is not written again.
        hidden: triangles turned away are not drawn where no surface has depth, nor the bottoms of shells around bodies.
        behind: stretches that begin behind what a pixel already shows are not looked at.
        bounds: intervals too long to be passed through ask for no depth.
        plain: without any mesostructure no silhouette code runs.
        losers: only what is seen is shaded.
        facing: points that lean away from all lights ask a screen for neither depth nor shadow.
        resting: shadow maps stay while light and objects do, and triangles on the screen while the camera does.
        unlit: lights that reach no object, or stand under the horizon of every vertex, are left out.
        carried: what a look-up in a shell told of the way ahead, that it is empty or where it ends, is not asked again
            in the next prisms while the way through them turns little. Beside rank errors the one that may change a
            picture: of a weave of 64 voxels a pixel in a hundred ends more than a voxel from where it did, no further
            from the truth.
        unseen: what stops the light is found out only in stamps of a shadow map where it could shadow what is seen.
    """

    frustum: bool = True
    empty: bool = True
    hidden: bool = True
    behind: bool = True
    bounds: bool = True
    plain: bool = True
    losers: bool = True
    facing: bool = True
    resting: bool = True
    unlit: bool = True
    unseen: bool = True
    carried: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameOptions:
    """What a frame does.

    Attributes:
        silhouette: "curved" follows the curve of the surface, "paper" is the depth-interval test of wang2005mdf,
            "none" renders the BTF on the bare mesh.
        shadows: whether objects cast shadows.
        shadow_map_size: texels along a side of a shadow map.
        rank_error: groups of four components of an eigen BTF are left out where they add at most this to T; the one
            skip that changes the picture, and only on opencl.
        filtering: whether textures are averaged over what a pixel covers of them (data/pyramid); without, they are
            read at a point, and what is far away flickers.
        antialias: frames along a side of each pixel, n x n in all, whose rays are spread over it; 1 to 16.
        skips: what is left out without changing it; on opencl.
    """

    silhouette: Silhouette = "curved"
    shadows: bool = True
    shadow_map_size: int = 1024
    rank_error: float = 0.0
    filtering: bool = True
    antialias: int = 1
    skips: Skips = Skips()

    def __post_init__(self) -> None:
        """Raise ConfigError for a size out of range."""
        check_range("render.shadow_map_size", self.shadow_map_size, 8, 16384)
        check_range("render.rank_error", self.rank_error, 0, 1e6)
        check_range("render.antialias", self.antialias, 1, 16)


def render(scene: Scene, camera: Camera, options: FrameOptions | None = None) -> Picture:
    """Return the picture of `scene` seen by `camera`.

    Raises:
        SizeError: the picture would need more memory than the limit.
    """
    options = options or FrameOptions()
    if options.antialias > 1:
        return film.average(lambda c: _render(scene, c, options), camera.jittered(options.antialias))
    return _render(scene, camera, options)


def _render(scene: Scene, camera: Camera, options: FrameOptions) -> Picture:
    check_memory("render", camera.width * camera.height * 600.0, MEMORY_LIMIT, "render fewer pixels")
    seconds: dict[str, float] = {}
    environment.check(scene)
    with _timed(seconds, "assemble"):
        world = assemble(scene)
        camera, scene = world.seen_by(camera), replace(scene, lights=world.lit_by(scene.lights))
    with _timed(seconds, "shadow maps"):
        maps = _shadow_maps(scene, world, options)
    with _timed(seconds, "layers"):
        layers = rasterize(camera, world.vertices, world.faces)
    with _timed(seconds, "visibility"):
        candidates, counts = find_candidates(scene, world, camera, layers, options.silhouette)
        first = nearest(candidates, candidates.depth)
        seen = candidates.select(first)
    with _timed(seconds, "shading"):
        picture = _develop(scene, world, camera, layers, seen, maps, options)
    return Picture(**picture, counts=_count(layers, counts, camera), seconds=seconds)


def _shadow_maps(scene: Scene, world: World, options: FrameOptions) -> list[shadow_map.ShadowMap]:
    if not options.shadows:
        return []
    size = options.shadow_map_size
    return [shadow_map.build(scene, world, light, size=size, silhouette=options.silhouette) for light in scene.lights]


def _develop(
    scene: Scene,
    world: World,
    camera: Camera,
    layers: Layers,
    seen: Candidates,
    maps: list[shadow_map.ShadowMap],
    options: FrameOptions,
) -> dict[str, Tensor]:
    """Shade what is seen and lay it out as a picture."""
    n_pixel = camera.width * camera.height
    dtype = layers.t.dtype
    rgb = torch.tensor(scene.background, dtype=dtype).repeat(n_pixel, 1)
    depth, owner = torch.full((n_pixel,), torch.inf, dtype=dtype), torch.full((n_pixel,), -1)
    shadowed = torch.zeros(len(scene.lights), n_pixel, dtype=torch.bool)
    depth[seen.pixel] = seen.depth

    inside = seen.pixel[(seen.fragment < 0) & (seen.prism < 0)]
    rgb[inside], owner[inside] = 0, -2
    met = seen.select(seen.prism >= 0)
    plain = seen.select((seen.fragment >= 0) & (seen.prism < 0))
    points = interpolate(world, layers, camera, plain.fragment)
    owner[plain.pixel] = world.object[points.owner]
    origin, direction, _ = rays(camera, plain.pixel, dtype)
    dark = _blocked(scene, maps, origin + plain.depth[:, None] * direction, surface=points)
    shadowed[:, plain.pixel] = dark
    samples = options.antialias if options.filtering else None
    rgb[plain.pixel] = shade(scene, points, -direction, dark, samples=samples)
    if scene.distant is not None:
        arriving = arriving_at(scene.distant, world, layers, camera, plain.fragment)
        wo = frames.to_local(points.frame, -direction)
        rgb[plain.pixel] += environment.shade(scene, points, wo, arriving, samples=samples)

    if len(met.pixel):
        origin, direction, _ = rays(camera, met.pixel, dtype)
        shell_points = gdm_shade.points(world, met.prism, met.place, met.floor, origin + met.depth[:, None] * direction)
        owner[met.pixel] = world.object[shell_points.owner]
        depths = torch.tensor([0.0 if m.gdm is None else m.gdm.h for m in scene.surfaces], dtype=dtype)
        dark = _blocked(scene, maps, shell_points.position, depths[shell_points.owner] * shell_points.scale)
        shadowed[:, met.pixel] = dark
        rgb[met.pixel] = gdm_shade.shade(scene, shell_points, -direction, dark, shadows=options.shadows)

    size = (camera.height, camera.width)
    return {
        "rgb": rgb.reshape(*size, 3),
        "depth": depth.reshape(size),
        "owner": owner.reshape(size),
        "shadowed": shadowed.reshape(-1, *size),
    }


def _blocked(
    scene: Scene,
    maps: list[shadow_map.ShadowMap],
    position: Tensor,
    slack: Tensor | None = None,
    surface: Points | None = None,
) -> Tensor:
    """Return whether each light is blocked at positions; see `shadow_map.blocked`."""
    dark = torch.zeros(len(scene.lights), len(position), dtype=torch.bool)
    for l, (light, shadow) in enumerate(zip(scene.lights, maps, strict=False)):
        above = None
        if surface is not None:
            lean = dot(surface.frame.n, illuminate(light, surface.position)[0])
            above = shadow_map.Above(surface.position, lean)
        dark[l] = shadow_map.blocked(shadow, position, slack, above=above)
    return dark


def _count(layers: Layers, counts: Counts, camera: Camera) -> dict[str, int]:
    per_pixel = layers.start.diff()
    return {
        "triangles drawn": len(layers.triangles.face),
        "fragments": len(layers.t),
        "layers": int(per_pixel.max()),
        "pixels with a fragment": int((per_pixel > 0).sum()),
        "pixels": camera.width * camera.height,
        "intervals": counts.intervals,
        "intervals passed by their length": counts.skipped,
        "intervals carved": counts.carved,
        "pixels inside an object": counts.inside,
    }


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[name] = time.perf_counter() - start
