"""The command line: one thin function per job. Heavy imports stay inside the functions (torch costs 2 s).

Results go to stdout, one line per product; progress and warnings to stderr. A MesoError becomes one sentence
and exit status 2; a bug keeps its traceback. `compress`, `synthesize`, `tile` and `rig` have files of their own.

Test: tests/test_cli.py
"""

import json
import logging
import sys
import warnings
from typing import Any

import click

from torchmeso.backends.allocator import keep_freed_memory
from torchmeso.cli_capture import rig
from torchmeso.cli_compress import compress
from torchmeso.cli_synthesize import synthesize, tile
from torchmeso.console import progress as _progress
from torchmeso.console import refuse_to_replace as _refuse_to_replace
from torchmeso.errors import ConfigError, MesoError, StorageError

MESOS = "sheet, groove, spheres, brick, blocks, grid, weave, pipes, chain, grass, squama, peanut, bark"
"""The built-in mesostructures, said here so that help does not wait for torch."""

FILES = "weave (.tg3), height scan (.tmd), triangle tile (.obj, .ply, .stl, .off)"
"""The files that hold one."""


class _Group(click.Group):
    """A click group that prints our errors as one sentence and leaves with status 2."""

    def invoke(self, ctx: click.Context) -> Any:
        warnings.showwarning = _say
        keep_freed_memory()
        try:
            return super().invoke(ctx)
        except MesoError as error:
            if ctx.params.get("debug"):
                raise
            if isinstance(error, StorageError):  # Zarr's other writes fail for the same reason
                logging.getLogger("asyncio").setLevel(logging.CRITICAL)
            click.echo(f"{ctx.info_name} {ctx.invoked_subcommand}: error: {error}", err=True)
            ctx.exit(2)
        except KeyboardInterrupt:
            _drop_what_is_left()
            click.echo(f"{ctx.info_name} {ctx.invoked_subcommand}: stopped; run it again to go on", err=True)
            ctx.exit(130)


def _drop_what_is_left() -> None:
    """Keep Zarr's unfinished writes from complaining while Python ends: that they are dropped is no news."""
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    warnings.simplefilter("ignore")
    sys.unraisablehook = lambda *_: None


def _say(message: Warning | str, *_: Any) -> None:
    """Print a warning as one line on stderr."""
    click.echo(f"torchmeso: warning: {message}", err=True)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--debug", is_flag=True, help="Show the traceback of user errors too.")
@click.version_option(package_name="torchmeso")
def main(debug: bool) -> None:
    """Meso-scale appearance on a CPU, from a mesostructure to a picture with its silhouette and its shadow."""


@main.command()
@click.option("--out", default="out", show_default=True, type=click.Path(), help="Folder for the results.")
def demo(out: str) -> None:
    """Built-in scene, start to picture: bake, compress, render, truth, report."""
    from torchmeso import config
    from torchmeso.pipeline import demo as job

    with _progress() as report:
        paths = job.run(config.load(job.built_in("demo")), out, report)
    for path in paths:
        click.echo(path)


@main.command()
@click.argument("configuration", required=False)
@click.option("--meso", help=f"Mesostructure to bake alone: {MESOS}; or a file: {FILES}.")
@click.option("--out", help="With --meso the table (.btf.zarr, .mdf.zarr, .gdm.zarr), else a folder; none = the cache.")
@click.option("--texels", type=int, help="Side of the texture (default 64 for a BTF and a GDM, 256 for an MDF).")
@click.option("--lights", help="Light directions of a BTF [grid(12, 5, 80)].")
@click.option("--views", help="View directions [grid(12, 5, 80); MDF: grid(15, 10, 87.5)].")
@click.option("--samples", type=int, help="Rays per texel and view of a BTF [4].")
@click.option("--bounces", type=int, help="Reflections followed by a BTF; 0 = direct light only [2].")
@click.option("--layers", type=int, help="Voxels of a GDM from the bottom to the top of the slab [32].")
@click.option("--cap", type=float, help="Longest distance in a GDM, tile units [1].")
@click.option("--supersample", type=int, help="GDM: points along a side of a voxel that tell whether it is solid [1].")
@click.option("--force", is_flag=True, help="Replace a finished table.")
def bake(configuration: str | None, meso: str | None, out: str | None, force: bool, **options: Any) -> None:
    """Bake BTF and MDF of every material in CONFIGURATION, or a BTF, MDF or GDM of one mesostructure (--meso)."""
    from pathlib import Path

    if (configuration is None) == (meso is None):
        raise click.UsageError("give a CONFIGURATION or --meso")
    if configuration is not None:
        _bake_all(configuration, None if out is None else Path(out), force)
        return
    if out is None:
        raise click.UsageError("--meso needs --out, a name that ends in .btf.zarr, .mdf.zarr or .gdm.zarr")
    assert meso is not None
    _bake_one(meso, Path(out), force, {k: v for k, v in options.items() if v is not None})


