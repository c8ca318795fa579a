"""What is put into the archive is sealed and entered, or leaves nothing, unless nobody knows which."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event, func, select

from sms_jobs.archive import Archive, MemoryStore
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.errors import CommitInDoubt, Conflict
from sms_jobs.jobs.archiving import acceptances
from sms_jobs.jobs.archiving.indexing import CAMPAIGN
from sms_jobs.jobs.archiving.registration import defined, register_calibration, register_campaign
from sms_jobs.jobs.archiving.repository import Kept, Repository
from sms_jobs.records.campaign import CampaignDefinition
from sms_jobs.virtual_rig.campaigns import small_plate

NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)
CALIBRATED, PLATE = small_plate("plate")


@pytest.fixture
def repository(tmp_path: Path) -> Iterator[Repository]:
    with closing(Catalogue(f"sqlite:///{tmp_path / 'catalogue.sqlite'}", create=True)) as catalogue:
        schema.upgrade(catalogue)
        yield Repository(catalogue, Archive(MemoryStore()))


def entered(repository: Repository) -> int:
    with repository.catalogue.reading() as session:
        return session.scalar(select(func.count()).select_from(FileRow)) or 0


def put(repository: Repository, **options: Any) -> Kept:
    return repository.put({CAMPAIGN: CampaignDefinition(PLATE)}, defined("plate", NOW), **options)


def test_what_is_put_is_sealed_and_entered(repository: Repository) -> None:
    kept = put(repository)
    assert list(repository.archive.files()) == [kept.path]
    with repository.catalogue.reading() as session:
        row = session.get_one(FileRow, kept.file_id)
        assert (row.path, row.source) == (kept.path, CAMPAIGN)
        repository.archive.verify_bytes(row)
    assert kept.new


@pytest.mark.parametrize(
    ("error", "stays"), [(ValueError, False), (KeyboardInterrupt, False), (CommitInDoubt, True)]
)
def test_what_fails_leaves_no_file_but_one_that_may_be_known(
    repository: Repository, error: type[BaseException], stays: bool
) -> None:
    def fail(_: Any) -> None:
        raise error("so it is")

    with pytest.raises(error):
        put(repository, check=fail)
    assert bool(list(repository.archive.files())) is stays
    assert entered(repository) == 0


def test_several_files_come_in_together_or_not_at_all(repository: Repository) -> None:
    def half() -> None:
        with repository.batch() as batch:
            batch.seal({CAMPAIGN: CampaignDefinition(PLATE)}, defined("plate", NOW))
            batch.seal({"unknown": object()}, defined("plate", NOW))

    with pytest.raises(TypeError):
        half()
    assert list(repository.archive.files()) == []


def test_what_fails_after_a_batch_has_come_in_takes_nothing_away(repository: Repository) -> None:
    def late() -> None:
        with repository.batch() as batch:
            batch.seal({CAMPAIGN: CampaignDefinition(PLATE)}, defined("plate", NOW))
            batch.enter()
            raise Conflict("too late")

    with pytest.raises(Conflict):
        late()
    assert len(list(repository.archive.files())) == entered(repository) == 1


def test_the_same_calibration_is_kept_once(repository: Repository) -> None:
    catalogue, archive = repository.catalogue, repository.archive
    first = register_calibration(catalogue, archive, CALIBRATED, NOW)
    files = set(archive.files())
    again = register_calibration(catalogue, archive, CALIBRATED, NOW)
    assert (first.new, again.new, first.number) == (True, False, again.number)
    assert first.in_use
    assert again.in_use
    assert set(archive.files()) == files


def test_a_file_that_will_not_go_stays_and_is_named(
    repository: Repository, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    entry = repository.seal({CAMPAIGN: CampaignDefinition(PLATE)}, defined("plate", NOW))

    def refuse(_: Archive, path: str) -> None:
        raise PermissionError(path)

    monkeypatch.setattr(Archive, "discard", refuse)
    with caplog.at_level(logging.WARNING):
        repository.discard([entry])
    assert f"{entry.sealed.path} stays" in caplog.text


@pytest.mark.parametrize("error", [OSError, CommitInDoubt])
def test_a_decision_that_may_have_been_entered_keeps_its_file(
    repository: Repository, error: type[Exception]
) -> None:
    catalogue, archive = repository.catalogue, repository.archive
    register_campaign(catalogue, archive, PLATE, CALIBRATED, NOW)
    before = set(archive.files())

    def break_commit(_: Any) -> None:
        raise error("the connection broke")

    event.listen(catalogue.engine, "commit", break_commit)
    with pytest.raises(error):
        acceptances.accept(catalogue, archive, 1, None, NOW)
    left = set(archive.files()) - before
    assert len(left) == (1 if error is CommitInDoubt else 0)
