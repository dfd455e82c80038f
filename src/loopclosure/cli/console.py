"""What the command line says: results on stdout, progress and errors on stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from loopclosure.runs import RunProgress


def fail(message: str) -> int:
    """Print an error as one line on stderr and return the exit status."""
    print(f"error: {' '.join(message.split())}", file=sys.stderr)
    return 1


def print_json(value: Mapping[str, Any]) -> None:
    """Print one JSON object on stdout."""
    print(json.dumps(value, indent=2, allow_nan=False))


def say(text: str, *, quiet: bool = False) -> None:
    """Print a line of the result on stdout."""
    if not quiet:
        Console(highlight=False, soft_wrap=True).print(text, markup=False)


@contextmanager
def progress_bars(*, quiet: bool) -> Iterator[RunProgress]:
    """Give a ``progress(stage, done, total)`` that draws one bar a stage on stderr, if that is a screen."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    tasks: dict[str, Any] = {}
    with Progress(*columns, console=console, disable=quiet or not console.is_terminal) as bars:

        def report(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = bars.add_task(stage, total=total or None)
            bars.update(tasks[stage], completed=done, total=total or None)

        yield report
