import itertools
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from torchmeso.capture import plan, session
from torchmeso.capture.cameras import Camera
from torchmeso.capture.dialects import Pose
from torchmeso.capture.plan import Step
from torchmeso.capture.rig import Rig
from torchmeso.capture.session import Moves
from torchmeso.errors import ConfigError, RigError, StorageError


class Still:
    """A rig that is anywhere at once, and remembers."""

    def __init__(self):
        self.at, self.lit, self.power, self.said = None, set(), 0.0, []

    def move(self, pose):
        self.at = pose
        self.said.append(pose)

    def confirm(self, pose):
        assert self.at == pose

    def lamp(self, number, on):
        (self.lit.add if on else self.lit.discard)(number)

    def laser(self, power):
        self.power = power


class Seeing:
    """A camera whose frames are a function of the rig and the exposure."""

    def __init__(self, name, rig, fails_at=None):
        self.name, self.size, self._rig, self._fails_at, self.count = name, (4, 6), rig, fails_at, 0

    def expose(self, seconds, key):
        self.count += 1
        if self.count == self._fails_at:
            raise RigError(f"camera {self.name}: gave no frame of {key}; what was taken stays")
        seed = f"{self.name} {self._rig.at} {sorted(self._rig.lit)} {self._rig.power} {seconds} {key}"
        return np.random.default_rng(list(seed.encode())).integers(0, 256, self.size, np.uint8)


def small():
    poses = [Pose(turn, arc, 0) for turn in (0, 90) for arc in (20, 50)]
    lamps = plan.lamp_steps(poses, 2, (0.01, 0.1))
    return lamps + plan.sweep_steps((0, 90), ((20,), (50,)), (-2, 0, 2), 0.02, 0.5)


def refused(text):
    raise AssertionError(text)


def tree(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted((folder / "frames").rglob("*")) if p.is_file()}


def test_what_it_asks_for_is_there():
    assert isinstance(Seeing("a", Still()), Camera)
    assert isinstance(Still(), Moves)
    assert issubclass(Rig, Moves)


def test_every_frame_is_taken_once_in_its_place(tmp_path):
    rig, asked = Still(), []
    cameras = [Seeing("left", rig), Seeing("right", rig)]
    taken = session.run(small(), rig, cameras, tmp_path, ask=asked.append)
    assert (taken.steps, taken.before, taken.frames) == (14, 0, 2 * (8 * 2 + 4 * 3))
    assert asked == [f"mount the laser at place {k} of 2 on the light arc" for k in (1, 2)]
    assert (rig.lit, rig.power) == (set(), 0)
    found = np.load(tmp_path / "frames/mdf/mount1/turn90_arc50/right.npy")
    assert (found.shape, found.dtype) == ((3, 4, 6), np.uint8)
    assert len(tree(tmp_path)) == 2 * 12
    assert len((tmp_path / "journal.jsonl").read_text().splitlines()) == 14
    again = session.run(small(), rig, cameras, tmp_path, ask=refused)
    assert (again.steps, again.before, again.frames) == (0, 14, 0)


@pytest.mark.parametrize("fails_at", [1, 7, 20])
def test_a_camera_that_stops_leaves_what_was_taken(tmp_path, fails_at):
    rig = Still()
    with pytest.raises(RigError, match="gave no frame of"):
        session.run(small(), rig, [Seeing("a", rig, fails_at)], tmp_path / "broken", ask=lambda text: None)
    assert (rig.lit, rig.power) == (set(), 0)
    session.run(small(), rig, [Seeing("a", rig)], tmp_path / "broken", ask=lambda text: None)
    session.run(small(), rig, [Seeing("a", rig)], tmp_path / "whole", ask=lambda text: None)
    assert tree(tmp_path / "broken") == tree(tmp_path / "whole")


def test_a_torn_journal_is_mended(tmp_path):
    rig = Still()
    session.run(small(), rig, [Seeing("a", rig)], tmp_path, ask=lambda text: None)
    journal = tmp_path / "journal.jsonl"
    journal.write_bytes(journal.read_bytes()[:-9])
    (tmp_path / "frames/btf/turn0_arc20/lamp0/a.npy").unlink()
    taken = session.run(small(), rig, [Seeing("a", rig)], tmp_path, ask=refused)
    assert taken.steps == 1
    assert [json.loads(line)["done"] for line in journal.read_text().splitlines()][-1] == "btf/turn0_arc20/lamp0"


