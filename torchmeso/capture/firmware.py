"""A controller that is not there: what GRBL 1.1 and Marlin 2 do with the bytes they get, over a model of motion.

Axes move together, with one acceleration and one top speed; where they stop they shake for a while. Lamps and laser are
outputs. No command may leave the soft limits; what a damaged one does within them it does, as with real firmware.

Test: tests/capture/test_firmware.py
"""

import math
import re
from dataclasses import dataclass, field
from typing import Literal

from torchmeso.capture.dialects import AXES, FIRST_PORT, POWER, Pose, checksum

SHAKE, CALM = 0.05, 0.08
"""Degrees that an axis shakes by where it stops, and seconds until a third of that is left."""

HERTZ = 12.0
"""Of that shaking."""


ZERO, LOW, HIGH = Pose(0.0, 0.0, 0.0), Pose(-360.0, 0.0, -60.0), Pose(360.0, 180.0, 60.0)
"""Where axes are homed to, and how far they go."""

ANYWHERE = Pose(17.0, 40.0, 12.0)
"""Where they stand before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Machine:
    """What axes and outputs there are.

    Attributes:
        low, high: soft limits, degrees.
        speed: degrees per second.
        acceleration: degrees per second squared.
        lamps: number of them.
        lost: where the axes stand when the controller starts, unknown to it.
    """

    low: Pose = LOW
    high: Pose = HIGH
    speed: float = 60.0
    acceleration: float = 240.0
    lamps: int = 8
    lost: Pose = ANYWHERE


@dataclass(frozen=True, slots=True)
class _Way:
    """A straight way between two poses, with a ramp up and a ramp down."""

    start: Pose
    end: Pose
    begin: float
    speed: float
    acceleration: float

    @property
    def length(self) -> float:
        return max(abs(b - a) for a, b in zip(self.start, self.end, strict=True))

    @property
    def seconds(self) -> float:
        ramp = self.speed**2 / self.acceleration
        if self.length < ramp:
            return 2 * math.sqrt(self.length / self.acceleration)
        return self.length / self.speed + self.speed / self.acceleration

    def share(self, time: float) -> float:
        """Return how much of the way lies behind at a time."""
        whole = self.seconds
        t = min(max(time - self.begin, 0.0), whole)
        if self.length == 0 or t >= whole:
            return 1.0
        up = min(self.speed / self.acceleration, whole / 2)
        top = self.acceleration * up
        if t < up:
            way = 0.5 * self.acceleration * t * t
        elif t < whole - up:
            way = 0.5 * top * up + top * (t - up)
        else:
            way = self.length - 0.5 * self.acceleration * (whole - t) ** 2
        return way / self.length

    def at(self, time: float) -> Pose:
        share = self.share(time)
        return Pose(*(a + share * (b - a) for a, b in zip(self.start, self.end, strict=True)))


@dataclass(slots=True, kw_only=True)
class Firmware:
    """The state of a controller. Times are seconds on any clock that only goes forward."""

    kind: Literal["grbl", "marlin"]
    machine: Machine
    ways: list[_Way] = field(default_factory=list)
    homed: bool = False
    locked: bool = False
    halted: bool = False  # by an alarm that only a reset ends
    laser: float = 0.0
    lamps: set[int] = field(default_factory=set)
    line: bytearray = field(default_factory=bytearray)
    number: int = 0
    waiting: list[float] = field(default_factory=list)  # Marlin: M400 is answered when nothing moves
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @classmethod
    def start(cls, kind: Literal["grbl", "marlin"], machine: Machine) -> tuple["Firmware", bytes]:
        """Return a controller that was just switched on, and its greeting."""
        made = cls(kind=kind, machine=machine, locked=kind == "grbl", offset=machine.lost)
        return made, made._greeting()

    def pose(self, time: float) -> Pose:
        """Return where the controller thinks that the axes are."""
        begun = [way for way in self.ways if way.begin <= time] or self.ways[:1]
        return begun[-1].at(time) if begun else ZERO

    def truth(self, time: float) -> Pose:
        """Return where the axes are: they stand elsewhere before they were homed, and shake after they moved."""
        told = self.pose(time)
        since = time - self._end()
        shake = 0.0
        if self.ways and self.ways[-1].length and since >= 0:
            shake = SHAKE * math.exp(-since / CALM) * math.cos(2 * math.pi * HERTZ * since)
        return Pose(*(x + o + shake for x, o in zip(told, self.offset, strict=True)))

    def moving(self, time: float) -> bool:
        """Return whether a way is not at its end."""
        return time < self._end()

    def feed(self, data: bytes, time: float) -> bytes:
        """Return what the controller says to bytes that arrive at a time."""
        said = bytearray()
        for byte in data:
            if self.kind == "grbl" and byte in b"?!~\x18":
                said += self._realtime(byte, time)
            elif byte in b"\r\n":
                line, self.line = self.line.decode("ascii", "replace").strip(), bytearray()
                if self.kind == "grbl" and not line:
                    said += b"ok\r\n"
                if line:
                    said += self._grbl(line, time) if self.kind == "grbl" else self._marlin(line, time)
            elif len(self.line) < 256:
                self.line.append(byte)
        return bytes(said)

    def tick(self, time: float) -> bytes:
        """Return what the controller says of itself, later."""
        done = [t for t in self.waiting if t <= time]
        self.waiting = [t for t in self.waiting if t > time]
        return b"ok\n" * len(done)

    def _greeting(self) -> bytes:
        if self.kind == "marlin":
            return b"start\n"
        return b"\r\nGrbl 1.1h ['$' for help]\r\n" + b"[MSG:'$H'|'$X' to unlock]\r\n" * self.locked

    def _end(self) -> float:
        return self.ways[-1].begin + self.ways[-1].seconds if self.ways else -math.inf

    def _stop(self, time: float) -> None:
        here = self.pose(time)
        self.ways = [_Way(here, here, time, self.machine.speed, self.machine.acceleration)]

    def _dark(self) -> None:
        self.laser = 0.0
        self.lamps.clear()

    def _go(self, target: Pose, time: float) -> bool:
        """Queue a way; return whether it stays within the limits."""
        if any(not low <= x <= high for low, x, high in zip(self.machine.low, target, self.machine.high, strict=True)):
            return False
        start = self.ways[-1].end if self.ways else ZERO
        begin = max(time, self._end())
        ahead = [way for way in self.ways if way.begin + way.seconds > time]
        self.ways = [*ahead, _Way(start, target, begin, self.machine.speed, self.machine.acceleration)]
        return True

    def _home(self, time: float) -> None:
        self.ways = [_Way(Pose(*self.offset), ZERO, time, self.machine.speed, self.machine.acceleration)]
        self.offset, self.homed, self.locked = (0.0, 0.0, 0.0), True, False

    def _realtime(self, byte: int, time: float) -> bytes:
        if byte == ord("?"):
            state = "Alarm" if self.locked else "Run" if self.moving(time) else "Idle"
            place = ",".join(f"{x:.3f}" for x in self.pose(time))
            return f"<{state}|MPos:{place}|FS:0,{self.laser:.0f}{'|A:S' if self.laser else ''}>\r\n".encode()
        if byte == 0x18:
            lost = self.moving(time)
            self._stop(time)
            self._dark()
            self.line.clear()
            self.halted = False
            self.locked = self.locked or lost or not self.homed
            return self._greeting()
        if byte == ord("!"):
            self._stop(time)
        return b""

    def _grbl(self, line: str, time: float) -> bytes:
        if self.halted:
            return b""
        if line == "$H":
            self._home(time)
            return b"ok\r\n"
        if line == "$X":
            self.locked = False
            return b"[MSG:Caution: Unlocked]\r\nok\r\n"
        if line.startswith("$"):
            return b"error:3\r\n"
        if self.locked:
            return b"error:9\r\n"
        compact = line.upper().replace(" ", "")
        words = re.findall(r"([A-Z])(-?\d*\.?\d+|-?\d+\.)", compact)
        if "".join(a + b for a, b in words) != compact:
            return b"error:2\r\n" if compact[:1].isalpha() else b"error:1\r\n"
        numbers = [float(x) for letter, x in words if letter in "GM"]
        axes = {letter: float(x) for letter, x in words if letter in AXES}
        values = [letter for letter, _ in words if letter not in "GM"]
        if len(set(values)) != len(values):
            return b"error:25\r\n"
        told = [f"{letter}{float(x):g}" for letter, x in words if letter in "GM"]
        if (
            len(set(told)) != len(told)
            or set(told) - {"G90", "G0", "G4", "M3", "M4", "M5", "M64", "M65"}
            or not numbers
        ):
            return b"error:20\r\n"
        others = {letter: float(x) for letter, x in words if letter not in "GM" and letter not in AXES}
        if set(others) - {"S", "P"} or ("P" in others and not set(told) & {"G4", "M64", "M65"}):
            return b"error:36\r\n"
        if "G0" in told and axes:
            if set(told) - {"G90", "G0"}:
                return b"error:21\r\n"
            end = self.ways[-1].end if self.ways else ZERO
            if not self.homed or not self._go(Pose(*(axes.get(a, e) for a, e in zip(AXES, end, strict=True))), time):
                self._stop(time)
                self._dark()
                self.locked = self.halted = True
                return b"ALARM:2\r\n"
            return b"ok\r\n"
        if axes:
            return b"error:31\r\n"
        for name in told:
            if name in ("M64", "M65"):
                lamp = others.get("P", -1) - FIRST_PORT
                if not 0 <= lamp < self.machine.lamps or lamp % 1:
                    return b"error:39\r\n"
                (self.lamps.add if name == "M64" else self.lamps.discard)(int(lamp))
            elif name in ("M3", "M4"):
                self.laser = min(max(others.get("S", 0.0), 0.0), POWER)
            elif name == "M5":
                self.laser = 0.0
        return b"ok\r\n"

    def _marlin(self, line: str, time: float) -> bytes:
        again = f"Resend: {self.number + 1}\nok\n".encode()
        last = f", Last Line: {self.number}\n".encode()
        numbered, starred = re.match(r"N(\d+) ?", line), line.rpartition("*")
        if numbered and not starred[1]:
            return b"Error:No Checksum with line number" + last + again
        if starred[1]:
            if not numbered:
                return b"Error:No Line Number with checksum" + last + again
            if starred[2].strip() != str(checksum(starred[0])):
                return b"Error:checksum mismatch" + last + again
            resets = re.search(r"\bM110\b", starred[0])
            if int(numbered[1]) != self.number + 1 and not resets:
                return b"Error:Line Number is not Last Line Number+1" + last + again
            self.number = int(numbered[1])
            line = starred[0][numbered.end() :]
        return self._obey(line.strip().upper(), time)

    def _obey(self, line: str, time: float) -> bytes:
        code, *rest = line.split()
        values = {word[0]: word[1:] for word in rest}
        try:
            at = {letter: float(x) for letter, x in values.items()}
        except ValueError:
            return f'echo:Unknown command: "{line}"\nok\n'.encode()
        if code == "G28":
            self._home(time)
        elif code == "G0" and self.homed:
            end = self.ways[-1].end
            ends = (at.get(a, e) for a, e in zip(AXES, end, strict=True))
            limits = zip(self.machine.low, ends, self.machine.high, strict=True)
            self._go(Pose(*(min(max(x, low), high) for low, x, high in limits)), time)
        elif code == "M400" and self.moving(time):
            self.waiting.append(self._end())
            return b"echo:busy: processing\n"
        elif code == "M114":
            place = " ".join(f"{a}:{x:.2f}" for a, x in zip(AXES, self.pose(time), strict=True))
            return f"{place} E:0.00 Count X:0 Y:0 Z:0\nok\n".encode()
        elif code == "M3":
            self.laser = min(max(at.get("S", 0.0), 0.0), POWER)
        elif code == "M5":
            self.laser = 0.0
        elif code == "M410":
            self._stop(time)
            self.waiting = []
        elif code == "M42":
            lamp = int(at.get("P", -1)) - FIRST_PORT
            if 0 <= lamp < self.machine.lamps:
                (self.lamps.add if at.get("S", 0.0) > 0 else self.lamps.discard)(lamp)
        elif code not in ("G90", "M110", "M999", "G0", "M400"):
            return f'echo:Unknown command: "{line}"\nok\n'.encode()
        return b"ok\n"
