"""Both databases take the same values, and refuse the same with the same words."""

from __future__ import annotations

from contextlib import closing
from datetime import UTC, datetime

import pytest
from sqlalchemy import func, select, update
from support.deployments import Deployment

from sms_jobs.catalogue import schema
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.campaigns import SpecimenRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.catalogue.tables.saved_queries import SavedQueryRow
from sms_jobs.errors import InvalidInput

NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)


def saved(catalogue: Catalogue, name: str, text: str = "strain", at: datetime = NOW) -> None:
    with catalogue.writing() as session:
        session.add(SavedQueryRow(name=name, text=text, saved_at=at))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a" * 65, "a name has 65 letters"),
        ("\u00df" * 65, "a name has 65 letters"),
        ("a\x00b", r"a name holds \\x00"),
        ("\x1b[2J", r"a name holds \\x1b"),
        ("\udcff", r"a name holds \\xff"),
    ],
)
def test_names_that_only_one_database_takes(catalogue: Catalogue, name: str, words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        saved(catalogue, name)
    with catalogue.reading() as session:
        assert session.scalars(select(SavedQueryRow)).all() == []
        # To ask for it is no error; there is none.
        assert session.scalar(select(SavedQueryRow.id).where(SavedQueryRow.name == name)) is None
        assert session.scalar(select(SavedQueryRow.id).where(SavedQueryRow.name.startswith(name))) is None
        assert session.scalar(select(SavedQueryRow.id).where(SavedQueryRow.name.in_([name]))) is None


def test_names_and_texts_within_the_limits(catalogue: Catalogue) -> None:
    saved(catalogue, "\u00df" * 64, "line\n\ttwo \U0001f527\r\n")
    with catalogue.reading() as session:
        row = session.scalars(select(SavedQueryRow).where(SavedQueryRow.name == "\u00df" * 64)).one()
        assert row.text == "line\n\ttwo \U0001f527\r\n"


@pytest.mark.parametrize("year", [1, 1899, 2200, 9999])
def test_times_that_no_test_can_have_had(catalogue: Catalogue, year: int) -> None:
    with pytest.raises(InvalidInput, match="is not in the years 1900 to 2199"):
        saved(catalogue, "any", at=datetime(year, 1, 1, tzinfo=UTC))


def test_numbers_beyond_the_databases(catalogue: Catalogue) -> None:
    with (
        pytest.raises(InvalidInput, match="more than the catalogue can hold"),
        catalogue.writing() as session,
    ):
        session.add(SpecimenRow(id=2**64, name="a", material="", description=""))


def test_what_libraries_say_is_made_fit(catalogue: Catalogue) -> None:
    with catalogue.writing() as session:
        # No job is there; what is bound is what counts.
        session.execute(update(JobRow).values(error="broke\x00 \x1b[2J \udcff"))
    assert schema.differences_from_models(catalogue) == []


def test_a_reader_sees_one_state_whatever_others_commit(catalogue: Catalogue, deployment: Deployment) -> None:
    saved(catalogue, "before")
    count = select(func.count()).select_from(SavedQueryRow)
    with closing(deployment.catalogue()) as other, catalogue.reading() as session:
        assert session.scalar(count) == 1
        saved(other, "meanwhile")
        assert session.scalar(count) == 1
    with catalogue.reading() as session:
        assert session.scalar(count) == 2
