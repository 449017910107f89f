"""The commands `synthesize` and `tile`: small exemplars in, maps of large textures and sets of tiles out.

Heavy imports stay inside the functions.

Tests: tests/pipeline/test_synthesize.py
Tests: tests/pipeline/test_tiles.py
"""

import re
from typing import TYPE_CHECKING, Any

import click

from torchmeso.console import progress, refuse_to_replace
from torchmeso.errors import ConfigError

if TYPE_CHECKING:
    from torchmeso.pipeline.synthesize import Done
    from torchmeso.pipeline.tiles import Made


@click.command()
@click.argument("exemplar")
@click.option(
    "--method", default="quilting", type=click.Choice(["quilting", "wang"]), show_default=True, help="How to grow."
)
@click.option("--size", help="Texels of the result: 256, or 400x300 (across x down) [256; of a tile the exemplar's].")
@click.option("--patch", type=int, help="Side of a patch in texels [a third of the exemplar; of tiles half a tile].")
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
@click.option(
    "--kind",
    type=click.Choice(["edges", "corners", "any"]),
    default="edges",
    show_default=True,
    help="Tiles: with coloured sides or corners, all c^4 of them; any: 96 for surfaces of any topology.",
)
@click.option("--colours", type=int, default=2, show_default=True, help="Tiles: colours of a side or corner, c.")
@click.option("--band", type=int, help="Tiles: texels across an edge, even, about a feature [a quarter of a tile].")
@click.option("--candidates", type=int, default=8, show_default=True, help="Tiles: patches cut for each one laid.")
@click.option("--refine", type=int, default=12, show_default=True, help="Tiles: most patches over seams of each tile.")
@click.option("--bands", type=int, help="Compare only harmonics below this degree, or so many eigen components [all].")
@click.option("--seed", type=int, default=0, show_default=True, help="Same seed, same map.")
@click.option("--debug-pictures", type=click.Path(), help="Folder for pictures of the map, the cuts and the seams.")
@click.option("--out", required=True, help="A map (.quilt), of a picture also the quilted one (.png); tiles (.tiles).")
@click.option("--force", is_flag=True, help="Replace an existing file.")
@click.pass_context
def synthesize(
    context: click.Context,
    exemplar: str,
    method: str,
    size: str | None,
    bands: int | None,
    seed: int,
    debug_pictures: str | None,
    out: str,
    force: bool,
    **options: Any,
) -> None:
    """Grow a larger texture from the EXEMPLAR, a BTF model (.meso) or a picture: a quilting map, or a set of tiles."""
    from torchmeso.pipeline import synthesize as quilting_job
    from torchmeso.pipeline import tiles as tiles_job
    from torchmeso.synthesize.quilting import QuiltingOptions
    from torchmeso.synthesize.wang import WangOptions

    own = _own(context, method, options)
    refuse_to_replace(out, force)
    more = {"bands": bands, "seed": seed, "pictures": debug_pictures}
    with progress() as report:
        if method == "wang":
            side = None if size is None else _size(size)
            if side is not None and side[0] != side[1]:
                raise ConfigError(f"--size: expected the side of a tile like 64, got '{size}'")
            wanted = WangOptions(size=side and side[0], **own)
            line = _of_tiles(out, tiles_job.make(exemplar, wanted, out, report=report, **more))
        else:
            wanted = QuiltingOptions(**own)
            line = _of_quilt(
                out, quilting_job.quilt(exemplar, _size(size or "256"), wanted, out, report=report, **more)
            )
    click.echo(line)


