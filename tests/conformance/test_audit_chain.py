"""Whatever is changed behind the back of the program is found in the chain of the audit."""

from __future__ import annotations

import random
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import Table, delete, func, insert, select, text, update
from sqlalchemy.orm import Session
from support.command import answer, service
from support.deployments import Deployment, mainly
from support.homes import make_home
from support.jobs import JOBS, NOW, submit_pipeline

from sms_jobs.catalogue import audit, sealing
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.deeds import Deed
from sms_jobs.catalogue.tables.audit import AuditRow
from sms_jobs.catalogue.tables.jobs import EventRow
from sms_jobs.catalogue.tables.saved_queries import SavedQueryRow
from sms_jobs.records.job import JobState
from sms_jobs.records.people import Actor, Role

ANNA = Actor("anna", Role.METROLOGIST, "web", "10.0.0.7", reason="as agreed, äöü")
LINK, EVENT = AuditRow.__table__, EventRow.__table__


def deed(number: int) -> Deed:
    return Deed(ANNA, "jobs.cancel", {"number": number, "share": number / 7, "of": ["a", None, True]})


def add_links(session: Session, count: int) -> None:
    for number in range(count):
        audit.append(session, deed(number), NOW + timedelta(seconds=number))


def add_events(session: Session, jobs: tuple[str, ...], count: int) -> None:
    same = {"at": NOW, "state": JobState.QUEUED}
    rows = [
        {"job_id": jobs[n % len(jobs)], "attempt": n, "message": f"message {n}"} | same for n in range(count)
    ]
    session.execute(insert(EventRow), rows)


@pytest.fixture(params=[1_500, pytest.param(10_000, marks=pytest.mark.long)])
def many(request: pytest.FixtureRequest) -> tuple[int, int]:
    """How many links and events there are."""
    return 2 * request.param // 5, 3 * request.param // 5


