"""A capturing session: steps in an order that moves little, taken once each, whatever happens in between.

A step is taken when its frames lie in the session's folder under their names, whole; a line of the journal says when.
A session that was stopped anywhere goes on with the steps that are not. wang2005mdf, sections 3.1 and 3.2: lamps one
after the other at each pose, then a laser line that sweeps over the sample from each source; the laser is re-mounted by
hand in between, which are steps too.

Test: tests/capture/test_session.py
"""

import json
import math
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from torchmeso.capture.cameras import Camera
from torchmeso.capture.dialects import Pose
from torchmeso.data import store
from torchmeso.errors import ConfigError, RigError

PLAN, JOURNAL, FRAMES = "plan.json", "journal.jsonl", "frames"
"""Files of a session's folder."""

ROUNDS = 20
"""Times that an order is looked through for ways that cross."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """Something to be done, and taken pictures of, once.

    Attributes:
        key: its name, that of its frames; parts may be split by /.
        pose: where the rig stands.
        lamp: which one is on; None = none.
        power: of the laser, 0 = off.
        tilts: of the laser, a frame each, degrees; none: it stays as in `pose`, and there is a frame per exposure.
        exposures: seconds; a sweep has one.
        pause: what the operator is asked to do; such a step has no frames.
    """

    key: str
    pose: Pose = Pose(0.0, 0.0, 0.0)  # noqa: RUF009  immutable
    lamp: int | None = None
    power: float = 0.0
    tilts: tuple[float, ...] = ()
    exposures: tuple[float, ...] = (0.01,)
    pause: str | None = None

    def __post_init__(self) -> None:
        """Raise ConfigError for a step that cannot be taken."""
        if not self.key or self.key.startswith("/") or ".." in self.key.split("/"):
            raise ConfigError(f"session: expected a name as the key of a step, got {self.key!r}")
        if not self.exposures or min(self.exposures) <= 0:
            raise ConfigError(f"session: step {self.key}: expected exposures above 0 s, got {self.exposures}")
        if self.tilts and len(self.exposures) > 1:
            raise ConfigError(f"session: step {self.key}: expected one exposure for a sweep, got {len(self.exposures)}")

    @property
    def frames(self) -> int:
        """Pictures of each camera."""
        return 0 if self.pause else len(self.tilts) or len(self.exposures)


@runtime_checkable
class Moves(Protocol):
    """What a session asks of a rig; see `capture.rig.Rig`."""

    def move(self, pose: Pose) -> None:
        """Go to a pose and stand there."""
        ...

    def confirm(self, pose: Pose) -> None:
        """Raise RigError unless the rig stands at a pose."""
        ...

    def lamp(self, number: int, on: bool) -> None:
        """Switch a lamp."""
        ...

    def laser(self, power: float) -> None:
        """Set the laser."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Taken:
    """What a run did.

    Attributes:
        steps: taken now.
        before: that had been taken already.
        frames: pictures taken now, of all cameras.
    """

    steps: int
    before: int
    frames: int


def in_order(poses: Iterable[Pose], start: Pose = Pose(0.0, 0.0, 0.0)) -> list[Pose]:  # noqa: B008  immutable
    """Return poses in an order that moves little from `start`; axes move together, so the longest way counts.

    To the nearest one each time, then ways that cross are turned over: the same order for the same poses.
    """
    rest, order = sorted(set(poses)), [start]
    while rest:
        nearest = min(rest, key=lambda p: (way(order[-1], p), p))
        rest.remove(nearest)
        order.append(nearest)
    for _ in range(ROUNDS):
        shorter = False
        for i in range(1, len(order) - 1):
            for k in range(i + 1, len(order)):
                after = way(order[i], order[k + 1]) - way(order[k], order[k + 1]) if k + 1 < len(order) else 0.0
                if way(order[i - 1], order[k]) - way(order[i - 1], order[i]) + after < -1e-9:
                    order[i : k + 1] = order[i : k + 1][::-1]
                    shorter = True
        if not shorter:
            break
    return order[1:]


