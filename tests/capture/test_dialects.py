import pytest

from torchmeso.capture import dialects
from torchmeso.capture.dialects import Dialect, Grbl, Marlin, Pose


def test_both_are_dialects():
    assert isinstance(Grbl(), Dialect)
    assert isinstance(Marlin(), Dialect)
    assert type(dialects.dialect("grbl")) is Grbl
    assert type(dialects.dialect("marlin")) is Marlin


def test_grbl_commands():
    speech = Grbl()
    assert speech.move(Pose(12, -5.5, 0.0004)) == ("G90G0X12.000Y-5.500Z0.000",)
    assert speech.laser(0.25) == ("M3S250",)
    assert speech.laser(0) == ("M5",)
    assert speech.lamp(3, True) == ("M64P13",)
    assert speech.lamp(3, False) == ("M65P13",)


def test_grbl_answers():
    parse = Grbl().parse
    assert parse("ok\r\n").kind == "ok"
    assert (parse("error:9").kind, parse("error:9").number) == ("error", 9)
    assert (parse("ALARM:2").kind, parse("ALARM:2").number) == ("alarm", 2)
    report = parse("<Run|MPos:1.500,-2.000,30.125|FS:0,1000|A:S>")
    assert (report.kind, report.still, report.pose, report.laser) == ("report", False, Pose(1.5, -2, 30.125), 1.0)
    assert parse("<Alarm|MPos:0.000,0.000,0.000|FS:0,0>").kind == "alarm"
    assert parse("<Hold:0|MPos:0.000,0.000,0.000|FS:0,0>").still is False


@pytest.mark.parametrize(
    "damaged",
    ["<Idle|MPos:1.500,-2000,30.125|FS:0,0>", "<Idle|MPos:1.50,-2.000,30.125|FS:0,0>", "Idle|MPos:1.500,2.000,3.000>",
     "o", "<Idle|MPos:11.5000,2.000,3.000>", "", "[MSG:hello]"],
)  # fmt: skip
def test_damaged_lines_say_nothing(damaged):
    assert Grbl().parse(damaged).kind == "other"


def test_marlin_lines_and_answers():
    assert dialects.number_line(3, "M114") == "N3 M114*36"  # by hand: exclusive or of the bytes of "N3 M114"
    assert Marlin().move(Pose(1, 2, 3))[1] == "G0 X1.000 Y2.000 Z3.000"
    parse = Marlin().parse
    assert parse("X:1.00 Y:-2.50 Z:30.00 E:0.00 Count X:80").pose == Pose(1, -2.5, 30)
    assert (parse("Resend: 7").kind, parse("Resend: 7").number) == ("resend", 7)
    assert parse("Error:checksum mismatch, Last Line: 3").kind == "error"
    assert parse("echo:busy: processing").kind == "busy"
    assert parse("X:1.00 Y-2.50 Z:30.00 E:0").kind == "other"
    assert parse("X:1.00 Y:-2.550 Z:30.00 E:0").kind == "other"


def test_a_lost_byte_never_makes_a_numbered_line_good():
    line = dialects.number_line(41, "G0 X100.000 Y5.250 Z0.000")
    body, _, told = line.rpartition("*")
    for k in range(len(body)):
        assert dialects.checksum(body[:k] + body[k + 1 :]) != int(told)
