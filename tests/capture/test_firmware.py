import pytest

from torchmeso.capture.dialects import Pose, number_line
from torchmeso.capture.firmware import ANYWHERE, Firmware, Machine, _Way


@pytest.fixture
def grbl():
    made, greeting = Firmware.start("grbl", Machine())
    assert b"Grbl 1.1" in greeting
    made.feed(b"$H\n", 0.0)
    return made


def test_nothing_moves_before_it_is_homed():
    made, _ = Firmware.start("grbl", Machine())
    assert made.feed(b"G0X1\n", 0.0) == b"error:9\r\n"
    assert made.truth(0.0) == ANYWHERE
    assert made.feed(b"$H\n", 0.0) == b"ok\r\n"
    assert made.pose(100.0) == Pose(0, 0, 0)


def test_a_way_has_ramps():
    """240 degrees per second squared up to 60: a quarter of a second and 7.5 degrees at each end."""
    way = _Way(Pose(0, 0, 0), Pose(90, 45, 0), 0.0, 60.0, 240.0)
    assert way.seconds == pytest.approx(90 / 60 + 0.25)
    assert way.at(0.25) == pytest.approx((7.5, 3.75, 0))
    assert way.at(0.875) == pytest.approx((45, 22.5, 0))
    assert way.at(way.seconds - 0.25) == pytest.approx((82.5, 41.25, 0))
    assert way.at(9.0) == Pose(90, 45, 0)
    short = _Way(Pose(0, 0, 0), Pose(1, 0, 0), 0.0, 60.0, 240.0)
    assert short.at(short.seconds / 2) == pytest.approx((0.5, 0, 0))


def test_ways_wait_for_one_another(grbl):
    start = 10.0
    assert grbl.feed(b"G90G0X6Y0Z0\nG90G0X6Y6Z0\n", start) == b"ok\r\nok\r\n"
    first = grbl.ways[-2].seconds
    assert grbl.pose(start + first).turntable == pytest.approx(6)
    assert grbl.pose(start + first).arc == pytest.approx(0)
    assert grbl.moving(start + 1.5 * first)
    assert grbl.pose(start + 3 * first) == Pose(6, 6, 0)


def test_axes_shake_where_they_stop(grbl):
    grbl.feed(b"G90G0X6\n", 10.0)
    end = 10.0 + grbl.ways[-1].seconds
    assert abs(grbl.truth(end + 1e-3).turntable - 6) > 0.04
    assert abs(grbl.truth(end + 1.0).turntable - 6) < 1e-5
    assert grbl.pose(end + 1e-3).turntable == 6


@pytest.mark.parametrize(
    ("line", "answer"),
    [("G90G0X361", b"ALARM:2"), ("G90G0X1X2", b"error:25"), ("G90G0X1Y", b"error:2"), ("M64P3", b"error:39"),
     ("M64P18", b"error:39"), ("M6P10", b"error:20"), ("64P10", b"error:1"), ("G91X1", b"error:20"),
     ("M5P10", b"error:36"),
     ("X5", b"error:20"), ("$5", b"error:3"), ("", b"ok")],
)  # fmt: skip
def test_what_grbl_refuses(grbl, line, answer):
    assert grbl.feed(line.encode() + b"\n", 10.0).strip() == answer
    assert grbl.pose(20.0) == Pose(0, 0, 0)
    assert not grbl.lamps


def test_an_alarm_ends_with_a_reset(grbl):
    grbl.feed(b"M3S500\nM64P10\nG0X400\n", 10.0)
    assert (grbl.laser, grbl.lamps) == (0, set())
    assert grbl.feed(b"G0X1\n", 10.0) == b""
    assert b"Grbl" in grbl.feed(b"\x18", 10.0)
    assert grbl.feed(b"$X\nG90G0X1Y0Z0\n", 10.0).endswith(b"ok\r\nok\r\n")


def test_a_report_is_given_in_the_middle_of_a_line(grbl):
    assert grbl.feed(b"G90G?0X1\n", 10.0) == b"<Idle|MPos:0.000,0.000,0.000|FS:0,0>\r\nok\r\n"


def marlin():
    made, _ = Firmware.start("marlin", Machine())
    made.feed((number_line(0, "M110 N0") + "\n" + number_line(1, "G28") + "\n").encode(), 0.0)
    return made


def test_marlin_asks_again_for_damaged_lines():
    made = marlin()
    good = number_line(2, "G0 X5.000 Y0.000 Z0.000")
    for bad in (good.replace("5", ""), good.replace("N", ""), good.replace("*", ""), number_line(4, "G0 X5")):
        said = made.feed(bad.encode() + b"\n", 10.0)
        assert said.startswith(b"Error:")
        assert b"Resend: 2\nok\n" in said
    assert made.pose(20.0) == Pose(0, 0, 0)
    assert made.feed(good.encode() + b"\n", 20.0) == b"ok\n"
    assert made.feed(good.encode() + b"\n", 20.0).startswith(b"Error:Line Number")
    assert made.pose(30.0) == Pose(5, 0, 0)


def test_marlin_answers_when_it_stands():
    made = marlin()
    made.feed((number_line(2, "G0 X5.000") + "\n").encode(), 10.0)
    assert made.feed((number_line(3, "M400") + "\n").encode(), 10.0) == b"echo:busy: processing\n"
    assert made.tick(10.05) == b""
    assert made.tick(11.0) == b"ok\n"
    assert made.feed((number_line(4, "M114") + "\n").encode(), 11.0).startswith(b"X:5.00 Y:0.00 Z:0.00")


def test_marlin_holds_ways_within_its_limits():
    made = marlin()
    made.feed((number_line(2, "G0 X999 Y-3 Z0") + "\n").encode(), 10.0)
    assert made.pose(60.0) == Pose(360, 0, 0)
