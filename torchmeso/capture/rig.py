"""A rig of three axes, lamps and a laser over a serial port; wang2005mdf, section 3 and Fig. 3.

Nothing that a controller says is taken on trust: a line may be lost or damaged both ways. Every command can be said
twice and is, until it was obeyed; a pose holds when two reports in a row say so. Whatever goes wrong, motion ends and
lamps and laser are switched off before the error leaves.

Test: tests/capture/test_rig.py
"""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from types import TracebackType
from typing import Literal

import serial

from torchmeso.capture import dialects
from torchmeso.capture.dialects import Dialect, Pose
from torchmeso.capture.link import STUCK, Link, find_port
from torchmeso.errors import ConfigError, RigError, check_range

LOW, HIGH = Pose(-360.0, 0.0, -60.0), Pose(360.0, 180.0, 60.0)
"""Soft limits unless others are given, degrees."""


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


@dataclass(eq=False, slots=True)
class Rig:
    """An open line to a controller. Use it as a context: leaving it, however, switches everything off."""

    options: RigOptions
    link: Link
    speech: Dialect
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
        speech = dialects.dialect(options.dialect)
        rig = cls(options, Link(line, speech, options.answer, options.arrive, options.tries), speech)
        try:
            rig.link.greet()
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
            self.link.close()

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
            self.link.write(self.speech.reset)
        with contextlib.suppress(Exception):
            self.link.pause()
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
            raise RigError(f"rig: {self.link.port.port} does not obey {lines[-1]}; is its cable sound?")

    def _sound(self) -> bool:
        """Return whether the laser is as it was set, where the controller tells."""
        power = self._agreed()[1]
        return power is None or abs(power - self.power) < 0.005

    def _agreed(self) -> tuple[Pose, float | None]:
        """Return where the axes stand and the laser's power: what two reports in a row agree on."""
        last = None
        for _ in range(4 * self.options.tries):
            found = self.link.report()
            told = (found.pose, found.laser) if found is not None and found.still and found.pose is not None else None
            if told is not None and told == last:
                return told  # type: ignore[return-value]
            last = told
        raise RigError("rig: no two reports in a row agree on where it stands; does it move, is its cable sound?")

    def _obeyed(self, lines: tuple[str, ...], seconds: float) -> bool:
        """Return whether each of `lines` was answered with ok; an alarm is unlocked for the next try."""
        for line in lines:
            answer = self.link.say(line, seconds)
            if answer is None or answer.kind != "ok":
                if answer is not None and answer.kind == "alarm":
                    self._unlock()
                return False
        return True

    def _tell(self, line: str, seconds: float) -> None:
        for _ in range(self.options.tries):
            answer = self.link.say(line, seconds)
            if answer is not None and answer.kind == "ok":
                return
            if answer is not None and answer.kind == "alarm":
                self._unlock()
        raise RigError(f"rig: {self.link.port.port} does not obey {line}; is its firmware {self.options.dialect}?")

    def _unlock(self) -> None:
        """Let commands pass after an alarm, which the controller may have had from a damaged line."""
        if not self.speech.numbered:
            self.link.write(b"\x18")
            self.link.pause()
            self.power = 0.0
        for line in self.speech.unlock():
            self.link.say(line, self.options.answer)

    def _arrive(self, pose: Pose, *, must: bool = True) -> bool:
        """Wait until the axes stand; return whether they stand at `pose`."""
        until = time.monotonic() + self.options.arrive
        while time.monotonic() < until:
            found = self.link.report()
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


def _told(pose: Pose) -> str:
    return ", ".join(f"{name} {x:.3f}" for name, x in zip(Pose._fields, pose, strict=True))