@pytest.fixture
def filled(catalogue: Catalogue, many: tuple[int, int]) -> Catalogue:
    """A catalogue with many links and sealed events; a seal is the last of them."""
    links, events = many
    jobs = submit_pipeline(catalogue)
    with catalogue.writing() as session:
        for _ in range(10):
            add_links(session, links // 10)
            add_events(session, jobs, events // 10)
            audit.seal_events(session, NOW)
    return catalogue


def other(value: Any, chance: random.Random, name: str) -> Any:
    """Return another value that a column takes."""
    if isinstance(value, datetime):
        return value + timedelta(microseconds=chance.choice([-1, 1, 10**9]))
    if isinstance(value, JobState):
        return chance.choice([s for s in JobState if s is not value])
    if isinstance(value, dict):
        return chance.choice([value | {"more": 1}, {}, dict.fromkeys(value, 0)])
    if name == "seal_id":
        return chance.choice([None, value - 1, 10**9])
    if isinstance(value, int):
        return 10**7 + chance.randrange(10**6) if name == "id" else value + chance.choice([-1, 1])
    return "f" * 64 if name == "digest" else value[: chance.randrange(len(value))]


def changed(session: Session, table: Table, key: int, values: dict[str, Any]) -> None:
    session.execute(update(table).where(table.c.id == key).values(values))


def row_of(session: Session, table: Table, key: int) -> dict[str, Any]:
    return dict(session.execute(select(table).where(table.c.id == key)).mappings().one())


def a_row(session: Session, table: Table, chance: random.Random) -> dict[str, Any]:
    last = session.scalar(select(func.max(table.c.id))) or 0
    return row_of(session, table, chance.randrange(1, last + 1))


def edits(session: Session, chance: random.Random) -> list[tuple[str, Callable[[], None]]]:
    """Return a random change of every column of both tables."""
    found: list[tuple[str, Callable[[], None]]] = []
    for table in (LINK, EVENT):
        for column in table.c:
            row = a_row(session, table, chance)
            if column.name == "job_id":
                others = select(EventRow.job_id).where(EventRow.job_id != row["job_id"])
                new = session.scalars(others.limit(1)).one()
            else:
                new = other(row[column.name], chance, column.name)
            what = f"{table.name} {row['id']}: {column.name} = {new!r}"
            values = {column.name: new}
            found.append((what, lambda t=table, r=row, v=values: changed(session, t, r["id"], v)))
    return found


def deletions(session: Session, chance: random.Random) -> list[tuple[str, Callable[[], None]]]:
    found: list[tuple[str, Callable[[], None]]] = []
    for table in (LINK, EVENT):
        last = session.scalar(select(func.max(table.c.id))) or 0
        for first, end in [(1, 1), (last, last), (last - 3, last), (k := chance.randrange(2, last), k)]:
            gone = table.c.id.between(first, end)
            what = f"{table.name} {first} to {end} gone"
            found.append((what, lambda t=table, g=gone: void(session, delete(t).where(g))))
    return found


def void(session: Session, statement: Any) -> None:
    session.execute(statement)


def insertions(session: Session, chance: random.Random) -> list[tuple[str, Callable[[], None]]]:
    link, event = a_row(session, LINK, chance), a_row(session, EVENT, chance)
    last = session.scalar(select(func.max(LINK.c.id))) or 0
    new = session.scalar(select(func.max(EVENT.c.id))) or 0
    return [
        ("a link put behind the last", lambda: void(session, insert(LINK).values(link | {"id": last + 1}))),
        ("a link far behind", lambda: void(session, insert(LINK).values(link | {"id": last + 9}))),
        ("a link before the first", lambda: void(session, insert(LINK).values(link | {"id": 0}))),
        ("an event put in", lambda: void(session, insert(EVENT).values(event | {"id": new + 1}))),
        (
            "an event of no seal",
            lambda: void(session, insert(EVENT).values(event | {"id": new + 1, "seal_id": last - 1})),
        ),
    ]


def exchanges(session: Session, chance: random.Random) -> list[tuple[str, Callable[[], None]]]:
    found: list[tuple[str, Callable[[], None]]] = []
    for table in (LINK, EVENT):
        one, two = a_row(session, table, chance), a_row(session, table, chance)
        if one["id"] == two["id"]:
            continue

        def exchange(t: Table = table, a: dict[str, Any] = one, b: dict[str, Any] = two) -> None:
            changed(session, t, a["id"], b | {"id": a["id"]})
            changed(session, t, b["id"], a | {"id": b["id"]})

        found.append((f"{table.name} {one['id']} and {two['id']} exchanged", exchange))
    return found


def test_whatever_is_changed_among_many_is_found(filled: Catalogue, many: tuple[int, int]) -> None:
    links, events = many
    chance = random.Random(20_031)
    missed = []
    with filled.writing() as session:
        assert list(audit.breaks(session)) == []
        assert audit.extent(session) == (links + 10, events + JOBS)
        tried = [one for some in (edits, deletions, insertions, exchanges) for one in some(session, chance)]
        assert len(tried) > 30
        for what, tamper in tried:
            with session.begin_nested() as back:
                tamper()
                session.expire_all()
                if next(audit.breaks(session), None) is None:
                    missed.append(what)
                back.rollback()
        assert list(audit.breaks(session)) == []
        session.rollback()
    assert missed == []


def test_the_place_is_named(catalogue: Catalogue) -> None:
    jobs = submit_pipeline(catalogue)
    with catalogue.writing() as session:
        add_links(session, 5)
        add_events(session, jobs, 3)
        audit.seal_events(session, NOW)
        last, digest = audit.head(session)
        said = {}
        for name, statement in {
            "edited": update(LINK).where(LINK.c.id == 3).values(who="eve"),
            "gone": delete(LINK).where(LINK.c.id == 3),
            "event": update(EVENT).where(EVENT.c.id == 2).values(message="no"),
            "end": delete(LINK).where(LINK.c.id == last),
        }.items():
            with session.begin_nested() as back:
                session.execute(statement)
                session.expire_all()
                said[name] = list(audit.breaks(session, (last, digest)))
                back.rollback()
        session.rollback()
    assert said["edited"] == ["audit 3 (jobs.cancel by eve) is not as it was written, or the one before it"]
    assert said["gone"][0] == "audit 3 to 3 are missing"
    (event,) = said["event"]
    assert event.startswith(f"events of jobs that audit {last} holds were changed, put in or taken away: ")
    assert said["end"] == [
        f"audit {last} to {last} are missing: {last} was kept elsewhere as the last",
        f"{JOBS + 3} events of jobs were sealed by audit {last}, and the chain ends at {last - 1}",
    ]


def test_a_head_that_was_kept_elsewhere_shows_what_the_chain_cannot(catalogue: Catalogue) -> None:
    with catalogue.writing() as session:
        add_links(session, 9)
        kept = audit.head(session)
        add_links(session, 3)
        assert list(audit.breaks(session, kept)) == []
        session.execute(delete(LINK).where(LINK.c.id > 6))
        session.expire_all()
        # Whoever may change everything makes it whole again.
        assert list(audit.breaks(session)) == []
        assert list(audit.breaks(session, kept)) == [
            "audit 7 to 9 are missing: 9 was kept elsewhere as the last"
        ]
        add_links(session, 9)
        assert list(audit.breaks(session)) == []
        assert list(audit.breaks(session, kept)) == [
            "audit 9 is not the one that was kept elsewhere: the chain was written anew"
        ]
        session.rollback()


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE audit SET at = 'yesterday' WHERE id = 3",
        "UPDATE audit SET arguments = '{' WHERE id = 3",
        "UPDATE audit SET arguments = 7 WHERE id = 3",
        "UPDATE event SET state = 'never' WHERE id = 2",
        "UPDATE event SET at = 5 WHERE id = 2",
    ],
)
def test_what_is_no_value_of_its_column_is_found_too(catalogue: Catalogue, statement: str) -> None:
    if catalogue.dialect == "postgresql":
        pytest.skip("PostgreSQL takes no such value")
    submit_pipeline(catalogue)
    with catalogue.writing() as session:
        add_links(session, 5)
        audit.seal_events(session, NOW)
        session.expire_all()
        session.execute(text(statement))
        assert len(list(audit.breaks(session))) >= 1
        session.rollback()