def way(a: Pose, b: Pose) -> float:
    """Return the degrees that the axis with the longest way goes."""
    return max(abs(x - y) for x, y in zip(a, b, strict=True))


def lamp_steps(poses: Iterable[Pose], lamps: int, exposures: tuple[float, ...]) -> list[Step]:
    """Return the steps of a BTF: every lamp at every pose, poses in order."""
    return [
        Step(key=f"btf/{_named(pose)}/lamp{lamp}", pose=pose, lamp=lamp, exposures=exposures)
        for pose in in_order(poses)
        for lamp in range(lamps)
    ]


def sweep_steps(
    turns: Sequence[float], sources: Sequence[Sequence[float]], tilts: tuple[float, ...], exposure: float, power: float
) -> list[Step]:
    """Return the steps of an MDF: a sweep for every source at every turn of the table.

    Args:
        turns: of the table, degrees.
        sources: angles of the light arc, those of one mounting of the laser after the other.
        tilts: of the laser in a sweep.
        exposure: seconds of a frame.
        power: of the laser.
    """
    steps: list[Step] = []
    for mount, arcs in enumerate(sources):
        ask = f"mount the laser at place {mount + 1} of {len(sources)} on the light arc"
        steps.append(Step(key=f"mdf/mount{mount}", pause=ask))
        for pose in in_order(Pose(turn, arc, tilts[0]) for turn in turns for arc in arcs):
            key = f"mdf/mount{mount}/{_named(pose)}"
            steps.append(Step(key=key, pose=pose, power=power, tilts=tilts, exposures=(exposure,)))
    return steps


def seconds(steps: Sequence[Step], *, speed: float, settle: float, frame: float) -> float:
    """Return about how long steps take, operator not counted.

    Args:
        steps: what is to be done.
        speed: of the axes, degrees per second.
        settle: seconds at each pose.
        frame: seconds to read a frame of all cameras, exposure apart.
    """
    total, here = 0.0, Pose(0.0, 0.0, 0.0)
    for step in steps:
        if step.pause:
            continue
        poses = [step.pose._replace(tilt=t) for t in step.tilts] or [step.pose]
        for pose in poses:
            total += way(here, pose) / speed + (settle if pose != here else 0.0)
            here = pose
        total += step.frames * frame + sum(step.exposures) * (len(step.tilts) or 1)
    return total


def frame_path(folder: Path, step: Step, camera: str) -> Path:
    """Return where the frames of a step lie: (frame, H, W) or (frame, H, W, 3), as the camera gives them."""
    return folder / FRAMES / step.key / f"{camera}.npy"


def is_taken(folder: Path, step: Step, cameras: Sequence[str], told: set[str]) -> bool:
    """Return whether a step is done: its frames are there; of a pause, the journal says so."""
    if step.pause:
        return step.key in told
    return all(frame_path(folder, step, camera).exists() for camera in cameras)


def run(
    steps: Sequence[Step],
    rig: Moves,
    cameras: Sequence[Camera],
    folder: Path,
    *,
    ask: Callable[[str], None],
    progress: Callable[[float], None] = lambda share: None,
) -> Taken:
    """Take the steps that are not taken yet.

    Args:
        steps: all of the session.
        rig: an open one that was homed.
        cameras: with a name of its own each.
        folder: of the session; made where it is not there.
        ask: returns when the operator has done what it says; raises to end the session.
        progress: told the share that is done.

    Raises:
        ConfigError: the folder holds another session, or names appear twice.
        RigError: the rig or a camera failed; what was taken stays.
        StorageError: a frame could not be written.
    """
    names = [camera.name for camera in cameras]
    for what, own in (("step", [s.key for s in steps]), ("camera", names)):
        twice = sorted({x for x in own if own.count(x) > 1}) if len(set(own)) < len(own) else []
        if twice:
            raise ConfigError(f"session: expected every {what} once, got {twice[0]} twice")
    _keep_plan(folder, steps, names)
    told = _told(folder)
    left = [s for s in steps if not is_taken(folder, s, names, told)]
    before = len(steps) - len(left)
    frames = 0
    with store.writing(folder), (folder / JOURNAL).open("a", encoding="utf-8") as journal:
        for k, step in enumerate(left):
            progress((before + k) / len(steps))
            if step.pause:
                ask(step.pause)
            else:
                taken = _take(step, rig, cameras)
                for camera, pictures in zip(names, taken, strict=True):
                    _keep(frame_path(folder, step, camera), pictures)
                frames += len(cameras) * step.frames
            journal.write(json.dumps({"done": step.key, "at": time.strftime("%Y-%m-%dT%H:%M:%S")}) + "\n")
            journal.flush()
            os.fsync(journal.fileno())
    progress(1.0)
    return Taken(steps=len(left), before=before, frames=frames)


