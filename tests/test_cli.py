import json

import pytest
from click.testing import CliRunner

from torchmeso.backends import opencl
from torchmeso.cli import main


def run(*arguments):
    return CliRunner().invoke(main, [str(a) for a in arguments])


def test_info_lists_devices_and_tests_the_chosen_one(device):
    result = run("info", "--device")
    assert result.exit_code == 0
    assert "self-test: exact" in result.stdout
    assert any(d["chosen"] for d in json.loads(run("info", "--device", "--json").stdout))


def test_info_without_a_platform_says_what_to_do(monkeypatch):
    monkeypatch.setattr(opencl, "list_devices", list)
    result = run("info", "--device")
    assert result.exit_code == 0
    assert "no OpenCL platform: everything runs on torch" in result.stdout


@pytest.mark.errors
def test_info_wants_a_file_or_a_device():
    result = run("info")
    assert result.exit_code == 2
    assert "give a FILE or --device" in result.stderr


def test_every_command_has_help():
    for name in main.commands:
        result = run(name, "--help")
        assert result.exit_code == 0, name
        assert "Usage:" in result.stdout
