"""The command line: one thin function per job. Heavy imports stay inside the functions (torch costs 2 s).

Results go to stdout, one line per product; progress and warnings to stderr. A MesoError becomes one sentence
and exit status 2; a bug keeps its traceback.

Test: tests/test_cli.py
"""

import json
import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from functools import partial
from typing import Any

import click

from torchmeso.backends.allocator import keep_freed_memory
from torchmeso.errors import ConfigError, MesoError, StorageError

MESOS = "sheet, groove, spheres, brick, blocks, grid, weave, pipes, chain, grass, squama, peanut, bark"
"""The built-in mesostructures, said here so that help does not wait for torch."""


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
@click.option("--meso", help=f"Mesostructure to bake alone: {MESOS}.")
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
    tile = config.build_meso({"type": meso})
    about: dict[str, object] = {"source": {"type": meso}}
    _refuse_to_replace(out, force)
    with _progress() as report:
        job(tile, dials(**options), out, about=about, progress=lambda x: report(f"{meso}: {kind}", x))
    click.echo(out)


@main.command()
@click.argument("table")
@click.option(
    "--method",
    default="eigen",
    type=click.Choice(["eigen", "double-sh", "sh-pca", "transform", "ptm", "hsh"]),
    show_default=True,
    help="Kind of model; transform: the smallest file, to --psnr or --size; ptm and hsh: of an RTI set (.lp).",
)
@click.option("--psnr", type=float, help="transform: least PSNR of the values of T, in dB.")
@click.option("--size", help="transform: most bytes of the file without an MDF: 4MB, 300kB, 65536.")
@click.option(
    "--rank", type=int, help="eigen: components kept, at most the number of views [4]; sh-pca [16]; transform [all]."
)
@click.option(
    "--light-terms", type=int, help="double-sh, sh-pca: coefficients over the light: 1, 4, 9, 16, 25, 36 [25]."
)
@click.option("--view-terms", type=int, help="double-sh: coefficients over the view [25].")
@click.option(
    "--energy", type=float, help="double-sh: bound of the coefficients' energy, of what the samples show [1]."
)
@click.option("--unbounded", is_flag=True, help="double-sh: plain least squares.")
@click.option("--regularise", is_flag=True, help="double-sh, sh-pca: more coefficients than the directions tell apart.")
@click.option(
    "--domain",
    type=click.Choice(["hemisphere_fit", "sphere_projection"]),
    help="sh-pca: least squares at the lights, or the projection of a cube map [hemisphere_fit].",
)
@click.option("--ridge", type=float, help="sh-pca: how much small coefficients count beside small errors [1e-4].")
@click.option("--training", type=int, help="sh-pca: vectors to find the components from, drawn at random [all].")
@click.option("--terms", type=int, help="hsh: 4, 9 or 16 [9].")
@click.option("--per-channel", is_flag=True, help="ptm: a polynomial for each channel instead of one and a colour.")
@click.option(
    "--storage", default="uint8", show_default=True, type=click.Choice(["uint8", "float16", "float32"]), help="Of maps."
)
@click.option("--mdf", "silhouette", help="MDF table (.mdf.zarr) to pack into the model.")
@click.option("--allow-missing", is_flag=True, help="Interpolate pictures that a folder or zip lacks.")
@click.option("--out", required=True, help="The run-time model (.meso); of ptm .ptm, of hsh .rti.")
@click.option("--force", is_flag=True, help="Replace an existing model.")
def compress(
    table: str,
    method: str,
    unbounded: bool,
    silhouette: str | None,
    allow_missing: bool,
    out: str,
    force: bool,
    **options: Any,
) -> None:
    """Compress a BTF TABLE (.btf.zarr or .btf, a folder or zip of pictures, or an RTI set .lp) into a small model."""
    from torchmeso.compress import double_sh, eigen, sh_pca, stream, transform
    from torchmeso.data import journal, mdf, transform_btf
    from torchmeso.pipeline import picture_sets
    from torchmeso.pipeline.bake import code_hash

    if method in ("ptm", "hsh"):
        _relight(table, method, out, force, options)
        return
    if not out.endswith(".meso"):
        raise ConfigError(f"{out}: expected a name that ends in .meso")
    _refuse_to_replace(out, force)
    depth = None if silhouette is None else mdf.load(silhouette)
    given = {name: value for name, value in options.items() if value is not None and value is not False}
    kinds: dict[str, Any] = {
        "eigen": eigen.EigenOptions,
        "double-sh": double_sh.DoubleShOptions,
        "sh-pca": sh_pca.ShPcaOptions,
        "transform": transform.TransformOptions,
    }
    known = {field.name for field in fields(kinds[method])}
    if method == "transform" and given["storage"] == "uint8":
        del given["storage"]  # the default of the others
    if (wrong := sorted(set(given) - known)) or (unbounded and method != "double-sh"):
        raise ConfigError(f"compress: --method {method} has no --{(wrong or ['unbounded'])[0].replace('_', '-')}")
    if unbounded:
        given["energy"] = None
    if "size" in given:
        given["size"] = transform.parse_size(given["size"])
    chosen = kinds[method](**given)
    said = out
    with _progress() as report:
        source = picture_sets.open_btf(table, report, allow_missing=allow_missing)
        told = partial(report, f"{method} BTF")
        if isinstance(chosen, transform.TransformOptions):
            packed, found = transform.fit(source, chosen, progress=told)
            transform_btf.save(packed, out, silhouette=depth, psnr=round(found, 2))
            said = f"{out}  PSNR {found:.1f} dB  {len(packed.codes)} of {len(packed.views)} view components"
        else:
            key = f"{journal.state_of(table)} {code_hash()}"
            stream.fit(source, chosen, out, key=key, silhouette=depth, progress=told)
    click.echo(said)


