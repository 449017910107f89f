"""What a rig's controller is told and what it answers: GRBL 1.1 and Marlin, as text.

Axes are X, Y and Z in degrees: turntable, light arc, laser tilt. GRBL (grblHAL) checks nothing that it is sent; Marlin
takes numbered lines with a checksum.

Test: tests/capture/test_dialects.py
"""

import re
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, runtime_checkable

AXES = "XYZ"

FIRST_PORT = 10
"""Digital output of the first lamp. Of two digits: where one is lost or doubled, no lamp has the number."""

MOST_LAMPS = 90

POWER = 1000
"""What S is for the laser's full power."""


class Pose(NamedTuple):
    """Where a rig stands, degrees."""

    turntable: float
    arc: float
    tilt: float


Kind = Literal["ok", "error", "alarm", "report", "resend", "started", "busy", "other"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Reply:
    """A line from a controller.

    Attributes:
        kind: "other": a message, or a line that was damaged on its way.
        text: the line.
        number: of an error or alarm; the line that is asked for again.
        still: of a report: whether nothing moves.
        pose: of a report.
        laser: of a report: the laser's power, 0 to 1; None where it does not tell.
    """

    kind: Kind
    text: str
    number: int = 0
    still: bool = True
    pose: Pose | None = None
    laser: float | None = None


@runtime_checkable
class Dialect(Protocol):
    """How a controller is spoken to. Commands are lines without their end; all can be said twice."""

    @property
    def numbered(self) -> bool:
        """Whether lines carry a number and a checksum."""
        ...

    @property
    def reset(self) -> bytes:
        """What ends motion and switches all outputs off, at once and whatever was being said."""
        ...

    def unlock(self) -> tuple[str, ...]:
        """Return what lets commands pass after an alarm."""
        ...

    def home(self) -> tuple[str, ...]:
        """Return what finds the axes' zeros."""
        ...

    def move(self, pose: Pose) -> tuple[str, ...]:
        """Return what goes to a pose; rounded to thousandths."""
        ...

    def laser(self, power: float) -> tuple[str, ...]:
        """Return what sets the laser, 0 = off to 1."""
        ...

    def lamp(self, number: int, on: bool) -> tuple[str, ...]:
        """Return what switches a lamp, counted from 0."""
        ...

    def ask(self) -> str:
        """Return what asks for a report; GRBL takes it in the middle of anything."""
        ...

    def parse(self, line: str) -> Reply:
        """Return what a line says."""
        ...


GRBL_REPORT = re.compile(
    r"<(\w+)(?::\d)?\|MPos:(-?\d{1,4}\.\d{3}),(-?\d{1,4}\.\d{3}),(-?\d{1,4}\.\d{3})((?:\|[^|<>]+)*)>"
)


class Grbl:
    """GRBL 1.1 with lamps on the digital outputs that grblHAL and FluidNC have."""

    numbered = False
    reset = b"!\x18"

    def unlock(self) -> tuple[str, ...]:  # noqa: D102
        return ("$X",)

    def home(self) -> tuple[str, ...]:  # noqa: D102
        return ("$H",)

    def move(self, pose: Pose) -> tuple[str, ...]:  # noqa: D102
        return ("G90G0" + "".join(f"{a}{x:.3f}" for a, x in zip(AXES, pose, strict=True)),)

    def laser(self, power: float) -> tuple[str, ...]:  # noqa: D102
        return ("M5",) if power == 0 else (f"M3S{round(power * POWER)}",)

    def lamp(self, number: int, on: bool) -> tuple[str, ...]:  # noqa: D102
        return (f"M{64 if on else 65}P{FIRST_PORT + number}",)

    def ask(self) -> str:  # noqa: D102
        return "?"

    def parse(self, line: str) -> Reply:  # noqa: D102
        text = line.strip()
        if text == "ok":
            return Reply(kind="ok", text=text)
        if found := re.fullmatch(r"(error|ALARM):(\d+)", text):
            return Reply(kind="error" if found[1] == "error" else "alarm", text=text, number=int(found[2]))
        if text.startswith("Grbl"):
            return Reply(kind="started", text=text)
        if found := GRBL_REPORT.fullmatch(text):
            power = re.search(r"\|FS:\d+,(\d+)(?:\||$)", found[5])
            return Reply(
                kind="alarm" if found[1] == "Alarm" else "report", text=text, still=found[1] == "Idle",
                pose=Pose(*(float(found[k]) for k in (2, 3, 4))), laser=int(power[1]) / POWER if power else None,
            )  # fmt: skip
        return Reply(kind="other", text=text)


MARLIN_REPORT = re.compile(r"X:(-?\d+\.\d\d) ?Y:(-?\d+\.\d\d) ?Z:(-?\d+\.\d\d)(?: .*)?")


class Marlin:
    """Marlin 2: numbered lines with a checksum, lamps on pins."""

    numbered = True
    reset = b"\nM410\nM5\n"

    def unlock(self) -> tuple[str, ...]:  # noqa: D102
        return ("M999",)

    def home(self) -> tuple[str, ...]:  # noqa: D102
        return ("G28", "M400")

    def move(self, pose: Pose) -> tuple[str, ...]:  # noqa: D102
        return ("G90", "G0 " + " ".join(f"{a}{x:.3f}" for a, x in zip(AXES, pose, strict=True)), "M400")

    def laser(self, power: float) -> tuple[str, ...]:  # noqa: D102
        return ("M5",) if power == 0 else (f"M3 S{round(power * POWER)}",)

    def lamp(self, number: int, on: bool) -> tuple[str, ...]:  # noqa: D102
        return (f"M42 P{FIRST_PORT + number} S{255 if on else 0}",)

    def ask(self) -> str:  # noqa: D102
        return "M114"

    def parse(self, line: str) -> Reply:  # noqa: D102
        text = line.strip()
        if text == "ok" or text.startswith("ok "):
            return Reply(kind="ok", text=text)
        if found := re.fullmatch(r"(?:Resend|rs):? ?(\d+)", text):
            return Reply(kind="resend", text=text, number=int(found[1]))
        if text.startswith("Error:"):
            return Reply(kind="error", text=text)
        if text == "start":
            return Reply(kind="started", text=text)
        if text.startswith("echo:busy"):
            return Reply(kind="busy", text=text)
        if found := MARLIN_REPORT.fullmatch(text):
            return Reply(kind="report", text=text, pose=Pose(*(float(found[k]) for k in (1, 2, 3))))
        return Reply(kind="other", text=text)


def dialect(name: Literal["grbl", "marlin"]) -> Dialect:
    """Return a dialect by its name."""
    return Grbl() if name == "grbl" else Marlin()


def number_line(number: int, line: str) -> str:
    """Return a line as Marlin checks it: the checksum is the exclusive or of all bytes before the star."""
    told = f"N{number} {line}"
    return f"{told}*{checksum(told)}"


def checksum(text: str) -> int:
    """Return the exclusive or of all bytes."""
    found = 0
    for byte in text.encode("ascii", "replace"):
        found ^= byte
    return found
