"""Datasets whose records are at hand: what a kind's `run` needs without an archive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from sms_jobs.kinds.kind import DatasetOutput, Inputs, Kind, Progress
from sms_jobs.records.subject import Subject

R = TypeVar("R")


@dataclass(frozen=True)
class InMemory:
    """Records under the names that a file would have them."""

    subject: Subject
    records: Mapping[str, Any]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the records it holds."""
        return tuple(self.records)

    def read(self, name: str, record: type[R]) -> R:
        """Return one record."""
        assert isinstance(self.records[name], record)
        return cast(R, self.records[name])


def unheard(fraction: float, message: str = "") -> None:
    """Take progress and say nothing."""


def run_kind(
    kind: Kind[Any],
    subject: Subject,
    records: Mapping[str, Any],
    threads: int,
    parameters: Any,
    progress: Progress = unheard,
) -> DatasetOutput:
    """Run a kind that makes one dataset of one record from each of its needs, by role."""
    datasets = {role: InMemory(subject, {role: record}) for role, record in records.items()}
    inputs = Inputs(subject, None, datasets, threads)
    (output,) = map(kind.checked, kind.run(inputs, parameters, progress))
    assert isinstance(output, DatasetOutput)
    return output
