"""A runner that computes a result once in a process of the tests, whatever archive it is for.

Tests of the archive and the catalogue need real results of real jobs, and the same ones again and again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from sms_jobs.jobs.results import reuse
from sms_jobs.jobs.running.lifecycle import Claim
from sms_jobs.jobs.running.runner import Runner
from sms_jobs.kinds.documents import DocumentOutput
from sms_jobs.kinds.kind import DatasetOutput, Inputs, Kind, Output, Progress
from sms_jobs.records.measurement import ArrayStack, FrameStack, Measurement

_made: dict[tuple[object, str], tuple[Output, ...]] = {}


class Remembering(Runner):
    """Runs jobs as `Runner` does, but for what a job of the same reuse key has computed in this process."""

    def _sealed_outputs(self, kind: Kind[Any], held: Claim, task: Any, progress: Any) -> Iterator[Any]:
        if kind.with_instruments or not held.repeatable:
            return super()._sealed_outputs(kind, held, task, progress)
        hashes = {one.role: one.content_hash for one in task.inputs}
        key = kind.run, reuse.reuse_key(kind, held.subject, held.parameters, task.context, hashes)

        def run(inputs: Inputs, parameters: Any, progress: Progress) -> Iterator[Output]:
            if key not in _made:
                _made[key] = tuple(map(_kept, kind.run(inputs, parameters, progress)))
            yield from _made[key]

        return super()._sealed_outputs(replace(kind, run=run), held, task, progress)


def _kept(output: Output) -> Output:
    """Return an output that needs neither the job's inputs any more nor anything to be computed."""
    if isinstance(output, DocumentOutput):
        with TemporaryDirectory() as folder:
            file = Path(folder) / output.filename
            output.write(file)
            written = file.read_bytes()

        def write(path: Path) -> None:
            path.write_bytes(written)

        return replace(output, write=write)
    products = {product: _in_memory(record) for product, record in output.products.items()}
    return DatasetOutput(output.subject, products, output.statistics)


def _in_memory(record: Any) -> Any:
    if not isinstance(record, Measurement):
        return record
    return replace(record, frames=_stack(record.frames))


def _stack(frames: FrameStack) -> ArrayStack:
    return ArrayStack(frames.rows(0, frames.shape[1]))
