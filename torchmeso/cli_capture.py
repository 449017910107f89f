"""The command `rig`: a capture rig by hand.

Heavy imports stay inside the functions.

Tests: tests/capture/test_cli_capture.py
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from torchmeso.errors import ConfigError

if TYPE_CHECKING:
    from torchmeso.capture.rig import Rig

VIRTUAL = "virtual"
"""In place of a port: a controller that is not there, started for the command."""


@click.group()
def rig() -> None:
    """Drive a capture rig by hand: turntable, light arc and laser tilt in degrees, lamps, laser."""


def _reached(command: Any) -> Any:
    """Add the options that say how a rig is reached."""
    for option in (
        click.option("--lamps", default=8, show_default=True, help="Number of lamps."),
        click.option("--baud", default=115200, show_default=True, help="Of the line."),
        click.option("--dialect", type=click.Choice(["grbl", "marlin"]), default="grbl", show_default=True,
                     help="What the controller speaks."),
        click.option("--port", required=True, help="Name, pattern or serial number; 'virtual': one that is not there."),
    ):  # fmt: skip
        command = option(command)
    return command


@contextmanager
def _opened(port: str, **options: Any) -> "Iterator[Rig]":
    from contextlib import ExitStack

    from torchmeso.capture import virtual
    from torchmeso.capture.rig import Rig, RigOptions

    with ExitStack() as stack:
        if port == VIRTUAL:
            port = stack.enter_context(virtual.running(virtual.VirtualOptions(dialect=options["dialect"]))).port
        yield stack.enter_context(Rig.open(RigOptions(port=port, **options)))


@rig.command("list")
def list_() -> None:
    """List the serial ports of this machine: name, what it is, serial number."""
    from torchmeso.capture.link import ports

    for port in ports():
        click.echo("\t".join(port).rstrip())


@rig.command()
@_reached
def home(**options: Any) -> None:
    """Let all axes find their zeros."""
    with _opened(**options) as opened:
        opened.home()
        click.echo(_told(opened))


@rig.command()
@_reached
@click.option("--turntable", type=float, help="Degrees; an axis that is not named stays.")
@click.option("--arc", type=float, help="Degrees of the light arc.")
@click.option("--tilt", type=float, help="Degrees of the laser.")
@click.option("--home/--no-home", "homes", default=False, help="Find the zeros first.")
def jog(turntable: float | None, arc: float | None, tilt: float | None, homes: bool, **options: Any) -> None:
    """Go to a pose, say where the rig stands, and leave lamps and laser off."""
    wanted = {"turntable": turntable, "arc": arc, "tilt": tilt}
    if all(x is None for x in wanted.values()):
        raise ConfigError("rig jog: expected --turntable, --arc or --tilt, got none of them")
    with _opened(**options) as opened:
        if homes:
            opened.home()
        opened.move(opened.pose()._replace(**{name: x for name, x in wanted.items() if x is not None}))
        click.echo(_told(opened))


@rig.command()
@_reached
def test(**options: Any) -> None:
    """Home, move each axis and come back, switch each lamp and the laser on and off; say how long it took."""
    import time

    from torchmeso.capture.dialects import Pose

    def timed(what: str, *calls: Any) -> None:
        start = time.perf_counter()
        for call, *arguments in calls:
            call(*arguments)
        click.echo(f"{what}: {time.perf_counter() - start:.2f} s")

    with _opened(**options) as opened:
        zero = Pose(0.0, 0.0, 0.0)
        timed("home", (opened.home,))
        for name in Pose._fields:
            timed(f"{name} to 5 degrees and back", *((opened.move, zero._replace(**{name: x})) for x in (5.0, 0.0)))
        for lamp in range(options["lamps"]):
            timed(f"lamp {lamp} on and off", (opened.lamp, lamp, True), (opened.lamp, lamp, False))
        timed("laser on and off", (opened.laser, 0.1), (opened.laser, 0.0))
        click.echo(_told(opened))


def _told(opened: "Rig") -> str:
    return " ".join(f"{name} {x:.3f}" for name, x in opened.pose()._asdict().items())
