"""The command line: one thin function per job. Heavy imports stay inside the functions (torch costs 2 s).

Results go to stdout, one line per product; progress and warnings to stderr. A MesoError becomes one sentence
and exit status 2; a bug keeps its traceback.

Test: tests/test_cli.py
"""

import json
import sys
from typing import Any

import click

from torchmeso.errors import MesoError


class _Group(click.Group):
    """A click group that prints our errors as one sentence and leaves with status 2."""

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except MesoError as error:
            if ctx.params.get("debug"):
                raise
            click.echo(f"{ctx.info_name} {ctx.invoked_subcommand}: error: {error}", err=True)
            ctx.exit(2)


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.option("--debug", is_flag=True, help="Show the traceback of user errors too.")
@click.version_option(package_name="torchmeso")
def main(debug: bool) -> None:
    """Meso-scale appearance on a CPU, from a mesostructure to a picture with its silhouette and its shadow."""


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