def _bake_all(configuration: str, out: Any, force: bool) -> None:
    from torchmeso import config
    from torchmeso.pipeline import bake as job

    settings = config.load(configuration)
    with _progress() as report:
        baked = [
            job.bake_tables(name, material, report, {}, out=out, force=force)
            for name, material in settings.materials.items()
            if material.meso is not None
        ]
    for pair in baked:
        for path in pair:
            click.echo(path)


def _bake_one(meso: str, out: Any, force: bool, options: dict[str, Any]) -> None:
    from torchmeso import config
    from torchmeso.meso import bake_btf, bake_gdm, bake_mdf
    from torchmeso.meso.bake_btf import BtfOptions
    from torchmeso.meso.bake_gdm import GdmOptions
    from torchmeso.meso.bake_mdf import MdfOptions
    from torchmeso.pipeline import bake as bakes

    kinds = {
        ".btf.zarr": ("BTF", BtfOptions, bake_btf.bake, {"texels", "lights", "views", "samples", "bounces"}),
        ".mdf.zarr": ("MDF", MdfOptions, bake_mdf.bake, {"texels", "views"}),
        ".gdm.zarr": ("GDM", GdmOptions, bake_gdm.bake, {"texels", "layers", "cap", "supersample"}),
    }
    suffix = next((x for x in kinds if out.name.endswith(x)), None)
    if suffix is None:
        raise ConfigError(f"{out}: expected a name that ends in .btf.zarr, .mdf.zarr or .gdm.zarr")
    kind, dials, job, known = kinds[suffix]
    wrong = set(options) - known
    if wrong:
        raise ConfigError(f"bake: {kind} tables have no --{min(wrong)}; their dials are --{', --'.join(sorted(known))}")
    source = config.meso_called(meso)
    tile = source.build()
    about: dict[str, object] = {"source": {"type": meso}}
    if source.files:
        about["source"] = {"type": source.type, "path": meso, "hash": bakes.file_hash(source.files[0])}
    _refuse_to_replace(out, force)
    with _progress() as report:
        job(tile, dials(**options), out, about=about, progress=lambda x: report(f"{meso}: {kind}", x))
    click.echo(out)


main.add_command(compress)
main.add_command(rig)
main.add_command(synthesize)
main.add_command(tile)


@main.command()
@click.argument("configuration")
@click.option("--silhouette", type=click.Choice(["none", "paper", "curved"]), help="Overrides the configuration.")
@click.option("--backend", type=click.Choice(["auto", "torch", "opencl"]), help="Overrides the configuration [auto].")
@click.option(
    "--env", help="A map (.hdr, .exr, .pfm; lat-long or cube) or 'sky', in place of lights and ambient light."
)
@click.option(
    "--env-method",
    type=click.Choice(["sampling", "frequency", "transfer"]),
    help="As directional lights, as harmonics without shadows between bodies, or with them [sampling].",
)
@click.option("--frames", type=int, help="Frames of one whole turn, to .png (a sequence), .gif or .mp4.")
@click.option(
    "--path",
    "way",
    type=click.Choice(["turntable", "light", "environment"]),
    default="turntable",
    show_default=True,
    help="With --frames, what turns: the camera around the subject, the lights, or the environment.",
)
@click.option("--fps", default=25.0, show_default=True, help="Frames per second of .gif and .mp4.")
@click.option("--out", required=True, help="Picture: .png (sRGB) or .exr (linear, with depth); film: .gif, .mp4.")
@click.option("--truth", is_flag=True, help="Ray-trace the displaced mesh instead: the ground truth.")
@click.option("--force", is_flag=True, help="Replace an existing picture.")
@click.option("--json", "as_json", is_flag=True, help="Print counts and times as JSON.")
def render(
    configuration: str,
    silhouette: Any,
    backend: Any,
    env: str | None,
    env_method: Any,
    frames: int | None,
    way: Any,
    fps: float,
    out: str,
    truth: bool,
    force: bool,
    as_json: bool,
) -> None:
    """Render CONFIGURATION (.yaml), one picture or many frames; bakes what is not in the cache."""
    from torchmeso import config
    from torchmeso.data import image
    from torchmeso.pipeline import render as job
    from torchmeso.pipeline import truth as truths
    from torchmeso.render import film

    settings = config.load(configuration)
    if silhouette is not None:
        settings = config.with_silhouette(settings, silhouette)
    if backend is not None:
        settings = settings.model_copy(update={"backend": backend})
    if env is not None or env_method is not None:
        settings = config.with_environment(settings, env, env_method)
    if frames is not None:
        _render_frames(settings, out, truth, force, {"frames": frames, "way": way, "fps": fps})
        return
    if not out.lower().endswith((".png", ".exr")):
        raise ConfigError(f"{out}: expected a name that ends in .png or .exr")
    _refuse_to_replace(out, force)
    with _progress() as report:
        if truth:
            found = truths.render(settings, report)
            if out.lower().endswith(".png"):
                image.write_png(out, found.rgb)
            else:
                image.write_exr(out, found.rgb, Z=found.depth)
            about: dict[str, Any] = {"path": out}
        else:
            picture = job.render(settings, report).picture
            film.write(picture, out)
            about = {"path": out, "counts": picture.counts, "seconds": picture.seconds}
    click.echo(json.dumps(about) if as_json else out)


