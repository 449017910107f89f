"""A rig that is not there: a process of its own that speaks through a real pty.

    python -m torchmeso.capture.virtual '{"dialect": "grbl", ...}'

It prints where it is reached, {"port": ..., "state": ...}, and runs until its standard input ends. At the socket
`state` it tells the truth, which cameras read at an exposure and a controller does not know: a line of JSON for each
connection.

Test: tests/capture/test_rig.py
"""

import contextlib
import json
import os
import random
import select
import socket
import subprocess
import sys
import tempfile
import time
import tty
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from torchmeso.capture.dialects import Pose
from torchmeso.capture.firmware import Firmware, Machine

STALL = 0.02
"""Seconds that a byte may be late by."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VirtualOptions:
    """What a virtual rig is like.

    Attributes:
        dialect: what it speaks.
        rate: how much faster its time goes.
        faults: share of the bytes, both ways, that are lost, doubled or late.
        seed: of these.
    """

    dialect: Literal["grbl", "marlin"] = "grbl"
    rate: float = 1.0
    faults: float = 0.0
    seed: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueState:
    """How a rig is.

    Attributes:
        pose: where the axes are, shaking included.
        moving: whether they move.
        laser: its power, 0 to 1000.
        lamps: those that are on.
        farthest: degrees by which any way since the start ended over the soft limits; negative: within.
        clock: seconds on the rig's own clock.
    """

    pose: Pose
    moving: bool
    laser: float
    lamps: tuple[int, ...]
    farthest: float
    clock: float


@dataclass(frozen=True, slots=True, kw_only=True)
class VirtualRig:
    """Where a virtual rig is reached."""

    port: str
    socket: str

    def state(self) -> TrueState:
        """Return how the rig is now."""
        with socket.socket(socket.AF_UNIX) as asking:
            asking.settimeout(5)
            asking.connect(self.socket)
            found = json.loads(asking.makefile().readline())
        return TrueState(**{**found, "pose": Pose(*found["pose"]), "lamps": tuple(found["lamps"])})


@contextlib.contextmanager
def running(options: VirtualOptions) -> Iterator[VirtualRig]:
    """Run a virtual rig while the context lasts."""
    command = [sys.executable, "-m", "torchmeso.capture.virtual", json.dumps(asdict(options))]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            found = json.loads(process.stdout.readline())
            yield VirtualRig(port=found["port"], socket=found["state"])
        finally:
            process.kill()


class _Noise:
    """What happens to bytes on a bad line, one after the other: the same for the same seed."""

    def __init__(self, share: float, seed: int):
        self._share, self._draw = share, random.Random(seed)

    def passed(self, data: bytes) -> tuple[bytes, float]:
        """Return what arrives, and seconds that it is late."""
        if not self._share:
            return data, 0.0
        arrived, late = bytearray(), 0.0
        for byte in data:
            kind = self._draw.random() / self._share
            if kind < 1 / 3:
                continue
            arrived.append(byte)
            if kind < 2 / 3:
                arrived.append(byte)
            elif kind < 1:
                late = STALL
        return bytes(arrived), late


def serve(options: VirtualOptions) -> None:
    """Be a rig until standard input ends."""
    machine = Machine()
    begin = time.monotonic()

    def now() -> float:
        return options.rate * (time.monotonic() - begin)

    firmware, greeting = Firmware.start(options.dialect, machine)
    noise = _Noise(options.faults, options.seed)
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    farthest = -360.0
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_UNIX) as door:
        place = str(Path(folder) / "state")
        door.bind(place)
        door.listen()
        print(json.dumps({"port": os.ttyname(slave), "state": place}), flush=True)

        def say(data: bytes) -> None:
            arrived, late = noise.passed(data)
            time.sleep(late)
            with contextlib.suppress(BlockingIOError):  # nobody listens
                os.write(master, arrived)

        say(greeting)
        while True:
            ready, _, _ = select.select([master, door, sys.stdin], [], [], 0.002)
            if sys.stdin in ready and not os.read(sys.stdin.fileno(), 1):
                return
            if master in ready:
                arrived, late = noise.passed(os.read(master, 4096))
                time.sleep(late)
                say(firmware.feed(arrived, now()))
                for low, high, way in ((machine.low, machine.high, w) for w in firmware.ways):
                    over = max(max(a - x, x - b) for a, b, x in zip(low, high, way.end, strict=True))
                    farthest = max(farthest, over)
            if said := firmware.tick(now()):
                say(said)
            if door in ready:
                with door.accept()[0] as asking:
                    t = now()
                    state = TrueState(
                        pose=firmware.truth(t), moving=firmware.moving(t), laser=firmware.laser,
                        lamps=tuple(sorted(firmware.lamps)), farthest=farthest, clock=t,
                    )  # fmt: skip
                    asking.sendall(json.dumps(asdict(state)).encode() + b"\n")


if __name__ == "__main__":
    serve(VirtualOptions(**json.loads(sys.argv[1])))
