"""Rows of the suite `render` on what a BTF cannot know: light between objects, and what shadows do within a relief.

wang2005mdf, Limitations: a BTF is measured under even light, so where a macroscopic blocker's shadow ends, light that
the mesostructure would pass on from the lit side is missing, and shadows come out too sharp. Nor does light go from
one object to another. Three scenes beside their path-traced truth, with and without bounces, say how much that is.

Test: tests/bench/test_limits.py
"""

from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchmeso import config, quality
from torchmeso.bench.suite import Context, Row
from torchmeso.config_sections import Config
from torchmeso.pipeline import scene as scenes
from torchmeso.pipeline import truth
from torchmeso.pipeline.bake import prepare
from torchmeso.pipeline.demo import built_in
from torchmeso.render import frame
from torchmeso.render.film import Picture

SCENES = ("demo", "fig10", "fig12")
BORDER = 3
"""Pixels on either side of a shadow's outline that count as its border."""


class Region(NamedTuple):
    """A part of a picture: what it is, and its pixels."""

    what: str
    pixels: Bool[Tensor, "H W"]


def limits(context: Context) -> Iterator[Row]:
    """Each scene against truth: everything, in shadow, at its border, and in the light."""
    for name in SCENES:
        settings = config.load(built_in(name))
        if context.quick and name != "demo":
            yield Row(
                id=f"limits.{name}.psnr", what=f"{name} against path-traced truth", value=None, unit="dB",
                better="higher", why="full run only",
            )  # fmt: skip
            continue
        yield from _scene(name, settings, context)


def _scene(name: str, settings: Config, context: Context) -> Iterator[Row]:
    settings = _with_truth(settings, bounces=settings.truth.bounces)
    true = truth.render(settings, context.report)
    direct = truth.render(_with_truth(settings, bounces=0), context.report)
    scene = scenes.build(settings, prepare(settings, context.report))
    ours = frame.render(scene, settings.camera.build(), settings.render)
    both = (ours.owner >= 0) & (ours.owner == true.owner)
    found = quality.compare(true.rgb, ours.rgb)
    yield Row(
        id=f"limits.{name}.psnr", what=f"{name}: our picture against path-traced truth with {settings.truth.bounces} "
        "bounces", value=round(found.psnr, 2), unit="dB", better="higher",
        peer=f"SSIM {found.ssim:.3f}, FLIP {'-' if found.flip is None else round(found.flip, 4)}; "
        f"{100 * float((ours.owner == true.owner).double().mean()):.2f} % of the pixels show the same object",
    )  # fmt: skip
    yield Row(
        id=f"limits.{name}.bounces", what=f"{name}: truth without bounces against truth: all that light does after "
        "its first surface, most of which a BTF holds", value=round(quality.compare(true.rgb, direct.rgb).psnr, 2),
        unit="dB", better="higher",
    )  # fmt: skip
    for key, (what, pixels) in regions(ours, both).items():
        if not bool(pixels.any()):
            continue
        yield Row(
            id=f"limits.{name}.{key}",
            what=f"{name}: mean brightness of ours over truth's, {what} ({int(pixels.sum())} pixels)",
            value=round(brightness(ours.rgb, true.rgb, pixels), 3), unit="x", better="higher",
            peer=f"truth without bounces {brightness(direct.rgb, true.rgb, pixels):.3f}; RMS difference "
            f"{float((ours.rgb - true.rgb)[pixels].square().mean().sqrt()):.4f}",
        )  # fmt: skip


def regions(picture: Picture, both: Bool[Tensor, "H W"]) -> dict[str, Region]:
    """Return the pixels of `both` in all lights' shadow, within `BORDER` pixels of a shadow's outline, and in light."""
    dark = picture.shadowed.any(0)
    border = _near(dark) & _near(~dark & both) & both
    return {
        "shadow": Region("in a shadow", both & dark & ~border),
        "border": Region(f"within {BORDER} pixels of a shadow's outline", border),
        "light": Region("in the light", both & ~dark & ~border),
    }


def brightness(a: Float[Tensor, "H W 3"], b: Float[Tensor, "H W 3"], pixels: Bool[Tensor, "H W"]) -> float:
    """Return the mean of `a` over that of `b`."""
    return float(a[pixels].mean() / b[pixels].mean().clamp(min=1e-12))


def _near(mask: Bool[Tensor, "H W"]) -> Bool[Tensor, "H W"]:
    side = 2 * BORDER + 1
    return torch.nn.functional.max_pool2d(mask[None].float(), side, stride=1, padding=BORDER)[0] > 0


def _with_truth(settings: Config, *, bounces: int) -> Config:
    """Return the configuration with a smaller picture, and a truth of so many bounces."""
    camera = settings.camera.model_copy(update={"width": 400, "height": 300})
    changed = settings.truth.model_copy(update={"bounces": bounces})
    return settings.model_copy(update={"camera": camera, "truth": changed})
