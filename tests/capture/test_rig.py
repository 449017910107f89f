"""A rig over a real pty, with a process that is the controller."""

import os
import random
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

from torchmeso.capture import dialects, link, virtual
from torchmeso.capture.dialects import Pose, Reply
from torchmeso.capture.rig import Rig, RigOptions
from torchmeso.capture.virtual import VirtualOptions
from torchmeso.errors import ConfigError, RigError

BOTH = pytest.mark.parametrize("dialect", ["grbl", "marlin"])


def options_for(there, dialect, **others):
    usual = {"settle": 0.002, "answer": 0.25, "arrive": 3.0}
    return RigOptions(port=there.port, dialect=dialect, **(usual | others))


@BOTH
def test_a_rig_homes_moves_lights_and_is_dark_at_the_end(dialect):
    with virtual.running(VirtualOptions(dialect=dialect, rate=200)) as there:
        assert abs(there.state().pose.turntable) > 10  # nobody has homed it
        with Rig.open(options_for(there, dialect)) as rig:
            rig.home()
            rig.move(Pose(30, 45.5, -10))
            assert rig.pose() == Pose(30, 45.5, -10)
            rig.lamp(3, True)
            rig.laser(0.5)
            rig.confirm(Pose(30, 45.5, -10))
            state = there.state()
            assert (state.lamps, state.laser, state.moving) == ((3,), 500, False)
            assert max(abs(a - b) for a, b in zip(state.pose, (30, 45.5, -10), strict=True)) < 0.01
        state = there.state()
        assert (state.lamps, state.laser) == ((), 0)


@BOTH
def test_an_error_switches_everything_off(dialect):
    with virtual.running(VirtualOptions(dialect=dialect, rate=200)) as there:
        with pytest.raises(KeyError), Rig.open(options_for(there, dialect)) as rig:
            rig.home()
            rig.lamp(0, True)
            rig.laser(1)
            raise KeyError("a camera stopped")
        state = there.state()
        assert (state.lamps, state.laser, state.moving) == ((), 0, False)


def test_limits_are_the_hosts_first():
    with virtual.running(VirtualOptions(rate=200)) as there, Rig.open(options_for(there, "grbl")) as rig:
        rig.home()
        for pose, name in ((Pose(400, 0, 0), "turntable"), (Pose(0, -1, 0), "arc"), (Pose(0, 0, float("nan")), "tilt")):
            with pytest.raises(ConfigError, match=f"expected {name} from"):
                rig.move(pose)
        with pytest.raises(ConfigError, match="expected a lamp from 0 to 7, got 8"):
            rig.lamp(8, True)
        with pytest.raises(ConfigError, match=r"rig\.laser"):
            rig.laser(2)
        assert there.state().farthest <= 0


def test_no_exposure_at_a_wrong_pose():
    with virtual.running(VirtualOptions(rate=200)) as there, Rig.open(options_for(there, "grbl")) as rig:
        rig.home()
        rig.move(Pose(10, 10, 0))
        with pytest.raises(RigError, match=r"expected it at turntable 11\.000, arc 10\.000, tilt 0\.000, it stands at"):
            rig.confirm(Pose(11, 10, 0))


def test_a_port_that_vanishes_is_said():
    with virtual.running(VirtualOptions(rate=200)) as there:
        rig = Rig.open(options_for(there, "grbl", tries=2))
        rig.home()
        rig_of = rig
    with pytest.raises(RigError, match=r"is gone|does not obey|no two reports|expected"):
        rig_of.move(Pose(1, 1, 1))
    rig_of.link.close()


def test_a_port_where_nobody_answers():
    ends = os.openpty()
    try:
        with pytest.raises(RigError, match=r"nobody answers at .* in grbl; is it on"):
            Rig.open(RigOptions(port=os.ttyname(ends[1]), answer=0.02, tries=2))
    finally:
        for end in ends:
            os.close(end)


def test_a_port_that_does_not_open():
    with pytest.raises(RigError, match="/dev/not_there does not open"):
        Rig.open(RigOptions(port="/dev/not_there"))


