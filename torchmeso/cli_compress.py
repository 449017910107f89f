"""The command `compress`: tables in, run-time models out. Heavy imports stay inside the functions (torch costs 2 s).

Test: tests/test_cli.py
"""

from dataclasses import fields, replace
from functools import partial
from typing import Any

import click

from torchmeso.console import progress, refuse_to_replace
from torchmeso.errors import ConfigError


@click.command()
@click.argument("table")
@click.option(
    "--method",
    default="eigen",
    type=click.Choice(["eigen", "double-sh", "sh-pca", "transform", "factored", "ptm", "hsh", "svd", "coded"]),
    show_default=True,
    help="Kind of model; transform: the smallest file, to --psnr or --size; factored: as Bonn's DFMF; "
    "ptm and hsh: of an RTI set (.lp); svd, coded: of a GDM (.gdm.zarr), by factors or by an exact code.",
)
@click.option("--psnr", type=float, help="eigen, double-sh, transform: least PSNR of the values of T, in dB.")
@click.option("--size", help="The same, and svd: most bytes of the file without an MDF: 4MB, 300kB, 65536.")
@click.option(
    "--error",
    type=float,
    help="svd: most voxels that 95 % of the hits are off by, in place of a rank; coded: that any is [0].",
)
@click.option(
    "--fill",
    type=click.Choice(["hits", "boundary"]),
    help="svd: fit what hits alone [hits], or the way out of the slab where a ray leaves as wang2004gdm does.",
)
@click.option(
    "--rank",
    type=int,
    help="eigen: components kept, at most the number of views [4]; sh-pca, factored, svd [16]; "
    "the most for a budget [all].",
)
@click.option(
    "--light-terms",
    type=int,
    help="double-sh, sh-pca: coefficients over the light: 1, 4, 9, 16, 25, 36 [25]; the most for a budget [36].",
)
@click.option("--view-terms", type=int, help="double-sh: coefficients over the view [25]; the most for a budget [36].")
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
@click.option(
    "--colour",
    type=click.Choice(["rgb", "yuv", "log-y"]),
    help="factored: what has factors of its own; log-y: log Y, U/Y and V/Y [rgb].",
)
@click.option("--terms", type=int, help="hsh: 4, 9 or 16 [9].")
@click.option("--per-channel", is_flag=True, help="ptm: a polynomial for each channel instead of one and a colour.")
@click.option(
    "--storage",
    default="uint8",
    show_default=True,
    type=click.Choice(["uint8", "float16", "float32", "adaptive"]),
    help="Of maps; adaptive (eigen, double-sh): bytes with steps that follow their variance, entropy-coded.",
)
@click.option("--mdf", "silhouette", help="MDF table (.mdf.zarr) to pack into the model.")
@click.option("--allow-missing", is_flag=True, help="Interpolate pictures that a folder or zip lacks.")
@click.option("--out", required=True, help="The run-time model (.meso; of a GDM .gdm.meso); of ptm .ptm, of hsh .rti.")
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
    """Compress a BTF or GDM TABLE into a small model.

    A BTF is a .btf.zarr or .btf, a folder or zip of pictures, or an RTI set (.lp); a GDM is a .gdm.zarr.
    """
    from torchmeso.backends.allocator import give_back_freed_memory
    from torchmeso.compress import budget_stream, stream
    from torchmeso.compress.eigen import EigenOptions
    from torchmeso.data import journal, mdf
    from torchmeso.pipeline import picture_sets
    from torchmeso.pipeline.bake import code_hash

    if method in ("ptm", "hsh"):
        _relight(table, method, out, force, {**options, "unbounded": unbounded})
        return
    if method in ("svd", "coded"):
        _gdm(table, method, out, force, {**options, "unbounded": unbounded, "mdf": silhouette})
        return
    if not out.endswith(".meso"):
        raise ConfigError(f"{out}: expected a name that ends in .meso")
    refuse_to_replace(out, force)
    depth = None if silhouette is None else mdf.load(silhouette)
    chosen, wanted = _asked(method, unbounded, options)
    with progress() as report:
        source = picture_sets.open_btf(table, report, allow_missing=allow_missing)
        told = partial(report, f"{method} BTF")
        key = f"{journal.state_of(table)} {code_hash()}"
        if wanted is not None:
            give_back_freed_memory()
            if isinstance(chosen, EigenOptions):
                chosen = replace(chosen, rank=options["rank"] or len(source.views))
            found = budget_stream.fit(source, chosen, wanted, out, key=key, silhouette=depth, progress=told)
            said = f"{out}  PSNR {found:.1f} dB  {_kept(out)}"
        else:
            stream.fit(source, chosen, out, key=key, silhouette=depth, progress=told)
            said = f"{out}  {_kept(out)}" if method == "factored" else out
    click.echo(said)


