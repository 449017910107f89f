"""What the commands share: progress bars, and not to replace what is there.

Test: tests/test_cli.py
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from torchmeso.errors import ConfigError


def refuse_to_replace(path: Any, force: bool) -> None:
    """Raise ConfigError where a file stands in the place of a result, and is not to be replaced."""
    from pathlib import Path

    if Path(path).exists() and not force:
        raise ConfigError(f"{path}: exists already; give --force to replace it")


@contextmanager
def progress() -> Iterator[Any]:
    """Yield a report function that draws progress bars on stderr; quiet when stderr is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn()
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        tasks: dict[str, Any] = {}

        def report(what: str, share: float) -> None:
            if what not in tasks:
                tasks[what] = bars.add_task(what, total=1.0)
            bars.update(tasks[what], completed=share)

        yield report
