"""People, their passwords, tokens and sessions, on both databases."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from statistics import median

import pytest
from argon2 import PasswordHasher
from pydantic import SecretStr
from sqlalchemy import select, update
from support.deployments import Deployment

from sms_jobs import bootstrap
from sms_jobs.app.accounts import people
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.tables.access import AccessRow
from sms_jobs.catalogue.tables.audit import AuditRow
from sms_jobs.catalogue.tables.people import PersonRow
from sms_jobs.errors import Conflict, InvalidInput, NotAllowed, NotFound
from sms_jobs.records.people import ANONYMOUS, Actor, Role

HERS, HIS, WRONG = (
    SecretStr("correct horse battery"),
    SecretStr("staple of the hall"),
    SecretStr("not this one"),
)


@pytest.fixture
def desk(deployment: Deployment) -> Iterator[Services]:
    """Services of the account that owns the home; anna is an administrator, ben an analyst."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in deployment.environment.items():
            patch.setenv(name, value)
        bootstrap.initialise(deployment.home)
        with bootstrap.services(deployment.home) as services:
            people.add(services, "anna", Role.ADMINISTRATOR, HERS)
            people.add(services, "ben", Role.ANALYST, HIS)
            yield services


@pytest.fixture
def door(desk: Services) -> Services:
    """Services for whoever has not logged in."""
    return desk.acting(replace(ANONYMOUS, origin="10.0.0.7"))


def inside(door: Services, secret: str) -> Services:
    return door.acting(people.actor_of(door, secret, "10.0.0.7"))


def set_rows(desk: Services, row: type, **values: object) -> None:
    with desk.catalogue.writing() as session:
        session.execute(update(row).values(**values))


def links(desk: Services) -> list[AuditRow]:
    with desk.catalogue.reading() as session:
        return list(session.scalars(select(AuditRow).order_by(AuditRow.id)))


def fail(door: Services, times: int, name: str = "anna") -> None:
    for _ in range(times):
        with pytest.raises(NotAllowed):
            people.log_in(door, name, WRONG)


def test_the_first_is_an_administrator_and_the_last_one_stays(desk: Services) -> None:
    for refused in (
        lambda: people.set_role(desk, "anna", Role.VIEWER),
        lambda: people.set_active(desk, "anna", False),
    ):
        with pytest.raises(Conflict, match="anna is the last active administrator"):
            refused()
    people.set_role(desk, "ben", Role.ADMINISTRATOR)
    assert not people.set_active(desk, "anna", False).active
    with pytest.raises(Conflict, match="ben is the last"):
        people.set_role(desk, "ben", Role.OPERATOR)


def test_nobody_has_a_name_before_an_administrator_has(deployment: Deployment) -> None:
    with pytest.MonkeyPatch.context() as patch:
        for name, value in deployment.environment.items():
            patch.setenv(name, value)
        bootstrap.initialise(deployment.home)
        with bootstrap.services(deployment.home) as services:
            assert not people.has_people(services)
            with pytest.raises(Conflict, match="has to be an administrator, not viewer"):
                people.add(services, "ben", Role.VIEWER, HIS)
            people.add(services, "anna", Role.ADMINISTRATOR)
            assert people.has_people(services)


@pytest.mark.parametrize("name", ["", "a b", "nobody", "service", "x" * 65])
def test_a_name_that_is_none_is_refused(desk: Services, name: str) -> None:
    with pytest.raises(InvalidInput):
        people.add(desk, name, Role.VIEWER)


def test_a_name_is_taken_once(desk: Services) -> None:
    with pytest.raises(Conflict, match="anna"):
        people.add(desk, "anna", Role.VIEWER)
    # Of two names that a person takes for one, who did what would be mistaken.
    with pytest.raises(Conflict, match="there is already a person 'anna', and 'Anna' differs in case alone"):
        people.add(desk, "Anna", Role.VIEWER)


@pytest.mark.parametrize("length", [11, 1025])
def test_a_password_has_a_length_and_nothing_else(desk: Services, length: int) -> None:
    with pytest.raises(InvalidInput) as refused:
        people.add(desk, "eva", Role.VIEWER, SecretStr("z" * length))
    assert "zz" not in str(refused.value)
    for right in ("z" * 12, "ä" * 1024):
        people.set_password(desk, "ben", SecretStr(right))


