"""What a session takes: steps, in an order that moves little.

wang2005mdf, sections 3.1 and 3.2: lamps one after the other at each pose; then a laser line that sweeps over the sample
from each source, the laser re-mounted by hand in between, which are steps too.

Test: tests/capture/test_session.py
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from torchmeso.capture.dialects import Pose
from torchmeso.errors import ConfigError

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


def _named(pose: Pose) -> str:
    return f"turn{_degrees(pose.turntable)}_arc{_degrees(pose.arc)}"


def _degrees(x: float) -> str:
    return f"{x:.3f}".rstrip("0").rstrip(".") if math.isfinite(x) else "none"
