"""The line to a controller: what is said arrives, or is said again.

A serial line loses and doubles bytes both ways. GRBL answers lines in their order, but for a report, which comes at
once: what was said before it has been answered by then. Marlin counts its lines and asks for those that it lacks.

Test: tests/capture/test_rig.py
"""

import contextlib
import fnmatch
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import serial
from serial.tools import list_ports

from torchmeso.capture import dialects
from torchmeso.capture.dialects import Dialect, Reply
from torchmeso.errors import RigError

KEPT = 64
"""Numbered lines that are kept to be said again."""

STUCK = 5.0
"""Seconds after which a port that takes no bytes is given up."""


def ports() -> list[tuple[str, str, str]]:
    """Return the serial ports of this machine: name, what it is, serial number."""
    return [(p.device, p.description or "", p.serial_number or "") for p in sorted(list_ports.comports())]


def find_port(wanted: str) -> str:
    """Return the name of the one port that `wanted` names: its name, a pattern, or a serial number.

    Raises:
        RigError: none does, or several do.
    """
    known = ports()
    by_number = [name for name, _, number in known if number and number == wanted]
    by_pattern = [name for name, _, _ in known if fnmatch.fnmatch(name, wanted)]
    found = by_number or by_pattern
    if len(found) > 1:
        raise RigError(f"rig: expected one port, got {', '.join(found)} for {wanted}; name one of them")
    if found:
        return found[0]
    if any(c in wanted for c in "*?[") or not wanted.startswith(("/", "COM")):
        listed = ", ".join(name for name, _, _ in known) or "none"
        raise RigError(f"rig: no port is {wanted}; ports of this machine: {listed}. Is the rig connected and on?")
    return wanted


@dataclass(eq=False, slots=True)
class Link:
    """An open port to a controller.

    Attributes:
        port: the open port.
        speech: what is spoken there.
        answer: seconds until an answer is given up.
        patience: seconds that a busy controller is waited for.
        tries: times that something is said before it is given up.
        number: of the last numbered line.
        said: the last numbered lines.
        came: bytes of a line that is not whole.
    """

    port: serial.Serial
    speech: Dialect
    answer: float
    patience: float
    tries: int
    number: int = 0
    said: dict[int, str] = field(default_factory=dict)
    came: bytearray = field(default_factory=bytearray)

    def close(self) -> None:
        """Let other programs have the port."""
        self.port.close()

    def say(self, line: str, seconds: float) -> Reply | None:
        """Say a line once (numbered lines until they arrive), and return its answer: ok, error or alarm; else None."""
        if self.speech.numbered:
            return self._numbered(line, seconds)
        self.report()  # what was said to earlier lines has come when the report has
        self._drain()
        self.write(line.encode() + b"\n")
        return self._await(lambda r: r.kind in ("ok", "error", "alarm"), seconds)

    def _numbered(self, line: str, seconds: float) -> Reply | None:
        """Say a numbered line until it arrived once.

        An ok has no number, and may be a late one to an earlier line: then that line is asked for by its number when
        the next one comes, and is said again.
        """
        self.number += 1
        self.said[self.number] = line
        self.said.pop(self.number - KEPT, None)
        at = self.number
        for _ in range(2 * self.tries):
            self._drain()
            self.write(b"\n" + dialects.number_line(at, self.said[at]).encode() + b"\n")
            answer = self._await(lambda r: r.kind in ("ok", "error", "resend", "report"), seconds)
            if answer is None:  # the line or its answer is lost: the controller will say which
                continue
            if answer.kind == "report":  # its own ok must not be taken for that of the next line
                self._await(lambda r: r.kind == "ok", 0.2)
            if answer.kind in ("ok", "report"):
                if at == self.number:
                    return answer
                at += 1
                continue
            again = self._await(lambda r: r.kind == "resend", 0.2) if answer.kind == "error" else answer
            if again is not None and again.number == self.number + 1:
                return Reply(kind="ok", text="it had arrived before")
            if again is not None and again.number in self.said:
                at = again.number
            elif again is not None:
                self.write(b"\n" + dialects.number_line(at - 1, f"M110 N{at - 1}").encode() + b"\n")
                self._await(lambda r: r.kind == "ok", self.answer)
        return None

    def report(self) -> Reply | None:
        """Ask for a report; None where none comes undamaged."""
        if self.speech.numbered:
            found = self._numbered(self.speech.ask(), self.answer)
            return found if found is not None and found.kind == "report" else None
        self._drain()
        self.write(self.speech.ask().encode())
        return self._await(lambda r: r.pose is not None, self.answer / 4)

    def greet(self) -> None:
        """Wait until somebody answers: the greeting may have been said before the port was open.

        Raises:
            RigError: nobody does.
        """
        for _ in range(self.tries):
            if self.speech.numbered:
                self.write(b"\n" + dialects.number_line(0, "M110 N0").encode() + b"\n")
                if self._await(lambda r: r.kind == "ok", self.answer):
                    return
            elif self.report() is not None:
                return
        raise RigError(
            f"rig: nobody answers at {self.port.port} in {type(self.speech).__name__.lower()}; is it on, is this its "
            f"port, are {self.port.baudrate} baud right?"
        )

    def pause(self) -> None:
        """Wait for a controller that starts anew."""
        self._await(lambda r: r.kind == "started", 0.2)
        self._drain()

    def _drain(self) -> None:
        """Forget what was said before."""
        with self._vanishes():
            self.port.read(self.port.in_waiting)
        self.came.clear()

    def write(self, data: bytes) -> None:
        """Put bytes on the line.

        Raises:
            RigError: the port is gone.
        """
        with self._vanishes():
            self.port.write(data)

    def _await(self, wanted: Callable[[Reply], bool], seconds: float) -> Reply | None:
        """Return the first line that is wanted, or None after so many seconds; busy controllers get more time."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            with self._vanishes():
                self.came += self.port.read(max(self.port.in_waiting, 1))
            while b"\n" in self.came:
                line, _, rest = bytes(self.came).partition(b"\n")
                self.came = bytearray(rest)
                answer = self.speech.parse(line.decode("ascii", "replace"))
                if answer.kind == "busy":
                    until = max(until, time.monotonic() + self.patience)
                if wanted(answer):
                    return answer
        return None

    @contextlib.contextmanager
    def _vanishes(self) -> Iterator[None]:
        try:
            yield
        except (serial.SerialException, OSError, TypeError) as error:
            raise RigError(f"rig: the port {self.port.port} is gone ({error}); what was taken stays") from error