def test_who_has_logged_in_is_known_until_the_log_out(door: Services) -> None:
    logged_in = people.log_in(door, "anna", HERS)
    assert (logged_in.name, logged_in.role) == ("anna", Role.ADMINISTRATOR)
    actor = people.actor_of(door, logged_in.secret, "10.0.0.8")
    assert actor == Actor("anna", Role.ADMINISTRATOR, "web", "10.0.0.8")
    people.log_out(door, logged_in.secret)
    people.log_out(door, logged_in.secret)
    with pytest.raises(NotAllowed, match="has ended"):
        people.actor_of(door, logged_in.secret, "")
    assert [(link.who, link.action) for link in links(door)][-2:] == [
        ("anna", "people.log_in"),
        ("anna", "people.log_out"),
    ]


def test_every_refusal_says_the_same(door: Services, desk: Services) -> None:
    people.add(desk, "eva", Role.VIEWER)
    people.add(desk, "max", Role.VIEWER, HIS)
    people.set_active(desk, "max", False)
    fail(door, 5)
    said = set()
    # Wrong, unknown, without a password, may not come in, locked, and longer than any password.
    tries = [("ben", WRONG), ("nobody-here", HIS), ("eva", HIS), ("max", HIS), ("anna", HERS)]
    for name, password in [*tries, ("ben", SecretStr("z" * 100_000)), ("ben", SecretStr("\ud800" * 20))]:
        with pytest.raises(NotAllowed) as refused:
            people.log_in(door, name, password)
        said.add(str(refused.value))
    assert len(said) == 1
    assert {link.arguments["refused"] for link in links(door) if "refused" in link.arguments} == {
        "anna",
        "ben",
        "eva",
        "an unknown name",
    }


