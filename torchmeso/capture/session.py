"""A capturing session: the steps of a plan, taken once each, whatever happens in between.

A step is taken when its frames lie in the session's folder under their names, whole; a line of the journal says when.
A session that was stopped anywhere goes on with the steps that are not.

Test: tests/capture/test_session.py
"""

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from torchmeso.capture.cameras import Camera
from torchmeso.capture.dialects import Pose
from torchmeso.capture.plan import Step
from torchmeso.data import store
from torchmeso.errors import ConfigError, RigError

PLAN, JOURNAL, FRAMES = "plan.json", "journal.jsonl", "frames"
"""Files of a session's folder."""


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
