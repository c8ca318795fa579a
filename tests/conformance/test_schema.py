"""The schema that the migrations build is the one that the models describe."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest
from alembic import command
from sqlalchemy import select, text
from support.jobs import submit_pipeline

from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.saved_queries import SavedQueryRow
from sms_jobs.errors import OtherFormat


def test_the_migrated_schema_equals_the_models(catalogue: Catalogue) -> None:
    assert schema.differences_from_models(catalogue) == []
    assert schema.current_revision(catalogue) == schema.newest_revision()


def test_a_difference_from_the_models_is_noticed(catalogue: Catalogue) -> None:
    with catalogue.writing() as session:
        session.execute(text("ALTER TABLE channel ADD COLUMN unexpected INTEGER"))
    assert any("unexpected" in difference for difference in schema.differences_from_models(catalogue))


def test_upgrading_again_changes_nothing(catalogue: Catalogue) -> None:
    with catalogue.writing() as session:
        session.add(SavedQueryRow(name="kept", text="strain", saved_at=datetime.now(UTC)))
    schema.upgrade(catalogue)
    schema.require_current(catalogue)
    assert schema.differences_from_models(catalogue) == []
    with catalogue.reading() as session:
        assert session.scalars(select(SavedQueryRow.text)).all() == ["strain"]


def test_a_catalogue_in_use_is_taken_down_and_made_again(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        configuration = schema.configuration()
        configuration.attributes["connection"] = session.connection()
        command.downgrade(configuration, "base")
    assert schema.current_revision(catalogue) is None
    schema.upgrade(catalogue)
    assert schema.differences_from_models(catalogue) == []
    with catalogue.reading() as session:
        assert session.scalars(select(JobRow.id)).all() == []


def test_a_catalogue_from_before_the_first_release_is_refused(catalogue: Catalogue) -> None:
    with catalogue.writing() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '0016'"))
    for refuse in (schema.require_current, schema.upgrade):
        with pytest.raises(OtherFormat, match=r"0016, from before the first release.*'sms init'"):
            refuse(catalogue)


def test_a_newer_catalogue_is_refused_with_both_revisions_named(catalogue: Catalogue) -> None:
    with catalogue.writing() as session:
        session.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    for refuse in (schema.require_current, schema.upgrade):
        with pytest.raises(OtherFormat, match=f"9999.*{schema.newest_revision()}"):
            refuse(catalogue)