def _render_frames(settings: Any, out: str, truth: bool, force: bool, options: dict[str, Any]) -> None:
    from torchmeso.data import video
    from torchmeso.pipeline import animate

    if truth:
        raise ConfigError("render: --truth makes one picture; leave --frames out")
    if not out.lower().endswith(video.SUFFIXES):
        raise ConfigError(f"{out}: expected a name that ends in {', '.join(video.SUFFIXES)}")
    for path in video.paths(out, options["frames"]):
        _refuse_to_replace(path, force)
    with _progress() as report:
        written = animate.render(settings, out, report=report, **options)
    for path in written:
        click.echo(path)


@main.command()
@click.argument("file")
@click.option(
    "--to",
    "out",
    required=True,
    help="The file to write: .glb (glTF 2.0); of a BTF .btf (Bonn) or a folder of EXR; of a model a folder.",
)
@click.option(
    "--method",
    type=click.Choice(["dfmf", "bdi"]),
    default="dfmf",
    show_default=True,
    help="Of .btf: factored, or all values in half precision.",
)
@click.option("--rank", type=int, help="Of .btf, dfmf: components of each colour channel [64, or all there are].")
@click.option("--force", is_flag=True, help="Replace an existing file.")
def export(file: str, out: str, method: Any, rank: int | None, force: bool) -> None:
    """Write FILE for other programs: a mesh or all objects of a configuration where they stand, a BTF or a model."""
    from torchmeso.pipeline import export as job
    from torchmeso.pipeline import textures

    maps, table = file.endswith(".meso"), file.rstrip("/").endswith(".btf.zarr")
    one_file = out.lower().endswith((".glb", ".btf"))
    if maps if one_file else not (maps or table):
        raise ConfigError(f"{out}: expected a name that ends in .glb or .btf, or of a BTF table or a model a folder")
    _refuse_to_replace(out, force)
    with _progress() as report:
        if maps:
            textures.write(file, out, report)
        elif not one_file:
            job.to_exr_stack(file, out, report)
        elif out.lower().endswith(".btf"):
            job.to_bonn(file, out, method=method, rank=rank, report=report)
        else:
            job.to_glb(file, out)
    click.echo(out)


@main.command()
@click.argument("a")
@click.argument("b")
@click.option("--out", help="Picture (.png): of two pictures four times their difference, of BTFs PSNR by direction.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")
def compare(a: str, b: str, out: str | None, as_json: bool) -> None:
    """Compare picture B with its reference A: PSNR, SSIM, FLIP, largest error; or model B with its table A."""
    from dataclasses import asdict

    from torchmeso import quality
    from torchmeso.data import image
    from torchmeso.pipeline import directional_error, gdm_difference

    if gdm_difference.is_gdm(a):
        _compare_gdm(a, b, out, as_json)
        return
    if directional_error.is_btf(a):
        _compare_btf(a, b, out, as_json)
        return
    reference, picture = image.read(a), image.read(b)
    found = quality.compare(reference, picture)
    if out is not None:
        image.write_png(out, image.to_linear(quality.difference(reference, picture)))
    if as_json:
        click.echo(json.dumps(asdict(found)))
        return
    flip = "flip not installed" if found.flip is None else f"FLIP {found.flip:.4f}"
    click.echo(f"PSNR {found.psnr:.2f} dB  SSIM {found.ssim:.4f}  {flip}  max error {found.max_error:.4g}")


def _compare_gdm(a: str, b: str, out: str | None, as_json: bool) -> None:
    from dataclasses import asdict

    from torchmeso.pipeline import gdm_difference

    if out is not None:
        raise ConfigError("compare: --out draws the difference of pictures and BTFs; a GDM has none")
    found = gdm_difference.compare(a, b)
    click.echo(
        json.dumps(asdict(found))
        if as_json
        else f"hit or miss wrong {100 * found.wrong:.2f} %  RMS {found.rms:.3f} voxels  95 % within {found.p95:.3f}  "
        f"max error {found.max_error:.3g}"
    )


