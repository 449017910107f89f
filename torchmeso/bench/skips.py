"""The suite `skip`: what each skip leaves out in each scene, and what that gains.

Test: tests/bench/test_skips.py
"""

import itertools
from collections.abc import Iterator
from dataclasses import fields, replace
from functools import partial

import torch

from torchmeso.bench import frames, gdm_speed
from torchmeso.bench.suite import Context, Measurement, Row
from torchmeso.bench.timing import time_together
from torchmeso.geometry import mesh
from torchmeso.geometry.camera import Camera
from torchmeso.geometry.light import SpotLight
from torchmeso.meso.bake_gdm import GdmOptions
from torchmeso.render.frame import FrameOptions, Skips
from torchmeso.render.renderer import Renderer
from torchmeso.render.scene import Material, Object, Scene

COUNTERS = {
    "frustum": "triangles beside the view",
    "empty": "stamps that stayed empty",
    "hidden": "triangles turned away",
    "behind": "stretches behind a resolved pixel",
    "bounds": "intervals passed by the facets alone",
    "plain": "frames without silhouette code",
    "losers": "losing fragments not shaded",
    "facing": "shadow tests of what leans away",
    "resting": "shadow maps kept",
    "unlit": "lights left out",
    "unseen": "shadow stamps left out",
    "carried": "prisms passed without a look-up",
}
"""What counts each skip."""


def skip(context: Context) -> Iterator[Row]:
    """Each skip off, beside all on, in each scene."""
    for name, (scene, timed) in _scenes(context).items():
        camera = frames.camera_at(scene, timed, 0.5)
        options = FrameOptions(silhouette="curved", shadow_map_size=768)
        # By less than can be seen, but it moves: what rests with a camera must not hide a skip.
        moving = (camera, replace(camera, eye=camera.eye.double() + 1e-7))
        calls, renderers = {}, {}
        for off in ("", *(f.name for f in fields(Skips))):
            skips = replace(Skips(), **({off: False} if off else {}))
            renderers[off] = Renderer(scene, replace(options, skips=skips))
            calls[off] = partial(_turn, renderers[off], itertools.cycle(moving))
        timing = time_together(calls, n=9 if context.quick else 25, warm=3, settle=4)
        on = renderers[""].counts
        for f in fields(Skips):
            counter = COUNTERS[f.name]
            gone = renderers[f.name].counts[counter]
            yield Row(
                id=f"skip.{f.name}.{name}",
                what=f"time of a frame of {name} without the skip {f.name}, over the time with all; counted: {counter}",
                value=round(timing[f.name].wall / timing[""].wall, 3), unit="x", better="higher", n=timing[""].n,
                peer=f"{on[counter]} {counter}, {gone} without it; "
                f"{timing[f.name].wall:.2f} ms without, {timing[''].wall:.2f} ms with",
                curve={"series": f.name, "x": name},
            )  # fmt: skip
    yield from _ranks(context)


def _turn(renderer: Renderer, cameras: Iterator[Camera]) -> None:
    renderer.show(next(cameras))


def _ranks(context: Context) -> Iterator[Row]:
    """The one lossy skip: time and error over the error that is allowed."""
    timed = frames.knot(rank=16)
    scene = frames.build(timed, context.report)
    camera = frames.camera_at(scene, timed, 0.5)
    exact = Renderer(scene, FrameOptions(shadow_map_size=768)).render(camera).rgb.clone()
    errors = (0.0, 0.05, 0.2)
    drawn = {e: Renderer(scene, FrameOptions(shadow_map_size=768, rank_error=e)) for e in errors}
    timing = time_together(
        {str(e): lambda r=r: r.show(camera) for e, r in drawn.items()}, n=9 if context.quick else 25, warm=3, settle=4
    )
    for e, r in drawn.items():
        picture = r.render(camera)
        yield Row(
            id=f"skip.rank_error.{e:g}",
            what=f"time of a frame with 16 components, over one that spares groups which add at most {e:g} to T",
            value=round(timing["0.0"].wall / timing[str(e)].wall, 3), unit="x", better="higher",
            peer=f"{picture.counts['groups of components spared']} groups spared, largest error "
            f"{float((picture.rgb - exact).abs().max()):.4f}",
            curve={"series": "rank error", "x": e, "ms": round(timing[str(e)].wall, 2)},
        )  # fmt: skip


def _scenes(context: Context) -> dict[str, tuple[Scene, frames.Timed]]:
    """The knot, without any mesostructure, in a coat close around it, in a shell, and in a crowd; Fig. 13.

    The crowd's other knots stand beside the view, and its other lights shine away.
    """
    timed = frames.knot()
    knot = frames.build(timed, context.report)
    body = knot.objects[0]
    plain = replace(knot, objects=(Object(mesh=body.mesh, material=Material(btf=body.material.btf)),))
    # So close that many rays pass through its joints on to what it covers.
    coat = replace(knot, objects=(body, replace(body, mesh=_grown(body.mesh, 0.004))))
    gdm = gdm_speed.table("weave", GdmOptions(texels=32, layers=16), context, backing=True)
    shell = replace(knot, objects=(replace(body, material=Material(gdm=gdm)),))
    away = tuple(
        SpotLight(
            position=torch.tensor([0.0, 9.0 + i, 0.0]),
            axis=torch.tensor([0.0, 1.0, 0.0]),
            intensity=torch.full((3,), 80.0),
        )
        for i in range(4)
    )
    row = tuple(Object(mesh=_moved(body.mesh, 8.0 * i, 2.0 * i), material=body.material) for i in range(-8, 9))
    crowd = replace(knot, objects=row, lights=(*knot.lights, *away))
    found = {"knot": (knot, timed), "plain": (plain, timed), "coat": (coat, timed)}
    found |= {"shell": (shell, timed), "crowd": (crowd, timed)}
    if not context.quick:
        fig13 = dict(frames.table_2())["fig13"]
        found["fig13"] = (frames.build(fig13, context.report), fig13)
    return found


def _grown(subject: mesh.Mesh, by: float) -> mesh.Mesh:
    return replace(subject, vertices=subject.vertices + by * subject.normals)


def _moved(subject: mesh.Mesh, x: float, z: float) -> mesh.Mesh:
    matrix = torch.eye(4)
    matrix[0, 3], matrix[2, 3] = x, z
    return mesh.transform(subject, matrix)


MEASUREMENTS = [Measurement("skip", skip)]
