"""The command `synthesize`: small exemplars in, maps of large textures out. Heavy imports stay inside the function.

Test: tests/pipeline/test_synthesize.py
"""

import re
from typing import Any

import click

from torchmeso.console import progress, refuse_to_replace
from torchmeso.errors import ConfigError


@click.command()
@click.argument("exemplar")
@click.option("--method", default="quilting", type=click.Choice(["quilting"]), show_default=True, help="How to grow.")
@click.option("--size", default="256", show_default=True, help="Texels of the result: 256, or 400x300 (across x down).")
@click.option("--patch", type=int, help="Side of a patch in texels [a third of the exemplar's shorter side].")
@click.option("--overlap", type=int, help="Texels by which patches overlap, at most half a patch [a quarter of it].")
@click.option(
    "--tolerance",
    type=float,
    default=0.1,
    show_default=True,
    help="How far from the least error a patch may be drawn; 0 = only what fits exactly, else the best.",
)
@click.option(
    "--rule",
    type=click.Choice(["rms", "best"]),
    default="rms",
    show_default=True,
    help="What the tolerance is a share of: the overlap's own RMS, or the least error of all placements.",
)
@click.option("--tileable", is_flag=True, help="Make a texture that repeats without a seam.")
@click.option("--toroidal", is_flag=True, help="The exemplar itself repeats: patches may run over its border.")
@click.option("--verbatim/--no-verbatim", default=None, help="Whether patches may go on where neighbours came from.")
@click.option("--bands", type=int, help="Compare only harmonics below this degree, or so many eigen components [all].")
@click.option("--seed", type=int, default=0, show_default=True, help="Same seed, same map.")
@click.option("--debug-pictures", type=click.Path(), help="Folder for pictures of the map, the cuts and the seams.")
@click.option("--out", required=True, help="The quilting map (.quilt); of a picture also the quilted one (.png).")
@click.option("--force", is_flag=True, help="Replace an existing file.")
def synthesize(
    exemplar: str,
    method: str,
    size: str,
    bands: int | None,
    seed: int,
    debug_pictures: str | None,
    out: str,
    force: bool,
    **options: Any,
) -> None:
    """Quilt the EXEMPLAR, a BTF model (.meso) or a picture, into a map of a larger texture."""
    from pathlib import Path

    from torchmeso.errors import human_size
    from torchmeso.pipeline import synthesize as job
    from torchmeso.synthesize.quilting import QuiltingOptions

    refuse_to_replace(out, force)
    with progress() as report:
        quilt, source = job.quilt(
            exemplar, _size(size), QuiltingOptions(**options), out,
            bands=bands, seed=seed, pictures=debug_pictures, report=report,
        )  # fmt: skip
    height, width = quilt.map.texels
    click.echo(
        f"{out}  {width} x {height} texels from {source.texels[1]} x {source.texels[0]}  "
        f"{human_size(Path(out).stat().st_size)}  {int(quilt.patch.max()) + 1} patches, {quilt.within:.0%} within "
        f"tolerance  {source.codes.shape[2]} channels, {100 * source.kept:.4g} % of the variance"
    )


def _size(text: str) -> tuple[int, int]:
    """Return height and width of "256" or "400x300".

    Raises:
        ConfigError: it is neither.
    """
    found = re.fullmatch(r"(\d+)(?:x(\d+))?", text.strip().lower())
    if found is None:
        raise ConfigError(f"--size: expected texels like 256 or 400x300, got '{text}'")
    return int(found[2] or found[1]), int(found[1])
