"""Rows of the suite `render` on minification: a floor to far away against 64 rays per pixel, and a turntable's flicker.

Test: tests/bench/test_minify.py
"""

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from torchmeso import quality
from torchmeso.bench import frames
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import time_together
from torchmeso.geometry import mesh, shapes
from torchmeso.geometry.camera import Camera, look_at
from torchmeso.pipeline import animate
from torchmeso.render.frame import FrameOptions, Skips
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Material, Object, Scene

RAYS = 8
"""Along a side of a pixel, in the reference: 64 in all."""

BANDS = 8
"""Parts of the picture, far to near, whose errors are drawn."""

FRAMES = 120


def minify(context: Context) -> Iterator[Row]:
    """A floor, then a turntable."""
    yield from floor(context)
    yield from turntable(context)


def floor(context: Context) -> Iterator[Row]:
    """Error and time of a perspective floor with and without its pyramid."""
    timed = frames.knot()
    knot = frames.build(timed, context.report)
    scene, camera = floor_scene(knot.objects[0].material), floor_camera()
    scene = replace(scene, lights=knot.lights)
    options = FrameOptions(shadows=False, skips=Skips(resting=False))
    reference = Renderer(scene, replace(options, filtering=False, antialias=RAYS)).render(camera).rgb
    side = texels_per_pixel(scene, camera)
    ways = {"mips": options, "none": replace(options, filtering=False)}
    for n in (2, 4):
        ways[f"mips, {n} x {n} frames"] = replace(options, antialias=n)
    renderers = {name: Renderer(scene, way) for name, way in ways.items()}
    for name, renderer in renderers.items():
        picture = renderer.render(camera).rgb.clone()
        found = quality.compare(reference, picture)
        yield Row(
            id=f"minify.floor.psnr.{name.split(',')[0] if name in ('mips', 'none') else f'antialias{name[6]}'}",
            what=f"floor of bricks, {side.min():.1f} to {side.max():.1f} texels per pixel, {name}: against 64 rays per "
            "pixel",
            value=round(found.psnr, 2), unit="dB", better="higher", goal=35.0 if name == "mips" else None,
            peer=f"SSIM {found.ssim:.4f}",
        )  # fmt: skip
        rows = camera.height // BANDS
        for band in range(0, camera.height, rows):
            part = slice(band, band + rows)
            yield Row(
                id=f"minify.floor.band.{name}.{band // rows}",
                what=f"the same, {name}, where a pixel covers {float(side[part].mean()):.2f} texels",
                value=round(quality.compare(reference[part], picture[part]).psnr, 2), unit="dB", better="higher",
                curve={"series": name, "x": round(float(side[part].mean()), 3)},
            )  # fmt: skip
    calls: dict[str, Callable[[], object]] = {x: partial(renderers[x].show, camera) for x in ("mips", "none")}
    timing = time_together(calls, n=9 if context.quick else 25, warm=3, settle=2)
    a, b = timing["mips"], timing["none"]
    yield Row(
        id="minify.floor.cost", what="frame of the floor with mips, over the same without",
        value=round(a.wall / b.wall, 3), unit="x", better="lower", goal=1.15, n=a.n,
        peer=f"without {b.wall:.1f} ms (CPU/cores {b.cpu:.1f}), with {a.wall:.1f} ms (CPU/cores {a.cpu:.1f})",
    )  # fmt: skip


def turntable(context: Context) -> Iterator[Row]:
    """How much a turning knot flickers, beside the same with 64 rays per pixel."""
    timed = frames.knot()
    scene = frames.build(timed, context.report)
    at = frames.camera_at(scene, timed, 0.28)
    view = timed.config.camera.model_copy(update={"eye": tuple(at.eye.tolist()), "width": 400, "height": 300})
    config = timed.config.model_copy(update={"camera": view})
    cameras = [camera for camera, _ in animate.turn(config, FRAMES, "turntable")]
    cameras = cameras[: 12 if context.quick else FRAMES]
    base = FrameOptions(shadow_map_size=768)
    ways = {
        "none": replace(base, filtering=False),
        "mips": base,
        "mips, 2 x 2 frames": replace(base, antialias=2),
        "mips, 4 x 4 frames": replace(base, antialias=4),
    }
    reference = _sequence(context, scene, replace(base, filtering=False, antialias=RAYS), cameras)
    own = _change(reference)
    for name, way in ways.items():
        sequence = _sequence(context, scene, way, cameras)
        residual = (sequence.diff(dim=0) - reference.diff(dim=0)).square().mean().sqrt() / own
        yield Row(
            id=f"minify.flicker.{name if name in ('mips', 'none') else f'antialias{name[6]}'}",
            what=f"{len(cameras)} of {FRAMES} frames around the 12k knot, 400 x 300, {name}: change from frame to "
            "frame over that of 64 rays per pixel, RMS on the screen",
            value=round(float(_change(sequence) / own), 3), unit="x", better="lower",
            goal=1.2 if name == "mips" else None, n=len(cameras),
            peer=f"RMS of the difference between both changes: {float(residual):.3f} of the reference's own",
        )  # fmt: skip


def floor_scene(material: Material) -> Scene:
    """Return a floor of `material`, turned by 25 degrees, so large that a view from one unit above sees no border."""
    turn = math.radians(25)
    matrix = torch.eye(4)
    matrix[0, 0], matrix[0, 2] = math.cos(turn), math.sin(turn)
    matrix[2, 0], matrix[2, 2] = -math.sin(turn), math.cos(turn)
    ground = mesh.transform(shapes.plane(size=(80.0, 80.0), tiles=(440, 440)), matrix)
    return Scene(objects=(Object(mesh=ground, material=material),), lights=())


def floor_camera(width: int = 800, height: int = 600) -> Camera:
    """Return a view from one unit above the floor to five degrees below the horizon."""
    pitch = math.radians(26.5)
    at = (0.0, 1 - math.sin(pitch), -math.cos(pitch))
    place, axes = look_at(*(torch.tensor(x, dtype=torch.float64) for x in ((0.0, 1.0, 0.0), at, (0.0, 1.0, 0.0))))
    return Camera(eye=place, axes=axes, fov_deg=43.0, width=width, height=height)


def texels_per_pixel(scene: Scene, camera: Camera) -> Float[Tensor, "H"]:
    """Return the side of the square a pixel of the middle column covers of the floor, in texels, row by row."""
    _, direction, _ = camera.rays(camera.pixel_centres(torch.float64)[:, camera.width // 2])
    t = -camera.eye[1] / direction[:, 1]
    width = camera.pixel_width(camera.eye + t[:, None] * direction)
    (item,) = scene.objects
    texels = getattr(item.material.btf, "texels", (1, 1))[0]
    return width / float(item.mesh.scale[0]) * texels / (-direction[:, 1]).sqrt()


def _sequence(
    context: Context, scene: Scene, options: FrameOptions, cameras: list[Camera]
) -> Float[Tensor, "frame H W 3"]:
    """Return what a screen shows of each frame."""
    renderer, found = Renderer(scene, options), []
    for i, camera in enumerate(cameras):
        context.report("turntable", i / len(cameras))
        found.append(quality.to_screen(renderer.render(camera).rgb, 1.0).clone())
    context.report("turntable", 1)
    return torch.stack(found)


def _change(sequence: Float[Tensor, "frame H W 3"]) -> Float[Tensor, ""]:
    """Return the RMS change from one frame to the next."""
    squares = [(b - a).square().mean() for a, b in itertools.pairwise(sequence)]
    return torch.stack(squares).mean().sqrt()