def _relight(lights: str, method: Any, out: str, force: bool, options: dict[str, Any]) -> None:
    from torchmeso.pipeline import relight

    own = {"terms", "per_channel", "storage"}  # storage has a default: it was not asked for
    wrong = sorted(name for name, value in options.items() if name not in own and value not in (None, False))
    if wrong:
        raise ConfigError(f"compress: --method {method} has no --{wrong[0].replace('_', '-')}")
    _refuse_to_replace(out, force)
    relight.fit(lights, out, method=method, terms=options["terms"], per_channel=options["per_channel"])
    click.echo(out)


@main.command()
@click.argument("configuration")
@click.option("--silhouette", type=click.Choice(["none", "paper", "curved"]), help="Overrides the configuration.")
@click.option("--backend", type=click.Choice(["auto", "torch", "opencl"]), help="Overrides the configuration [auto].")
@click.option("--frames", type=int, help="Frames of one whole turn, to .png (a sequence), .gif or .mp4.")
@click.option(
    "--path",
    "way",
    type=click.Choice(["turntable", "light"]),
    default="turntable",
    show_default=True,
    help="With --frames, what turns: the camera around the subject, or the lights.",
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
    """Compare picture B with its reference A: PSNR, SSIM, FLIP, largest error; or BTF model B with its table A."""
    from dataclasses import asdict

    from torchmeso import quality
    from torchmeso.data import image
    from torchmeso.pipeline import directional_error

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
@click.argument("suite", type=click.Choice(["compress", "gdm", "render", "skip", "stability", "tables"]))
@click.option("--quick", is_flag=True, help="Fewer repetitions and sweep points; never smaller sizes.")
@click.option("--prepare", is_flag=True, help="Only bake what the suite needs into the cache.")
@click.option("--only", multiple=True, help="Rows whose id begins with this; may be repeated.")
@click.option("--json", "json_path", help="Write all rows to this file.")
@click.option("--plot", "plot_path", help="Draw the curves into this picture (.png, .svg).")
def bench(suite: str, quick: bool, prepare: bool, only: tuple[str, ...], json_path: str | None, plot_path: Any) -> None:
    """Measure SUITE: accuracy against truth, time against peers in the same run."""
    from torchmeso.bench import colour, compress, frames, gdm, plot, render, skips, stability, tables
    from torchmeso.bench import suite as suites

    measurements = {
        "compress": compress.MEASUREMENTS,
        "gdm": gdm.MEASUREMENTS,
        "render": render.MEASUREMENTS,
        "skip": skips.MEASUREMENTS,
        "stability": stability.MEASUREMENTS,
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


def _refuse_to_replace(path: Any, force: bool) -> None:
    from pathlib import Path

    if Path(path).exists() and not force:
        raise ConfigError(f"{path}: exists already; give --force to replace it")


@contextmanager
def _progress() -> Iterator[Any]:
    """Yield a report function that draws progress bars on stderr; quiet when stderr is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        tasks: dict[str, Any] = {}

        def report(what: str, share: float) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=1.0)
            bars.update(tasks[what], completed=share)

        yield report


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