def test_ports_by_name_pattern_and_number(monkeypatch):
    known = [("/dev/ttyACM0", "arc", "A1"), ("/dev/ttyUSB0", "table", "B2"), ("/dev/ttyUSB1", "spare", "")]
    monkeypatch.setattr(link, "ports", lambda: known)
    assert link.find_port("B2") == "/dev/ttyUSB0"
    assert link.find_port("/dev/ttyACM*") == "/dev/ttyACM0"
    assert link.find_port("/dev/elsewhere") == "/dev/elsewhere"
    with pytest.raises(RigError, match="expected one port, got /dev/ttyUSB0, /dev/ttyUSB1"):
        link.find_port("/dev/ttyUSB*")
    with pytest.raises(RigError, match="no port is C3; ports of this machine: /dev/ttyACM0"):
        link.find_port("C3")


def test_options_out_of_range():
    with pytest.raises(ConfigError, match=r"rig\.tries"):
        RigOptions(port="a", tries=0)


def abused(dialect, commands, seed):
    """Say so many commands over a line that loses, doubles and delays one byte in a hundred."""
    draw = random.Random(seed)
    told, stood = 0, 0
    with virtual.running(VirtualOptions(dialect=dialect, rate=2000, faults=0.01, seed=seed)) as there:
        with Rig.open(replace(options_for(there, dialect), tries=40, answer=0.04)) as rig:
            rig.home()
            while told < commands:
                pose = Pose(*(round(draw.uniform(a, b), 3) for a, b in ((-360, 360), (0, 180), (-60, 60))))
                if dialect == "marlin":
                    pose = Pose(*(round(x, 2) for x in pose))
                rig.move(pose)
                lamp = draw.randrange(8)
                rig.lamp(lamp, True)
                rig.laser(draw.choice((0.25, 1.0)))
                rig.confirm(pose)
                state = there.state()  # what a camera would see now
                assert not state.moving
                assert max(abs(a - b) for a, b in zip(state.pose, pose, strict=True)) < 0.02
                assert state.lamps == (lamp,)
                assert state.laser == round(1000 * rig.power)
                rig.laser(0)
                rig.lamp(lamp, False)
                told += 5
                stood += 1
            assert there.state().farthest <= 0
        state = there.state()
        assert (state.lamps, state.laser) == ((), 0)
    return stood


@BOTH
def test_a_bad_line_makes_no_wrong_frame(dialect):
    assert abused(dialect, 20, seed=3) == 4


@pytest.mark.slow
@BOTH
def test_ten_thousand_commands_over_a_bad_line(dialect):
    begin = time.monotonic()
    assert abused(dialect, 10_000, seed=5) == 2000
    assert time.monotonic() - begin < 3600


class Told:
    """A line whose controller answers and reports as it is told to, and does nothing."""

    def __init__(self, answer="ok", **report):
        self.answer, self.told, self.port = (
            answer,
            Reply(kind="report", text="", **({"still": True} | report)),
            SimpleNamespace(port="tty"),
        )

    def say(self, line, seconds):
        return None if self.answer is None else Reply(kind=self.answer, text="")

    def report(self):
        return self.told

    def write(self, data):
        pass

    def pause(self):
        pass


@pytest.mark.errors
def test_what_a_controller_does_not_do_is_said():
    def rig(**told):
        return Rig(RigOptions(port="tty", tries=2, arrive=0.02, settle=0), Told(**told), dialects.dialect("grbl"))

    elsewhere = Pose(5, 5, 5)
    with pytest.raises(RigError, match=r"expected to get to turntable 1\.000.*is an axis blocked"):
        rig(pose=elsewhere, laser=0.0).move(Pose(1, 1, 1))
    with pytest.raises(RigError, match=r"expected the laser at 0, it is at 0\.5; nothing was exposed"):
        rig(pose=elsewhere, laser=0.5).confirm(elsewhere)
    with pytest.raises(RigError, match=r"tty does not obey .*; is its cable sound"):
        rig(pose=elsewhere, laser=0.0).laser(0.7)
    with pytest.raises(RigError, match="no two reports in a row agree"):
        rig(pose=elsewhere, still=False).pose()
    with pytest.raises(RigError, match=r"expected it at turntable 0\.000.* within 0\.02 s, it is not"):
        rig(pose=elsewhere, laser=0.0).home()