def _take(step: Step, rig: Moves, cameras: Sequence[Camera]) -> list[np.ndarray]:
    """Return the frames of each camera; whatever fails, the step's lights are out."""
    shots = [(t, step.exposures[0]) for t in step.tilts] or [(step.pose.tilt, s) for s in step.exposures]
    frames: list[list[np.ndarray]] = [[] for _ in cameras]
    rig.move(step.pose._replace(tilt=shots[0][0]))
    try:
        if step.lamp is not None:
            rig.lamp(step.lamp, True)
        if step.power:
            rig.laser(step.power)
        for k, (tilt, exposure) in enumerate(shots):
            pose = step.pose._replace(tilt=tilt)
            if k and step.tilts:
                rig.move(pose)
            rig.confirm(pose)
            for camera, own in zip(cameras, frames, strict=True):
                own.append(_checked(camera, camera.expose(exposure, f"{step.key}/{k}")))
            rig.confirm(pose)  # it stood there to the end
    finally:
        if step.power:
            rig.laser(0.0)
        if step.lamp is not None:
            rig.lamp(step.lamp, False)
    return [np.stack(own) for own in frames]


def _checked(camera: Camera, frame: np.ndarray) -> np.ndarray:
    if frame.shape[:2] != camera.size or frame.dtype not in (np.uint8, np.uint16):
        raise RigError(
            f"camera {camera.name}: expected frames of {camera.size[1]} x {camera.size[0]} pixels, 8 or 16 bits, "
            f"got {frame.shape} of {frame.dtype}; is it another camera?"
        )
    return frame


def _keep(path: Path, frames: np.ndarray) -> None:
    with store.replacing(path) as beside, beside.open("wb") as file:
        np.save(file, frames)
        file.flush()
        os.fsync(file.fileno())


def _keep_plan(folder: Path, steps: Sequence[Step], cameras: list[str]) -> None:
    """Write what the session is, or see that the folder holds the same one."""
    plan = json.dumps({"cameras": cameras, "steps": [asdict(s) for s in steps]}, indent=1)
    path = folder / PLAN
    if path.exists():
        if path.read_text(encoding="utf-8") != plan:
            raise ConfigError(
                f"session: {folder} holds another session than this one; go on with its configuration, "
                "or choose another folder"
            )
        return
    with store.replacing(path) as beside:
        beside.write_text(plan, encoding="utf-8")


def _told(folder: Path) -> set[str]:
    """Return what the journal says is done; its last line may be torn."""
    path = folder / JOURNAL
    if not path.exists():
        return set()
    data = path.read_bytes()
    whole = data[: data.rfind(b"\n") + 1]
    if len(whole) < len(data):  # the next line must not be written behind a torn one
        with store.replacing(path) as beside:
            beside.write_bytes(whole)
    return {json.loads(line)["done"] for line in whole.splitlines()}


def _named(pose: Pose) -> str:
    return f"turn{_degrees(pose.turntable)}_arc{_degrees(pose.arc)}"


def _degrees(x: float) -> str:
    return f"{x:.3f}".rstrip("0").rstrip(".") if math.isfinite(x) else "none"