def test_another_session_is_not_mixed_in(tmp_path):
    rig = Still()
    session.run(small(), rig, [Seeing("a", rig)], tmp_path, ask=lambda text: None)
    with pytest.raises(ConfigError, match="holds another session than this one"):
        session.run(small()[:-1], rig, [Seeing("a", rig)], tmp_path, ask=refused)
    with pytest.raises(ConfigError, match="expected every camera once, got a twice"):
        session.run(small(), rig, [Seeing("a", rig), Seeing("a", rig)], tmp_path / "b", ask=refused)
    with pytest.raises(ConfigError, match="expected every step once"):
        session.run(small() + small()[:1], rig, [Seeing("a", rig)], tmp_path / "b", ask=refused)


def test_frames_of_another_camera_are_refused(tmp_path):
    rig = Still()
    camera = Seeing("a", rig)
    camera.expose = lambda seconds, key: np.zeros((5, 6), np.uint8)
    with pytest.raises(RigError, match="expected frames of 6 x 4 pixels"):
        session.run(small(), rig, [camera], tmp_path, ask=refused)


def test_a_full_disk_is_said(tmp_path, monkeypatch):
    rig = Still()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(session.np, "save", full)
    with pytest.raises(StorageError, match="could not be written"):
        session.run(small(), rig, [Seeing("a", rig)], tmp_path, ask=refused)
    assert not tree(tmp_path)


@pytest.mark.parametrize(
    ("values", "said"),
    [({"key": "../a"}, "expected a name as the key"), ({"exposures": ()}, "expected exposures above 0"),
     ({"tilts": (1.0,), "exposures": (1.0, 2.0)}, "one exposure for a sweep")],
)  # fmt: skip
def test_steps_that_cannot_be_taken(values, said):
    with pytest.raises(ConfigError, match=said):
        Step(**({"key": "a"} | values))


def test_an_order_moves_little():
    """A grid is gone through line by line there and back: no step longer than one of the grid."""
    grid = [Pose(30.0 * i, 15.0 * k, 0) for i in range(12) for k in range(5)]
    shuffled = random.Random(1).sample(grid, len(grid))
    order = plan.in_order(shuffled)
    assert sorted(order) == grid
    assert order == plan.in_order(grid)
    ways = [plan.way(a, b) for a, b in itertools.pairwise(order)]
    shortest = 12 * 4 * 15.0 + 11 * 30.0
    assert sum(ways) <= 1.15 * shortest


def test_how_long_it_takes():
    steps = [Step(key="a", pose=Pose(60, 0, 0), exposures=(0.5, 1.5)), Step(key="b", pose=Pose(60, 0, 0), tilts=(0, 6))]
    steps.append(Step(key="p", pause="wait"))
    took = plan.seconds(steps, speed=60, settle=0.25, frame=0.1)
    assert took == pytest.approx((1 + 0.25 + 2 * 0.1 + 2.0) + (0.1 + 0.25 + 2 * 0.1 + 2 * 0.01))


CHILD = """
import sys, time
sys.path.insert(0, {tests!r})
from test_session import Seeing, Still, small
from torchmeso.capture import session
class Slow(Seeing):
    def expose(self, seconds, key):
        time.sleep(0.002)
        return super().expose(seconds, key)
from pathlib import Path
rig = Still()
session.run(small(), rig, [Slow("a", rig), Slow("b", rig)], Path({folder!r}), ask=lambda text: None)
print("done")
"""


def run_killed(folder, after):
    code = CHILD.format(tests=str(Path(__file__).parent), folder=str(folder))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        until = time.monotonic() + 60
        while not (folder / "journal.jsonl").exists() and process.poll() is None and time.monotonic() < until:
            time.sleep(0.002)
        time.sleep(after)
        if process.poll() is None:
            os.kill(process.pid, signal.SIGKILL)
        return "done" in process.communicate()[0]


def killed_often(tmp_path, kills):
    """A session killed at random moments is the undisturbed one, bit for bit."""
    rig, draw = Still(), random.Random(7)
    session.run(small(), rig, [Seeing("a", rig), Seeing("b", rig)], tmp_path / "whole", ask=lambda text: None)
    for _ in range(kills):
        run_killed(tmp_path / "killed", draw.uniform(0, 0.02))
    left = session.run(small(), rig, [Seeing("a", rig), Seeing("b", rig)], tmp_path / "killed", ask=lambda text: None)
    assert tree(tmp_path / "killed") == tree(tmp_path / "whole")
    told = [json.loads(line)["done"] for line in (tmp_path / "killed/journal.jsonl").read_text().splitlines()]
    assert len(told) == len(set(told))  # nothing was taken twice
    return left


def test_killed_sessions_go_on(tmp_path):
    killed_often(tmp_path, 1)


@pytest.mark.slow
def test_ten_kills(tmp_path):
    killed_often(tmp_path, 10)