def test_an_unknown_name_takes_as_long_as_a_wrong_password(
    door: Services, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(people, "_hasher", PasswordHasher)
    for name, password in (("anna", HERS), ("ben", HIS)):
        people.log_in(door, name, password)  # which hashes it anew

    def seconds(name: str) -> float:
        started = time.process_time()
        fail(door, 1, name)
        return time.process_time() - started

    seconds("ben")
    taken = [(seconds("ben" if n % 2 else "anna"), seconds("whoever")) for n in range(8)]
    known, unknown = (median(column) for column in zip(*taken, strict=True))
    assert unknown == pytest.approx(known, rel=0.5)
    assert unknown > 0.01


def test_five_wrong_passwords_lock_for_a_minute_and_each_further_twice_as_long(door: Services) -> None:
    def locked_for() -> list[float]:
        (anna, _) = people.list_people(inside_as_administrator(door))
        return [] if anna.locked_until is None else [(anna.locked_until - datetime.now(UTC)).total_seconds()]

    fail(door, 4)
    assert locked_for() == []
    for minutes in (1, 2, 4, 8, 16, 32, 60, 60):
        fail(door, 1)
        assert locked_for() == [pytest.approx(60.0 * minutes, abs=10.0)]
        with pytest.raises(NotAllowed):
            people.log_in(door, "anna", HERS)
        set_rows(door, PersonRow, locked_until=datetime.now(UTC) - timedelta(seconds=1))
    people.log_in(door, "anna", HERS)
    fail(door, 4)
    assert locked_for() == []


def inside_as_administrator(services: Services) -> Services:
    return services.acting(Actor("eve", Role.ADMINISTRATOR, "command", "here", confirmed=True))


def test_of_many_tries_at_once_five_are_answered(door: Services) -> None:
    def guess() -> None:
        with pytest.raises(NotAllowed):
            people.log_in(door, "anna", WRONG)

    crowd = [threading.Thread(target=guess) for _ in range(10)]
    for one in crowd:
        one.start()
    for one in crowd:
        one.join()
    with door.catalogue.reading() as session:
        anna = session.scalars(select(PersonRow).where(PersonRow.name == "anna")).one()
    assert anna.failures == 5
    assert anna.locked_until is not None


def test_the_actor_is_confirmed_by_the_password_alone(door: Services) -> None:
    services = inside(door, people.log_in(door, "ben", HIS).secret)
    assert not services.actor.confirmed
    with pytest.raises(NotAllowed):
        people.confirmed(services, HERS)
    again = people.confirmed(services, HIS)
    assert again == replace(services, actor=replace(services.actor, confirmed=True))
    fail(door, 4, "ben")
    with pytest.raises(NotAllowed):
        people.confirmed(services, WRONG)
    with pytest.raises(NotAllowed):
        people.log_in(door, "ben", HIS)


@pytest.mark.parametrize(
    ("row", "values"),
    [
        (AccessRow, {"expires_at": timedelta(seconds=-1)}),
        (AccessRow, {"used_at": timedelta(hours=-1)}),
        (AccessRow, {"created_at": timedelta(hours=-1), "used_at": None}),
        (AccessRow, {"revoked_at": timedelta()}),
        (PersonRow, {"active": False}),
    ],
)
def test_a_session_ends(door: Services, row: type, values: dict[str, timedelta | bool | None]) -> None:
    secret = people.log_in(door, "ben", HIS).secret
    people.actor_of(door, secret, "")
    now = datetime.now(UTC)
    set_rows(door, row, **{n: now + v if isinstance(v, timedelta) else v for n, v in values.items()})
    with pytest.raises(NotAllowed):
        people.actor_of(door, secret, "")


def test_use_is_noted_once_a_minute(door: Services) -> None:
    def used_at() -> datetime | None:
        with door.catalogue.reading() as session:
            return session.scalars(select(AccessRow.used_at)).one()

    secret = people.log_in(door, "ben", HIS).secret
    assert used_at() is None
    people.actor_of(door, secret, "")
    first = used_at()
    assert first is not None
    people.actor_of(door, secret, "")
    assert used_at() == first
    set_rows(door, AccessRow, used_at=first - timedelta(minutes=1))
    people.actor_of(door, secret, "")
    assert (used_at() or first) >= first


def test_a_person_who_may_not_come_in_is_out_at_once_and_stays_so(desk: Services, door: Services) -> None:
    session = people.log_in(door, "ben", HIS).secret
    token = people.create_token(inside(door, session), "nightly").secret
    people.set_active(desk, "ben", False)
    people.set_active(desk, "ben", True)
    for secret in (session, token):
        with pytest.raises(NotAllowed):
            people.actor_of(door, secret, "")
    people.log_in(door, "ben", HIS)


def test_a_changed_password_ends_sessions_and_leaves_tokens(desk: Services, door: Services) -> None:
    session = people.log_in(door, "ben", HIS).secret
    token = people.create_token(inside(door, session), "nightly").secret
    people.set_password(inside(door, session), "ben", HERS, HIS)
    with pytest.raises(NotAllowed):
        people.actor_of(door, session, "")
    assert people.actor_of(door, token, "").via == "token"
    with pytest.raises(NotAllowed):
        people.log_in(door, "ben", HIS)
    people.log_in(door, "ben", HERS)


def test_a_password_is_changed_by_who_knows_it_or_by_an_administrator(desk: Services, door: Services) -> None:
    ben = inside(door, people.log_in(door, "ben", HIS).secret)
    anna = inside(door, people.log_in(door, "anna", HERS).secret)
    refused: list[tuple[Services, str, SecretStr | None]] = [
        (ben, "ben", None),
        (ben, "ben", WRONG),
        (ben, "anna", HERS),
        (anna, "anna", None),
        (door, "ben", HIS),
        (door, "nobody", None),
    ]
    for services, name, old in refused:
        with pytest.raises(NotAllowed):
            people.set_password(services, name, SecretStr("another password"), old)
    people.set_password(anna, "ben", HERS)
    people.log_in(door, "ben", HERS)


def test_a_role_counts_from_the_next_request_on(desk: Services, door: Services) -> None:
    secret = people.log_in(door, "ben", HIS).secret
    with pytest.raises(NotAllowed, match=r"ben is analyst and may not administer \(people.list_people\)"):
        people.list_people(inside(door, secret))
    people.set_role(desk, "ben", Role.ADMINISTRATOR)
    assert [p.name for p in people.list_people(inside(door, secret))] == ["anna", "ben"]


def test_whoever_has_not_logged_in_may_do_nothing(door: Services) -> None:
    for use in (
        lambda: people.list_people(door),
        lambda: people.list_access(door),
        lambda: people.create_token(door, "x"),
        lambda: people.add(door, "eve", Role.ADMINISTRATOR, HIS),
    ):
        with pytest.raises(NotAllowed, match="log in, or give a token"):
            use()


def test_tokens_are_ones_own(desk: Services, door: Services) -> None:
    ben = inside(door, people.log_in(door, "ben", HIS).secret)
    anna = inside(door, people.log_in(door, "anna", HERS).secret)
    token = people.create_token(ben, "nightly", days=2)
    assert token.expires_at - datetime.now(UTC) == pytest.approx(timedelta(days=2), abs=timedelta(minutes=1))
    assert token.secret.startswith("sms_")
    assert [(a.sort, a.label) for a in people.list_access(ben)] == [("token", "nightly"), ("session", "")]
    assert people.list_access(anna, "ben") == people.list_access(ben)
    with pytest.raises(NotAllowed):
        people.list_access(ben, "anna")
    (hers,) = people.list_access(anna)
    with pytest.raises(NotFound):
        people.revoke(ben, hers.id)
    with pytest.raises(NotAllowed, match="a token makes no other"):
        people.create_token(inside(door, token.secret), "more")
    assert people.revoke(anna, token.id).person == "ben"
    with pytest.raises(NotAllowed):
        people.actor_of(door, token.secret, "")
    with pytest.raises(NotFound):
        people.revoke(ben, token.id)


@pytest.mark.parametrize(("label", "days"), [("", 1), (" ", 1), ("x" * 201, 1), ("x", 0), ("x", 367)])
def test_a_token_has_a_label_and_an_end(door: Services, label: str, days: int) -> None:
    ben = inside(door, people.log_in(door, "ben", HIS).secret)
    with pytest.raises(InvalidInput):
        people.create_token(ben, label, days)


def test_no_secret_is_kept_anywhere(desk: Services, door: Services, deployment: Deployment) -> None:
    secret = people.log_in(door, "ben", HIS).secret
    ben = inside(door, secret)
    token = people.create_token(ben.because(f"it replaces {secret}"), f"of {secret}").secret
    people.set_password(ben, "ben", HERS, HIS)
    with desk.catalogue.reading() as session:
        tables = [row.__table__ for row in (AuditRow, AccessRow, PersonRow)]
        kept = str([tuple(row) for table in tables for row in session.execute(select(table))])
    for given in (secret, token, HIS.get_secret_value(), HERS.get_secret_value()):
        assert given not in kept
        assert given.removeprefix("sms_") not in kept


def test_an_old_hash_is_renewed_by_the_next_log_in(door: Services) -> None:
    weak = PasswordHasher(time_cost=1, memory_cost=8, parallelism=1).hash(HIS.get_secret_value())
    set_rows(door, PersonRow, password=weak)
    people.log_in(door, "ben", HIS)
    with door.catalogue.reading() as session:
        stored = session.scalars(select(PersonRow.password).where(PersonRow.name == "ben")).one()
    assert stored != weak
    assert PasswordHasher().verify(stored or "", HIS.get_secret_value())
    people.log_in(door, "ben", HIS)


def test_two_administrators_cannot_end_each_other(desk: Services, door: Services) -> None:
    people.set_role(desk, "ben", Role.ADMINISTRATOR)
    refused = []

    def demote(name: str) -> None:
        try:
            people.set_role(desk, name, Role.VIEWER)
        except Conflict as error:
            refused.append(error)

    for _ in range(5):
        both = [threading.Thread(target=demote, args=(name,)) for name in ("anna", "ben")]
        for one in both:
            one.start()
        for one in both:
            one.join()
        assert len(refused) == 1
        refused.clear()
        for person in people.list_people(desk):
            if person.role is Role.VIEWER:
                people.set_role(desk, person.name, Role.ADMINISTRATOR)