@click.command()
@click.argument("tiles")
@click.argument("mesh", required=False)
@click.option("--plane", default="16x16", show_default=True, help="Tiles across x down, where there is no MESH.")
@click.option(
    "--order",
    type=click.Choice(["hash", "scanlines"]),
    default="hash",
    show_default=True,
    help="Plane: colours by a hash of their place, which repeats without a seam, or tile by tile, which does not.",
)
@click.option("--exemplar", help="Plane: what to show; writes a picture (.png) in place of a map.")
@click.option(
    "--by",
    type=click.Choice(["auto", "quads", "polycube", "cube", "quadriflow"]),
    default="auto",
    show_default=True,
    help="Mesh: where quads come from: its own, its PolyCube map, a cube around it, QuadriFlow; auto = what it has.",
)
@click.option("--split", type=int, help="Mesh: tiles along a side of a quad, 1-64 [1; 8 along a side of the cube].")
@click.option("--quads", type=int, default=400, show_default=True, help="Mesh: about how many QuadriFlow makes.")
@click.option("--smooth", type=int, help="Mesh: smaller quads along a side of a tile, 1-32 [1; 8 of QuadriFlow's].")
@click.option("--seed", type=int, default=0, show_default=True, help="Same seed, same tiling.")
@click.option("--debug-pictures", type=click.Path(), help="Mesh: folder for a picture of the quads and frame jumps.")
@click.option("--out", required=True, help="The tiled plane (.quilt, with --exemplar .png), or surface (.surface).")
@click.option("--force", is_flag=True, help="Replace an existing file.")
@click.pass_context
def tile(
    context: click.Context,
    tiles: str,
    mesh: str | None,
    plane: str,
    order: str,
    exemplar: str | None,
    seed: int,
    debug_pictures: str | None,
    out: str,
    force: bool,
    **options: Any,
) -> None:
    """Lay TILES (.tiles) over the plane, or over the surface of a MESH that any set of their kind then dresses."""
    from pathlib import Path

    from torchmeso.errors import human_size
    from torchmeso.pipeline import tiles as job

    others = MESH_ONLY if mesh is None else PLANE_ONLY
    _refuse(context, others, "belongs to a MESH" if mesh is None else "belongs to a plane, not to a MESH")
    refuse_to_replace(out, force)
    if mesh is None:
        found = job.lay(tiles, _size(plane, "--plane"), out, hashed=order == "hash", seed=seed, exemplar=exemplar)
        height, width = found.texels
        line = f"{plane} tiles, {width} x {height} texels from {found.source[1]} x {found.source[0]}"
    else:
        from torchmeso.pipeline import dress
        from torchmeso.synthesize.parameterize import SurfaceOptions

        with progress() as report:
            wanted = SurfaceOptions(seed=seed, **options)
            surface = dress.run(tiles, mesh, wanted, out, pictures=debug_pictures, report=report)
        line = f"{len(surface.faces)} triangles in {len(surface.quads)} quads, {len(surface.jumps)} frame jumps"
    click.echo(f"{out}  {line}  {human_size(Path(out).stat().st_size)}")


PLANE_ONLY = ("plane", "order", "exemplar")
MESH_ONLY = ("by", "split", "quads", "smooth", "debug_pictures")
QUILTING_ONLY = ("overlap", "tolerance", "rule", "tileable", "verbatim")
WANG_ONLY = ("kind", "colours", "band", "candidates", "refine")


def _own(context: click.Context, method: str, options: dict[str, Any]) -> dict[str, Any]:
    """Return the options of a method.

    Raises:
        ConfigError: one of the other's was given.
    """
    others = QUILTING_ONLY if method == "wang" else WANG_ONLY
    _refuse(context, others, f"not an option of --method {method}")
    return {name: value for name, value in options.items() if name not in others}


def _refuse(context: click.Context, names: tuple[str, ...], why: str) -> None:
    """Raise ConfigError if one of these options was given."""
    for name in names:
        source = context.get_parameter_source(name)
        if source is not None and source.name == "COMMANDLINE":
            raise ConfigError(f"--{name.replace('_', '-')}: {why}; leave it out")


def _of_quilt(out: str, found: "Done") -> str:
    from pathlib import Path

    from torchmeso.errors import human_size

    quilt, source = found
    height, width = quilt.map.texels
    return (
        f"{out}  {width} x {height} texels from {source.texels[1]} x {source.texels[0]}  "
        f"{human_size(Path(out).stat().st_size)}  {int(quilt.patch.max()) + 1} patches, {quilt.within:.0%} within "
        f"tolerance  {source.codes.shape[2]} channels, {100 * source.kept:.4g} % of the variance"
    )


def _of_tiles(out: str, found: "Made") -> str:
    from pathlib import Path

    from torchmeso.errors import human_size

    tiles, source = found.wang.set, found.source
    return (
        f"{out}  {len(tiles.index)} tiles of {tiles.side} x {tiles.side} texels from {source.texels[1]} x "
        f"{source.texels[0]}, {tiles.share:.1%} of them referenced  {human_size(Path(out).stat().st_size)}  "
        f"{source.codes.shape[2]} channels, {100 * source.kept:.4g} % of the variance"
    )


def _size(text: str, name: str = "--size") -> tuple[int, int]:
    """Return height and width of "256" or "400x300".

    Raises:
        ConfigError: it is neither.
    """
    found = re.fullmatch(r"(\d+)(?:x(\d+))?", text.strip().lower())
    if found is None:
        raise ConfigError(f"{name}: expected numbers like 256 or 400x300, got '{text}'")
    return int(found[2] or found[1]), int(found[1])