def test_events_are_sealed_once_and_all(catalogue: Catalogue) -> None:
    jobs = submit_pipeline(catalogue)
    with catalogue.writing() as session:
        add_events(session, jobs, 12_000)
    assert sealing.seal(catalogue, NOW) == 12_000 + JOBS
    assert sealing.seal(catalogue, NOW) == 0
    with catalogue.reading() as session:
        number, _ = audit.head(session)
        assert number == 3
        assert list(audit.breaks(session)) == []


def test_an_event_that_is_committed_while_others_are_sealed_is_left_for_later(catalogue: Catalogue) -> None:
    if catalogue.dialect == "sqlite":
        pytest.skip("SQLite has one writer at a time")
    jobs = submit_pipeline(catalogue)
    with catalogue.writing() as slow:
        add_events(slow, jobs, 1)
        with catalogue.writing() as fast:
            add_events(fast, jobs, 1)
        # The slow one has the lower number and is not seen yet.
        assert sealing.seal(catalogue, NOW) == JOBS + 1
    assert sealing.seal(catalogue, NOW) == 1
    with catalogue.reading() as session:
        assert list(audit.breaks(session)) == []


@pytest.mark.parametrize("deployment", mainly("grown"), indirect=True)
def test_the_service_seals_what_happens_to_jobs(deployment: Deployment) -> None:
    make_home(deployment.home, deployment.environment)
    words = ["job", "submit", "simulate", "-c", "plate", "--wait", "--home", str(deployment.home)]
    with service(deployment.home, deployment.environment):
        answer(*words, environment=deployment.environment)
    with closing(deployment.catalogue()) as catalogue, catalogue.reading() as session:
        assert audit.extent(session)[1] > 0
        assert not audit.unsealed(session)
        assert list(audit.breaks(session)) == []


def test_a_deed_is_told_in_the_transaction_of_its_change(catalogue: Catalogue) -> None:
    for number in (1, 2):
        with catalogue.writing():
            pass  # what is no deed of anybody leaves those alone that follow
        noting = catalogue.for_deed(deed(number))
        with pytest.raises(RuntimeError), noting.writing():
            raise RuntimeError
        with noting.writing():
            pass  # nor is what changes nothing told
        for name, part in (("a", noting), ("b", noting.for_deed(deed(99)))):
            with part.writing() as session:
                session.add(SavedQueryRow(name=f"{name}{number}", text="strain", saved_at=NOW))
    with catalogue.reading() as session:
        told = audit.listed(session, who="anna", action="jobs", since=NOW, limit=9)
    assert [link.arguments["number"] for link in told] == [2, 1]
    assert datetime.now(UTC) - told[0].at < timedelta(minutes=5)
