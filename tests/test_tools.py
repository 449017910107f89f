"""The tools that are Python, run as users run them."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

TABLES = Path(__file__).parents[1] / "tools" / "tables"

RUN = {
    "suite": "render",
    "device": {"cpu": "a processor", "cores": 2, "threads": 2, "torch": "2.13.0"},
    "rows": [
        {
            "id": "raster.ms",
            "what": "all layers",
            "value": 20.5,
            "unit": "ms",
            "better": "lower",
            "goal": 25,
            "met": True,
        },
        {
            "id": "shadow.iou",
            "what": "shadow",
            "value": 0.9,
            "unit": "IoU",
            "better": "higher",
            "goal": 0.95,
            "met": False,
        },
        {
            "id": "shadow.peer",
            "what": "peer",
            "value": None,
            "unit": "x",
            "better": "lower",
            "met": None,
            "why": "no peer",
        },
    ],
}


def run(*arguments):
    return subprocess.run([sys.executable, TABLES, *map(str, arguments)], capture_output=True, text=True)


@pytest.fixture
def files(tmp_path):
    (tmp_path / "run.json").write_text(json.dumps(RUN))
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- bench render: raster.ms | our words; shadow.* -->\nold\n<!-- /bench -->\nafter\n")
    return tmp_path / "run.json", page


def test_tables_are_filled_and_the_rest_is_kept(files):
    assert run(*files).stdout.strip() == str(files[1])
    text = files[1].read_text()
    assert text.startswith("before\n<!-- bench render: raster.ms")
    assert text.endswith("<!-- /bench -->\nafter\n")
    assert "old" not in text
    assert "| our words | 20.5 ms | ≤ 25 |" in text
    assert "| shadow | 0.9 IoU | ≥ 0.95, missed |" in text
    assert "| peer | not measured: no peer |  |" in text
    assert "a processor, 2 cores" in text
    assert run(*files).stdout == ""


def test_a_part_of_a_suite_leaves_the_other_lines(files):
    """After `bench --only`: blocks without any of its rows stay, and so do lines of ids that it lacks."""
    files[1].write_text("<!-- bench render: nothing.* -->\nold\n<!-- /bench -->\n")
    assert run(*files).returncode == 0
    assert "old" in files[1].read_text()
    kept = "| gone | 1 x |  |  |"
    lines = ["| what | measured | goal | peak memory |", "|---|---|---|---|", "| a | 2 x |  |  |", kept]
    files[1].write_text("\n".join(["<!-- bench render: raster.ms; gone | gone -->", *lines, "<!-- /bench -->", ""]))
    assert run(*files).returncode == 0
    assert kept in files[1].read_text()
    assert "| a | 2 x" not in files[1].read_text()


def test_missing_rows_of_a_new_line_are_an_error(files):
    files[1].write_text("<!-- bench render: raster.ms; nothing.* -->\n<!-- /bench -->\n")
    result = run(*files)
    assert result.returncode == 1
    assert "no row 'nothing.*'" in result.stderr


def test_other_suites_are_left_alone(files):
    files[1].write_text("<!-- bench skip: a -->\nold\n<!-- /bench -->\n")
    assert run(*files).returncode == 0
    assert "old" in files[1].read_text()
