"""Rows of the suite `render` on a million triangles: a crowd of knots beside one of 190 thousand.

Test: tests/bench/test_million.py
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial

import torch

from torchmeso.bench import frames
from torchmeso.bench.scenes import view
from torchmeso.bench.suite import Context, Row
from torchmeso.bench.timing import time_together
from torchmeso.geometry import mesh
from torchmeso.geometry.camera import Camera
from torchmeso.render import frame
from torchmeso.render.frame import FrameOptions, Skips
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Object, Scene, in_double

COUNTS = (16, 84)
"""Knots of 11,952 triangles: 191,232 and 1,003,968."""

CROPS = ((1.1, 0.7), (-1.6, -1.2))
"""Places in the crowd that are looked at closely."""


def million(context: Context) -> Iterator[Row]:
    """Time of the large crowd over the small one, from one view each that shows most of it; and its exactness."""
    knot = frames.build(frames.knot(), context.report)
    scenes = {n: crowd(knot.objects[0], n, knot) for n in COUNTS}
    options = FrameOptions(shadow_map_size=768, skips=Skips(resting=False))
    renderers = {n: Renderer(scene, options) for n, scene in scenes.items()}
    cameras = {n: _moving() for n in COUNTS}
    calls: dict[str, Callable[[], object]] = {str(n): partial(_draw, renderers[n], cameras[n]) for n in COUNTS}
    timing = time_together(calls, n=5 if context.quick else 15, warm=2, settle=1)
    small, large = (timing[str(n)] for n in COUNTS)
    faces = {n: sum(len(o.mesh.faces) for o in scenes[n].objects) for n in COUNTS}
    drawn = renderers[COUNTS[1]].counts["triangles drawn"]
    yield Row(
        id="million.frame",
        what=f"frame of {faces[COUNTS[1]]} triangles with a shadow map of 768^2, over one of {faces[COUNTS[0]]}",
        value=round(large.wall / small.wall, 2), unit="x", better="lower", goal=4.0, n=large.n,
        peer=f"{large.wall:.0f} ms over {small.wall:.0f} ms (CPU/cores {large.cpu:.0f} over {small.cpu:.0f}); "
        f"{drawn} triangles cover a pixel",
    )  # fmt: skip
    if context.quick:
        return
    scene, bare = scenes[COUNTS[1]], FrameOptions(shadows=False)
    renderer = Renderer(scene, bare)
    for number, (x, y) in enumerate(CROPS):
        camera = view((x, y, 8.0), at=(x, y, 0.0), width=64, height=64, fov_deg=4)
        exact, fast = frame.render(in_double(scene), camera, bare), renderer.render(camera)
        wrong = (exact.rgb - fast.rgb).abs().amax(-1) > 1 / 255
        same = exact.counts["fragments"] == fast.counts["fragments"]
        yield Row(
            id=f"million.crop.{number}",
            what="a crop of it, 64 x 64: pixels off by more than 1/255 from torch in float64",
            value=int(wrong.sum()), unit="pixels", better="lower", goal=2 if same else -1,
            peer=f"{fast.counts['fragments']} fragments, torch {exact.counts['fragments']}",
        )  # fmt: skip


def crowd(body: Object, count: int, like: Scene) -> Scene:
    """Return `count` small copies of a body, in rows of ten that fill a picture of 4 : 3, lit as `like` is."""
    columns = 10 if count > 20 else 4
    size = 6.4 / columns
    objects = []
    for i in range(count):
        matrix = torch.diag(torch.tensor([0.3 * size, 0.3 * size, 0.3 * size, 1.0]))
        rows = -(-count // columns)
        matrix[0, 3] = (i % columns - (columns - 1) / 2) * size
        matrix[1, 3] = (i // columns - (rows - 1) / 2) * size
        objects.append(replace(body, mesh=mesh.transform(body.mesh, matrix)))
    return replace(like, objects=tuple(objects))


def _moving() -> Iterator[Camera]:
    """Yield views that move by less than can be seen, so that nothing rests."""
    for step in itertools.count():
        yield view((1e-7 * step, 0.0, 8.0), fov_deg=44)


def _draw(renderer: Renderer, cameras: Iterator[Camera]) -> None:
    renderer.show(next(cameras))