def _compare_btf(a: str, b: str, out: str | None, as_json: bool) -> None:
    from torchmeso.geometry import gaps
    from torchmeso.pipeline import directional_error

    with _progress() as report:
        found = directional_error.compare(a, b, report)
    if out is not None:
        directional_error.draw(found, out)
    sides = {"light": (found.lights, found.over_lights), "view": (found.views, found.over_views)}
    if as_json:
        lists = {f"over_{side}s": psnr.tolist() for side, (_, psnr) in sides.items()}
        click.echo(json.dumps({"psnr": found.whole, "max_error": found.max_error, **lists}))
        return
    worst = [
        "worst {} {:.2f} dB at theta {:g}, phi {:g}".format(
            side, float(psnr.min()), *gaps.angles_deg(directions)[int(psnr.argmin())]
        )
        for side, (directions, psnr) in sides.items()
    ]
    click.echo(f"PSNR {found.whole:.2f} dB  {'  '.join(worst)}  max error {found.max_error:.4g}")


@main.command()
@click.argument(
    "suite", type=click.Choice(["compress", "gdm", "light", "render", "skip", "stability", "synthesize", "tables"])
)
@click.option("--quick", is_flag=True, help="Fewer repetitions and sweep points; never smaller sizes.")
@click.option("--prepare", is_flag=True, help="Only bake what the suite needs into the cache.")
@click.option("--only", multiple=True, help="Rows whose id begins with this; may be repeated.")
@click.option("--json", "json_path", help="Write all rows to this file.")
@click.option("--plot", "plot_path", help="Draw the curves into this picture (.png, .svg).")
def bench(suite: str, quick: bool, prepare: bool, only: tuple[str, ...], json_path: str | None, plot_path: Any) -> None:
    """Measure SUITE: accuracy against truth, time against peers in the same run."""
    from torchmeso.bench import colour, compress, frames, gdm, light, plot, render, skips, stability, tables
    from torchmeso.bench import suite as suites
    from torchmeso.bench import synthesize as synthesis

    measurements = {
        "compress": compress.MEASUREMENTS,
        "gdm": gdm.MEASUREMENTS,
        "light": light.MEASUREMENTS,
        "render": render.MEASUREMENTS,
        "skip": skips.MEASUREMENTS,
        "stability": stability.MEASUREMENTS,
        "synthesize": synthesis.MEASUREMENTS,
        "tables": tables.MEASUREMENTS,
    }

    with _progress() as report:
        context = suites.Context(quick=quick, report=report)
        if prepare:
            if suite == "render":
                colour.prepare(context)
            frames.prepare_all(report)
            return
        rows = suites.run(measurements[suite], context, only)
    for row in rows:
        value = f"not measured ({row.why})" if row.value is None else f"{row.value:g} {row.unit}"
        goal = "" if row.goal is None else f"  goal {'>=' if row.better == 'higher' else '<='} {row.goal:g}"
        verdict = {True: "  met", False: "  MISSED", None: ""}[row.met]
        click.echo(f"{row.id}: {value}{goal}{verdict}" + (f"  [{row.peer}]" if row.peer else ""))
    if json_path is not None:
        suites.write_json(json_path, suites.to_json(suite, rows, suites.describe_device()))
    if plot_path is not None:
        plot.draw(rows, plot_path)


@main.command()
@click.argument("file", required=False)
@click.option("--device", is_flag=True, help="List the OpenCL devices and test the chosen one.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON for machines.")
def info(file: str | None, device: bool, as_json: bool) -> None:
    """Tell what is in FILE, or which OpenCL device runs the kernels (--device)."""
    if device == (file is not None):
        raise click.UsageError("give a FILE or --device")
    if device:
        _info_device(as_json)
    else:
        from torchmeso.pipeline import describe

        about = describe.file(str(file))
        click.echo(json.dumps(about) if as_json else "\n".join(f"{k}: {v}" for k, v in about.items()))


def _info_device(as_json: bool) -> None:
    from dataclasses import asdict

    from torchmeso.backends import opencl
    from torchmeso.errors import human_size

    devices = opencl.list_devices()
    if as_json:
        click.echo(json.dumps([asdict(d) for d in devices]))
        return
    if not devices:
        click.echo("no OpenCL platform: everything runs on torch; pip install 'pyopencl[pocl]' adds one")
        return
    for d in devices:
        size = human_size(d.global_bytes)
        click.echo(f"{'*' if d.chosen else ' '} {d.device}  {d.compute_units} units  {size}  {d.version}")
    error = opencl.self_test()
    click.echo(f"self-test: {'exact' if error == 0 else f'off by {error:g}'}")


if __name__ == "__main__":
    sys.exit(main())
