import pytest
from click.testing import CliRunner

from torchmeso.capture import link, virtual
from torchmeso.capture.virtual import VirtualOptions
from torchmeso.cli import main


@pytest.fixture
def fast(monkeypatch):
    """A virtual rig whose time goes fast."""
    running = virtual.running
    monkeypatch.setattr(virtual, "running", lambda options: running(VirtualOptions(dialect=options.dialect, rate=200)))


def said(*arguments):
    found = CliRunner().invoke(main, ["rig", *arguments])
    return found.exit_code, found.output


def test_home(fast):
    assert said("home", "--port", "virtual", "--dialect", "marlin") == (0, "turntable 0.000 arc 0.000 tilt 0.000\n")


def test_jog_keeps_the_other_axes(fast):
    code, output = said("jog", "--port", "virtual", "--home", "--arc", "30.5")
    assert (code, output) == (0, "turntable 0.000 arc 30.500 tilt 0.000\n")


def test_jog_to_nowhere_is_refused(fast):
    assert said("jog", "--port", "virtual") == (
        2, "main rig: error: rig jog: expected --turntable, --arc or --tilt, got none of them\n",
    )  # fmt: skip
    code, output = said("jog", "--port", "virtual", "--home", "--arc", "200")
    assert code == 2
    assert "expected arc from 0 to 180 degrees, got 200" in output


def test_test_goes_through_everything(fast):
    code, output = said("test", "--port", "virtual", "--lamps", "3")
    assert code == 0
    lines = output.splitlines()
    assert [line.partition(":")[0] for line in lines[:4]] == [
        "home", "turntable to 5 degrees and back", "arc to 5 degrees and back", "tilt to 5 degrees and back",
    ]  # fmt: skip
    assert lines[6].startswith("lamp 2 on and off: ")
    assert lines[-1] == "turntable 0.000 arc 0.000 tilt 0.000"


def test_list(monkeypatch):
    monkeypatch.setattr(link, "ports", lambda: [("/dev/ttyUSB0", "table", "B2"), ("/dev/ttyS0", "", "")])
    assert said("list") == (0, "/dev/ttyUSB0\ttable\tB2\n/dev/ttyS0\n")


def test_a_port_that_is_not_there():
    code, output = said("home", "--port", "/dev/not_there")
    assert code == 2
    assert "/dev/not_there does not open" in output
