"""Bars on stderr that show how long work comes along; silent when nobody watches."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from sms_jobs.app.progress import Step, Tell

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn, TaskID


def progress_bar() -> Progress:
    """Return a bar with counts and time left."""
    from rich.progress import MofNCompleteColumn, TimeElapsedColumn, TimeRemainingColumn

    return _bar(MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())


def job_bar() -> Progress:
    """Return a bar whose task's field `pace` says rate and time left."""
    from rich.progress import MofNCompleteColumn, TextColumn, TimeElapsedColumn

    pace = TextColumn("{task.fields[pace]}", markup=False)
    return _bar(MofNCompleteColumn(), TimeElapsedColumn(), pace)


def byte_bar() -> Progress:
    """Return a bar with bytes, rate and time left."""
    from rich.progress import DownloadColumn, TimeRemainingColumn, TransferSpeedColumn

    return _bar(DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())


def _bar(*columns: ProgressColumn) -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    remarks = Console(stderr=True, highlight=False, markup=False, emoji=False)
    what = TextColumn("{task.description}", markup=False)
    return Progress(what, BarColumn(), *columns, console=remarks, disable=not remarks.is_terminal)


@contextmanager
def followed(bar: Progress) -> Iterator[Tell]:
    """Show on a bar how far a use case has come: a line for each of the things that it does."""
    lines: dict[str, TaskID] = {}

    def tell(step: Step) -> None:
        total = None if step.total is None else max(step.total, 1)
        if step.doing not in lines:
            lines[step.doing] = bar.add_task(step.doing, total=total)
        description = f"{step.doing} {step.detail}" if step.detail else step.doing
        bar.update(lines[step.doing], description=description, completed=step.done, total=total)

    with bar:
        yield tell
