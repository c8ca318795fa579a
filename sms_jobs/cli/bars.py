"""Bars on stderr that show how long work comes along; silent when nobody watches."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from sms_jobs.app.progress import Step, Tell

_remarks = Console(stderr=True, highlight=False, markup=False, emoji=False)


def progress_bar() -> Progress:
    """Return a progress bar on stderr, with counts and time left; silent when nobody watches."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=_remarks,
        disable=not _remarks.is_terminal,
    )


def job_bar() -> Progress:
    """Return a progress bar on stderr whose task's field `pace` says rate and time left."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[pace]}", markup=False),
        console=_remarks,
        disable=not _remarks.is_terminal,
    )


def byte_bar() -> Progress:
    """Return a progress bar on stderr, with bytes, rate and time left; silent when nobody watches."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
        console=_remarks,
        disable=not _remarks.is_terminal,
    )


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
