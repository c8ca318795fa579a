"""Rows about some states of a campaign are those whose subjects say so, whatever the names look like."""

from __future__ import annotations

from sqlalchemy import String, create_engine, literal, select, union_all

from sms_jobs.catalogue.subjects import at_states
from sms_jobs.records.subject import Subject

LABELS = ("S0", "S00", "S000", "S1", "s0", "S0.5", "wing")
VIEWS = (None, "C1", "C1P1")


def test_the_database_finds_what_the_names_say() -> None:
    about = [Subject("wing"), *(Subject("wing", label, view) for label in LABELS for view in VIEWS)]
    column = literal("", String).label("subject")
    rows = union_all(*(select(literal(str(one), String).label(column.name)) for one in about)).subquery()
    engine = create_engine("sqlite://")
    with engine.connect() as connection:
        for wanted in ((), ("S0",), ("S00", "S1"), ("S0.5", "s0", "gone"), LABELS):
            found = connection.scalars(
                select(rows.c.subject).where(at_states(rows.c.subject, "wing", wanted))
            ).all()
            expected = [str(one) for one in about if one.state is None or one.state in wanted]
            assert sorted(found) == sorted(expected)
    engine.dispose()
