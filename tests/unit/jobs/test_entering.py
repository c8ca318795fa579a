"""Sealed files are entered, or taken out again: never when nobody knows whether they were entered."""

from __future__ import annotations

from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import event

from sms_jobs.archive import Archive
from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.errors import CommitInDoubt
from sms_jobs.jobs import acceptances
from sms_jobs.jobs.entering import entered_or_discarded
from sms_jobs.jobs.registration import register_campaign, seal_definition
from sms_jobs.records.campaign import CampaignDefinition
from sms_jobs.virtual_rig.campaigns import small_plate

NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)


@pytest.mark.parametrize(
    ("error", "stays"), [(ValueError, False), (KeyboardInterrupt, False), (CommitInDoubt, True)]
)
def test_what_fails_leaves_no_file_but_one_that_may_be_known(
    tmp_path: Path, error: type[BaseException], stays: bool
) -> None:
    archive = Archive(tmp_path)
    _, campaign = small_plate("plate")

    def fail() -> None:
        with entered_or_discarded(archive) as sealed:
            sealed.append(seal_definition(archive, CampaignDefinition(campaign), NOW))
            raise error("so it is")

    with pytest.raises(error):
        fail()
    assert bool(list(archive.files())) is stays


@pytest.mark.parametrize("error", [OSError, CommitInDoubt])
def test_a_decision_that_may_have_been_entered_keeps_its_file(tmp_path: Path, error: type[Exception]) -> None:
    archive = Archive(tmp_path / "archive")
    with closing(Catalogue(f"sqlite:///{tmp_path / 'catalogue.sqlite'}", create=True)) as catalogue:
        schema.upgrade(catalogue)
        calibration, campaign = small_plate("plate")
        register_campaign(catalogue, archive, campaign, calibration, NOW)
        before = set(archive.files())

        def break_commit(_: Any) -> None:
            raise error("the connection broke")

        event.listen(catalogue.engine, "commit", break_commit)
        with pytest.raises(error):
            acceptances.accept(catalogue, archive, 1, None, NOW)
        left = set(archive.files()) - before
    assert len(left) == (1 if error is CommitInDoubt else 0)
