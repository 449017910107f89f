"""The README's promises: its Python runs, its links lead somewhere, its commands exist."""

import re
from pathlib import Path

import pytest

from torchmeso.cli import main

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name + "-" + p.parent.name)
def test_links_lead_somewhere(page):
    links = re.findall(r"\]\((?!https?:)([^)#]+)\)", page.read_text())
    assert [link for link in links if not (page.parent / link).exists()] == []


def test_every_command_that_is_named_exists():
    named = set(re.findall(r"^    torchmeso (\w+)", README, re.MULTILINE))
    assert named == set(main.commands)


def test_pictures_are_small():
    assert [p.name for p in (ROOT / "docs").rglob("*.png") if p.stat().st_size >= 300_000] == []


def test_python_is_eight_lines():
    block = re.search(r"```python\n(.*?)```", README, re.DOTALL)
    assert block is not None
    assert len([line for line in block[1].splitlines() if line]) == 8
    compile(block[1], "README.md", "exec")


@pytest.mark.slow
def test_python_runs(tmp_path, monkeypatch, capsys):
    block = re.search(r"```python\n(.*?)```", README, re.DOTALL)
    assert block is not None
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    monkeypatch.chdir(tmp_path)
    exec(block[1], {})
    assert "psnr" in capsys.readouterr().out
    assert (tmp_path / "knot.exr").is_file()
