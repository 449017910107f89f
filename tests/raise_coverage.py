"""Lists every `raise` of the package that no test reaches: `pytest -p raise_coverage`.

A plugin, not a test: it follows every call, so that a run takes longer. Code that runs in processes of its own, as
the command line does in some tests, is not seen; nor is what is raised where the stack is full: following ends there.

Test: tests/test_raise_coverage.py
"""

import ast
import sys
from pathlib import Path
from types import FrameType
from typing import Any

PACKAGE = Path(__file__).parents[1] / "torchmeso"


def raises(folder: Path) -> dict[str, dict[int, int]]:
    """Return, for each file of `folder`, the lines of its `raise` statements, by every line one stretches over.

    A bare `raise` only hands on what was raised elsewhere.
    """
    found: dict[str, dict[int, int]] = {}
    for path in sorted(folder.rglob("*.py")):
        nodes = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Raise) and n.exc is not None]
        lines = {line: n.lineno for n in nodes for line in range(n.lineno, (n.end_lineno or n.lineno) + 1)}
        if lines:
            found[str(path)] = lines
    return found


class Watch:
    """Notes which `raise` statements are reached while it is on."""

    def __init__(self, folder: Path = PACKAGE):
        self.raises, self.reached = raises(folder), set()

    def __enter__(self) -> "Watch":
        sys.settrace(self._call)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(None)

    def missed(self) -> list[tuple[str, int]]:
        """Return file and line of every `raise` that was not reached."""
        every = {(file, line) for file, lines in self.raises.items() for line in lines.values()}
        return sorted(every - self.reached)

    def _call(self, frame: FrameType, event: str, argument: Any) -> Any:
        if frame.f_code.co_filename not in self.raises:
            return None
        frame.f_trace_lines = False  # exceptions are enough
        return self._within

    def _within(self, frame: FrameType, event: str, argument: Any) -> Any:
        if event == "exception":
            file = frame.f_code.co_filename
            start = self.raises[file].get(frame.f_lineno)
            if start is not None:
                self.reached.add((file, start))
        return self._within


def pytest_runtest_call(item: Any) -> None:
    _watch.__enter__()


def pytest_runtest_teardown(item: Any) -> None:
    _watch.__exit__()


def pytest_terminal_summary(terminalreporter: Any) -> None:
    missed = _watch.missed()
    terminalreporter.write_line(f"{len(missed)} raise statements were not reached:")
    for file, line in missed:
        text = Path(file).read_text().splitlines()[line - 1].strip()
        terminalreporter.write_line(f"  {Path(file).relative_to(PACKAGE.parent)}:{line}  {text}")


_watch = Watch()
