"""A rig of three axes, lamps and a laser over a serial port; wang2005mdf, section 3 and Fig. 3.

Nothing that a controller says is taken on trust: a line may be lost or damaged both ways. Every command can be said
twice and is, until it was obeyed; a pose holds when two reports in a row say so. Whatever goes wrong, motion ends and
lamps and laser are switched off before the error leaves.

Test: tests/capture/test_rig.py
"""

import contextlib
import fnmatch
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from types import TracebackType
from typing import Literal

import serial
from serial.tools import list_ports

from torchmeso.capture import dialects
from torchmeso.capture.dialects import Dialect, Pose, Reply
from torchmeso.errors import ConfigError, RigError, check_range

LOW, HIGH = Pose(-360.0, 0.0, -60.0), Pose(360.0, 180.0, 60.0)
"""Soft limits unless others are given, degrees."""

KEPT = 64
"""Numbered lines that are kept to be said again."""

STUCK = 5.0
"""Seconds after which a port that takes no bytes is given up."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RigOptions:
    """How a rig is reached and how carefully.

    Attributes:
        port: its name, a pattern such as /dev/ttyUSB*, or the serial number of its USB device.
        dialect: what its controller speaks.
        baud: of the line.
        lamps: number of them.
        low, high: soft limits of the axes, degrees; asked of the host before the controller's own.
        within: degrees by which a pose may be off.
        settle: seconds to wait where the axes stop, before they are believed to stand.
        answer: seconds until an answer is given up.
        arrive: seconds until a motion is given up.
        tries: times that something is said before the rig is given up.
    """

    port: str
    dialect: Literal["grbl", "marlin"] = "grbl"
    baud: int = 115200
    lamps: int = 8
    low: Pose = LOW
    high: Pose = HIGH
    within: float = 0.011
    settle: float = 0.3
    answer: float = 1.0
    arrive: float = 60.0
    tries: int = 12

    def __post_init__(self) -> None:
        """Raise ConfigError for what no rig can be asked for."""
        check_range("rig.lamps", self.lamps, 0, dialects.MOST_LAMPS)
        check_range("rig.tries", self.tries, 1, 1000)
        for name in ("within", "answer", "arrive"):
            check_range(f"rig.{name}", getattr(self, name), 1e-6, 3600)
        check_range("rig.settle", self.settle, 0, 3600)


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
class Rig:
    """An open line to a controller. Use it as a context: leaving it, however, switches everything off."""

    options: RigOptions
    line: serial.Serial
    speech: Dialect
    number: int = 0
    said: dict[int, str] = field(default_factory=dict)
    came: bytearray = field(default_factory=bytearray)
    power: float = 0.0

    @classmethod
    def open(cls, options: RigOptions) -> "Rig":
        """Open the port, and wait for the controller to answer.

        Raises:
            RigError: there is no such port, or nobody answers there.
        """
        port = find_port(options.port)
        try:
            line = serial.Serial(port, options.baud, timeout=0.01, write_timeout=STUCK)
        except (serial.SerialException, OSError, ValueError) as error:
            raise RigError(f"rig: {port} does not open ({error}); is it another program's?") from error
        rig = cls(options, line, dialects.dialect(options.dialect))
        try:
            rig._greet()
        except BaseException:
            rig.stop()
            line.close()
            raise
        return rig

    def __enter__(self) -> "Rig":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if error is None:
                self.dark()
        except RigError:
            self.stop()
            raise
        finally:
            if error is not None:
                self.stop()
            self.line.close()

    def home(self) -> None:
        """Let the axes find their zeros.

        Raises:
            RigError: they do not.
        """
        with self._or_stop():
            for line in self.speech.home():
                self._tell(line, self.options.arrive)
            self._arrive(Pose(0.0, 0.0, 0.0))

    def move(self, pose: Pose) -> None:
        """Go to `pose`, degrees, and stand there.

        Raises:
            ConfigError: it lies outside of the soft limits; nothing moves.
            RigError: the rig does not get there.
        """
        for name, low, x, high in zip(Pose._fields, self.options.low, pose, self.options.high, strict=True):
            if not (math.isfinite(x) and low <= x <= high):
                raise ConfigError(f"rig: expected {name} from {low:g} to {high:g} degrees, got {x:g}")
        with self._or_stop():
            for _ in range(self.options.tries):
                if self._obeyed(self.speech.move(pose), self.options.arrive) and self._arrive(pose, must=False):
                    time.sleep(self.options.settle)
                    self.confirm(pose)
                    return
            raise RigError(
                f"rig: expected to get to {_told(pose)}, stands at {_told(self.pose())}; is an axis blocked?"
            )

    def pose(self) -> Pose:
        """Return where the axes stand: what two reports in a row agree on.

        Raises:
            RigError: the rig moves, or does not tell.
        """
        return self._agreed()[0]

    def confirm(self, pose: Pose) -> None:
        """Ask, right before an exposure, whether the rig stands at `pose` and its laser is as it was set.

        Raises:
            RigError: it does not.
        """
        for last in (False, False, True):  # two reports in a row may be damaged alike
            stands, power = self._agreed()
            there = max(abs(a - b) for a, b in zip(stands, pose, strict=True)) <= self.options.within
            if there and (power is None or abs(power - self.power) < 0.005):
                return
            if last and there:
                raise RigError(f"rig: expected the laser at {self.power:g}, it is at {power:g}; nothing was exposed")
            if last:
                raise RigError(f"rig: expected it at {_told(pose)}, it stands at {_told(stands)}; nothing was exposed")

    def lamp(self, number: int, on: bool) -> None:
        """Switch a lamp, counted from 0.

        Raises:
            ConfigError: there is no such lamp.
            RigError: the rig does not obey.
        """
        if not 0 <= number < self.options.lamps:
            raise ConfigError(f"rig: expected a lamp from 0 to {self.options.lamps - 1}, got {number}")
        self._say(self.speech.lamp(number, on), self._sound)

    def laser(self, power: float) -> None:
        """Set the laser's power, 0 = off to 1.

        Raises:
            ConfigError: the power is out of range.
            RigError: the rig does not obey.
        """
        check_range("rig.laser", power, 0, 1)
        self.power = power
        self._say(self.speech.laser(power), self._sound)

    def dark(self) -> None:
        """Switch laser and lamps off.

        Raises:
            RigError: the rig does not obey.
        """
        self.laser(0.0)
        for number in range(self.options.lamps):
            self.lamp(number, False)

    def stop(self) -> None:
        """End motion and switch everything off at once, as well as the line still allows; raises nothing."""
        with contextlib.suppress(Exception):
            self.power = 0.0
            self.line.write(self.speech.reset)
            self.line.flush()
        with contextlib.suppress(Exception):
            self._pause()
            for line in self.speech.unlock():
                self._tell(line, self.options.answer)
        for lines in (self.speech.laser(0.0), *(self.speech.lamp(k, False) for k in range(self.options.lamps))):
            with contextlib.suppress(Exception):
                self._obeyed(lines, self.options.answer)

    @contextlib.contextmanager
    def _or_stop(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self.stop()
            raise

    def _say(self, lines: tuple[str, ...], done: Callable[[], bool]) -> None:
        """Say `lines` until they are obeyed and `done` holds."""
        with self._or_stop():
            for _ in range(self.options.tries):
                if self._obeyed(lines, self.options.answer) and done():
                    return
            raise RigError(f"rig: {self.line.port} does not obey {lines[-1]}; is its cable sound, its firmware right?")

    def _sound(self) -> bool:
        """Return whether the laser is as it was set, where the controller tells."""
        power = self._agreed()[1]
        return power is None or abs(power - self.power) < 0.005

    def _agreed(self) -> tuple[Pose, float | None]:
        """Return where the axes stand and the laser's power: what two reports in a row agree on."""
        last = None
        for _ in range(4 * self.options.tries):
            found = self._report()
            told = (found.pose, found.laser) if found is not None and found.still and found.pose is not None else None
            if told is not None and told == last:
                return told  # type: ignore[return-value]
            last = told
        raise RigError("rig: no two reports in a row agree on where it stands; does it move, is its cable sound?")

    def _obeyed(self, lines: tuple[str, ...], seconds: float) -> bool:
        """Return whether each of `lines` was answered with ok; an alarm is unlocked for the next try."""
        for line in lines:
            answer = self._once(line, seconds)
            if answer is None or answer.kind != "ok":
                if answer is not None and answer.kind == "alarm":
                    self._unlock()
                return False
        return True

    def _tell(self, line: str, seconds: float) -> None:
        for _ in range(self.options.tries):
            answer = self._once(line, seconds)
            if answer is not None and answer.kind == "ok":
                return
            if answer is not None and answer.kind == "alarm":
                self._unlock()
        raise RigError(f"rig: {self.line.port} does not obey {line}; is its firmware {self.options.dialect}?")

    def _unlock(self) -> None:
        """Let commands pass after an alarm, which the controller may have had from a damaged line."""
        if not self.speech.numbered:
            self._write(b"\x18")
            self._pause()
            self.power = 0.0
        for line in self.speech.unlock():
            self._once(line, self.options.answer)

    def _once(self, line: str, seconds: float) -> Reply | None:
        """Say a line once (numbered lines until they arrive), and return its answer: ok, error or alarm; else None."""
        if self.speech.numbered:
            return self._numbered(line, seconds)
        self._report()  # what was said to earlier lines has come when the report has
        self._drain()
        self._write(line.encode() + b"\n")
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
        for _ in range(2 * self.options.tries):
            self._drain()
            self._write(b"\n" + dialects.number_line(at, self.said[at]).encode() + b"\n")
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
                self._write(b"\n" + dialects.number_line(at - 1, f"M110 N{at - 1}").encode() + b"\n")
                self._await(lambda r: r.kind == "ok", self.options.answer)
        return None

    def _report(self) -> Reply | None:
        """Ask for a report; None where none comes undamaged."""
        if self.speech.numbered:
            found = self._numbered(self.speech.ask(), self.options.answer)
            return found if found is not None and found.kind == "report" else None
        self._drain()
        self._write(self.speech.ask().encode())
        return self._await(lambda r: r.pose is not None, self.options.answer / 4)

    def _arrive(self, pose: Pose, *, must: bool = True) -> bool:
        """Wait until the axes stand; return whether they stand at `pose`."""
        until = time.monotonic() + self.options.arrive
        while time.monotonic() < until:
            found = self._report()
            if found is not None and found.kind == "alarm":
                self._unlock()
                break
            if found is not None and found.still and found.pose is not None:
                off = max(abs(a - b) for a, b in zip(self.pose(), pose, strict=True))
                if off <= self.options.within:
                    return True
                break
            time.sleep(0.005)
        if must:
            raise RigError(f"rig: expected it at {_told(pose)} within {self.options.arrive:g} s, it is not")
        return False

    def _greet(self) -> None:
        """Wait until somebody answers: the greeting may have been said before the port was open."""
        for _ in range(self.options.tries):
            if self.speech.numbered:
                self._write(b"\n" + dialects.number_line(0, "M110 N0").encode() + b"\n")
                if self._await(lambda r: r.kind == "ok", self.options.answer):
                    return
            elif self._report() is not None:
                return
        raise RigError(
            f"rig: nobody answers at {self.line.port} in {self.options.dialect}; is it on, is this its port, "
            f"are {self.options.baud} baud right?"
        )

    def _pause(self) -> None:
        self._await(lambda r: r.kind == "started", 0.2)
        self._drain()

    def _drain(self) -> None:
        """Forget what was said before."""
        with self._vanishes():
            self.line.read(self.line.in_waiting)
        self.came.clear()

    def _write(self, data: bytes) -> None:
        with self._vanishes():
            self.line.write(data)

    def _await(self, wanted: Callable[[Reply], bool], seconds: float) -> Reply | None:
        """Return the first line that is wanted, or None after so many seconds; busy controllers get more time."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            with self._vanishes():
                self.came += self.line.read(max(self.line.in_waiting, 1))
            while b"\n" in self.came:
                line, _, rest = bytes(self.came).partition(b"\n")
                self.came = bytearray(rest)
                answer = self.speech.parse(line.decode("ascii", "replace"))
                if answer.kind == "busy":
                    until = max(until, time.monotonic() + self.options.arrive)
                if wanted(answer):
                    return answer
        return None

    @contextlib.contextmanager
    def _vanishes(self) -> Iterator[None]:
        try:
            yield
        except (serial.SerialException, OSError, TypeError) as error:
            raise RigError(f"rig: the port {self.line.port} is gone ({error}); what was taken stays") from error


def _told(pose: Pose) -> str:
    return ", ".join(f"{name} {x:.3f}" for name, x in zip(Pose._fields, pose, strict=True))
