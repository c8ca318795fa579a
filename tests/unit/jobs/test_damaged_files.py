"""A job with an altered input fails and says so; an altered result is computed again, not reused."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy import select
from support.archives import Clock, registered, run_jobs

from sms_jobs.archive import Archive, FolderStore
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.jobs.asking import explanation
from sms_jobs.jobs.planning.graph import Request
from sms_jobs.jobs.running import recovery, runner
from sms_jobs.records.job import JobState

REST = Request("reconstruct", states=("S00",))


class Recorded:
    """A small campaign that was recorded and whose state at rest has its shape."""

    def __init__(self, folder: Path) -> None:
        self.archive, self.clock = Archive(FolderStore(folder / "archive")), Clock()
        self.catalogue = Catalogue(f"sqlite:///{folder / 'catalogue.sqlite'}", create=True)
        schema.upgrade(self.catalogue)
        registered(self.catalogue, self.archive, self.clock)
        with self.catalogue.writing() as session:
            recovery.register_worker(session, "w1", "here", 1, ["cpu", "acquisition"], 1, self.clock())
        self.run(Request("simulate"))
        (self.first,) = self.run(REST)

    def run(self, *requests: Request) -> tuple[str, ...]:
        return run_jobs(self.catalogue, self.archive, self.clock, requests)

    def job(self, job_id: str) -> JobRow:
        with self.catalogue.reading() as session:
            return session.get_one(JobRow, job_id)

    def files(self, source: str) -> list[FileRow]:
        with self.catalogue.reading() as session:
            return list(session.scalars(select(FileRow).where(FileRow.source == source).order_by(FileRow.id)))

    def bytes_of(self, file: FileRow) -> Path:
        path = self.archive.store.path(file.path)
        path.chmod(0o644)
        return path

    def explained(self, job_id: str) -> str:
        with self.catalogue.reading() as session:
            return " ".join(explanation.explain(session, session.get_one(JobRow, job_id), self.clock()))


@pytest.fixture
def recorded(home: Path) -> Iterator[Recorded]:
    made = Recorded(home)
    with closing(made.catalogue):
        yield made


def test_jobs_fail_whose_inputs_are_not_what_was_sealed(recorded: Recorded) -> None:
    (calibration,) = recorded.files("calibration")
    file = recorded.bytes_of(calibration)
    good = file.read_bytes()
    place = good.index(b'"fx":') + len(b'"fx":')
    file.write_bytes(good[:place] + bytes([good[place] ^ 1]) + good[place + 1 :])
    changed = Request("reconstruct", {"minimum_modulation_to_noise": 7.0}, ("S00",))
    (job,) = recorded.run(changed)
    row = recorded.job(job)
    assert row.state is JobState.FAILED
    for word in (calibration.path, calibration.sha256[:12], "sms archive repair", "backup"):
        assert word in (row.error or "")
    file.write_bytes(good)

    at_rest, deformed = (recorded.bytes_of(f) for f in recorded.files("measurement"))
    one, other = at_rest.read_bytes(), deformed.read_bytes()
    at_rest.write_bytes(other)
    deformed.write_bytes(one)
    for state in ("S00", "S01"):
        (job,) = recorded.run(Request("reconstruct", {"minimum_modulation_to_noise": 8.0}, (state,)))
        assert recorded.job(job).state is JobState.FAILED
        assert "is not what was sealed" in (recorded.job(job).error or "")
    at_rest.write_bytes(one)
    deformed.write_bytes(other)
    (job,) = recorded.run(Request("reconstruct", {"minimum_modulation_to_noise": 8.0}, ("S00",)))
    assert recorded.job(job).state is JobState.SUCCEEDED


# Small results are read in the transaction that looks for them, large ones outside.
@pytest.mark.parametrize("at_once", [0, 1 << 30])
def test_an_altered_result_is_computed_again_and_then_reused(
    recorded: Recorded, at_once: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "_READ_AT_ONCE_BYTES", at_once)
    (job,) = recorded.run(REST)
    assert recorded.job(job).reused_from == recorded.first
    (result,) = recorded.files("reconstruct")
    file = recorded.bytes_of(result)
    good = file.read_bytes()
    # In the middle lies what no text or digest tells of: the values of an array.
    file.write_bytes(good[: len(good) // 2] + bytes([good[len(good) // 2] ^ 16]) + good[len(good) // 2 + 1 :])
    (again,) = recorded.run(REST)
    row = recorded.job(again)
    assert (row.state, row.reused_from) == (JobState.SUCCEEDED, None)
    why = recorded.explained(again)
    assert f"not reused from job {recorded.first[:8]}" in why
    assert result.path in why
    assert recorded.files("reconstruct")[1].content_hash == result.content_hash
    (third,) = recorded.run(REST)
    assert recorded.job(third).reused_from == again