def _asked(method: str, unbounded: bool, options: dict[str, Any]) -> tuple[Any, Any]:
    """Return the options of the method, and the budget where one is given."""
    from torchmeso.compress import budget, double_sh, eigen, factored, sh_pca, transform

    given = {name: value for name, value in options.items() if value is not None and value is not False}
    kinds: dict[str, Any] = {
        "eigen": eigen.EigenOptions,
        "double-sh": double_sh.DoubleShOptions,
        "sh-pca": sh_pca.ShPcaOptions,
        "transform": transform.TransformOptions,
        "factored": factored.FactoredOptions,
    }
    known = {field.name for field in fields(kinds[method])}
    if method in ("transform", "factored") and given["storage"] == "uint8":
        del given["storage"]  # the default of the others
    limits = {"psnr", "size"} if method in ("eigen", "double-sh", "transform") else set()
    if (wrong := sorted(set(given) - known - limits)) or (unbounded and method != "double-sh"):
        raise ConfigError(f"compress: --method {method} has no --{(wrong or ['unbounded'])[0].replace('_', '-')}")
    if unbounded:
        given["energy"] = None
    if "size" in given:
        given["size"] = budget.parse_size(given["size"])
    limited = {name: given.pop(name) for name in limits & set(given)}
    if not limited and method != "transform":
        return kinds[method](**given), None
    most = {"light_terms": 36, "view_terms": 36} if method == "double-sh" else {}
    return kinds[method](**{**most, **given}), budget.Budget(**limited)


def _kept(out: str) -> str:
    """Return what a fit made of itself, in words."""
    from torchmeso.data import store
    from torchmeso.geometry import hemisphere

    meta = store.Model(out).meta
    if "sh" in meta:
        return "{} x {} coefficients of light and view".format(*meta["sh"]["terms"])
    if "factored" in meta:
        return f"opens as an eigen BTF of rank {meta['factored']['opened_rank']}"
    about = meta.get("transform") or meta["eigen"]
    of, views = f"of {len(hemisphere.parse(about['views']))}", about["rank"]
    return f"{views} {of} view components" if "transform" in meta else f"rank {views} {of}"


def _relight(lights: str, method: Any, out: str, force: bool, options: dict[str, Any]) -> None:
    from torchmeso.pipeline import relight

    own = {"terms", "per_channel", "storage"}  # storage has a default: it was not asked for
    wrong = sorted(name for name, value in options.items() if name not in own and value not in (None, False))
    if wrong:
        raise ConfigError(f"compress: --method {method} has no --{wrong[0].replace('_', '-')}")
    refuse_to_replace(out, force)
    relight.fit(lights, out, method=method, terms=options["terms"], per_channel=options["per_channel"])
    click.echo(out)


def _gdm(table: str, method: str, out: str, force: bool, options: dict[str, Any]) -> None:
    """Write a factored or a coded GDM, and say what it is."""
    from torchmeso.compress import gdm_svd as fits
    from torchmeso.compress.budget import parse_size
    from torchmeso.data import gdm, gdm_coded, gdm_svd

    own = {"storage", "error"} | ({"rank", "size", "fill"} if method == "svd" else set())  # storage has a default
    given = {name: value for name, value in options.items() if value not in (None, False)}
    if wrong := sorted(set(given) - own):
        raise ConfigError(f"compress: --method {method} has no --{wrong[0].replace('_', '-')}")
    if not out.endswith(".gdm.meso"):
        raise ConfigError(f"{out}: expected a name that ends in .gdm.meso, which is how configurations know a GDM")
    if len(set(given) & {"rank", "size", "error"}) > 1:
        raise ConfigError("compress: expected one of --rank, --size and --error")
    refuse_to_replace(out, force)
    source = gdm.load(table)
    if method == "coded":
        gdm_coded.save(source, out, within=given.get("error", 0.0))
        click.echo(out)
        return
    fill = given.get("fill", "hits")
    with progress() as report:
        told = partial(report, "GDM")
        if "size" in given or "error" in given:
            size = parse_size(given["size"]) if "size" in given else None
            found = fits.fit_to(source, size=size, within=given.get("error"), fill=fill, progress=told)
        else:
            found = fits.fit(source, fits.GdmSvdOptions(rank=given.get("rank", 16), fill=fill), progress=told)
    off = fits.error(source, found)
    gdm_svd.save(found, out, error=round(off, 3))
    click.echo(f"{out}  rank {found.rank}  95 % of the hits within {off:.2f} voxels")
