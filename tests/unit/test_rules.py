"""Every use case has a rule, which is kept; every change is told with who made it."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from typing import Any

import pytest
from sqlalchemy import select
from support.homes import initialised
from support.people import SOMEBODY

from sms_jobs import app, bootstrap
from sms_jobs.app import rules
from sms_jobs.app.holdings import finding
from sms_jobs.app.measuring import recordings
from sms_jobs.app.rules import Rule, require, rule_of, use_case
from sms_jobs.app.work import jobs, queues
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import audit
from sms_jobs.catalogue.tables.audit import AuditRow
from sms_jobs.errors import Conflict, InvalidInput, NotAllowed, NotFound, PasswordNeeded
from sms_jobs.records.people import RIGHTS, Right, Role

FIRST = "services"


def functions() -> Iterator[Callable[..., Any]]:
    """Yield the public functions of `app` that are given services first."""
    for module in walk_packages(app.__path__, f"{app.__name__}."):
        loaded = import_module(module.name)
        if loaded is rules:
            continue
        for name, found in inspect.getmembers(loaded, inspect.isfunction):
            first = next(iter(inspect.signature(found).parameters), "")
            if first == FIRST and not name.startswith("_") and found.__module__ == loaded.__name__:
                yield found


@pytest.fixture
def services(tmp_path: Path) -> Iterator[Services]:
    initialised(tmp_path / "home")
    with bootstrap.services(tmp_path / "home") as opened:
        yield opened.acting(SOMEBODY)


def told(services: Services) -> list[tuple[str, str, dict[str, Any]]]:
    with services.catalogue.reading() as session:
        rows = session.scalars(select(AuditRow).order_by(AuditRow.id)).all()
        assert list(audit.breaks(session)) == []
        return [(row.action, row.who, row.arguments) for row in rows]


def test_every_use_case_has_a_rule() -> None:
    found = list(functions())
    assert len(found) > 100
    assert [f"{f.__module__}.{f.__name__}" for f in found if rule_of(f) is None] == []


@pytest.mark.parametrize("role", Role)
@pytest.mark.parametrize("right", Right)
def test_a_role_may_do_what_its_rights_are(services: Services, role: Role, right: Right) -> None:
    acting = services.acting(replace(SOMEBODY, role=role))
    if right in RIGHTS[role]:
        require(acting, Rule("a.thing", right))
    else:
        with pytest.raises(NotAllowed, match=f"somebody is {role.value} and may not {right.value}"):
            require(acting, Rule("a.thing", right))


def test_what_asks_for_the_password_is_refused_until_it_was_given(services: Services) -> None:
    rule = Rule("a.thing", Right.CERTIFY, confirm=True)
    require(services, rule)
    with pytest.raises(PasswordNeeded, match="the password of somebody again"):
        require(services.acting(replace(SOMEBODY, confirmed=False)), rule)


def test_a_change_is_told_with_who_made_it(services: Services) -> None:
    queues.pause(services, ["cpu"], "lunch")
    assert told(services) == [("queues.pause", "somebody", {"names": ["cpu"], "reason": "lunch"})]


def test_what_reads_or_fails_is_not_told(services: Services) -> None:
    jobs.list_jobs(services)
    with pytest.raises(InvalidInput):
        queues.pause(services, ["nowhere"], "lunch")
    with pytest.raises(NotFound):
        finding.remove_query(services, "nothing")
    assert told(services) == []


def test_a_viewer_changes_nothing(services: Services) -> None:
    viewer = services.acting(replace(SOMEBODY, role=Role.VIEWER))
    assert queues.list_queues(viewer)
    with pytest.raises(NotAllowed, match="that is for operator, administrator"):
        queues.pause(viewer, ["cpu"], "lunch")
    assert all(queue.paused_at is None for queue in queues.list_queues(viewer))


def test_a_deed_within_a_deed_is_part_of_it(services: Services) -> None:
    @use_case(Right.RECORD)
    def twice(services: Services) -> None:
        """Pause two queues one after the other."""
        queues.pause(services, ["cpu"], "")
        queues.pause(services, ["io"], "")

    twice(services)
    assert [action for action, _, _ in told(services)] == [f"{__name__.rpartition('.')[2]}.twice"]
    queues.resume(services, [])
    assert len(told(services)) == 2


def test_what_is_declared_to_read_cannot_write(services: Services) -> None:
    @use_case(Right.READ)
    def misdeclared(services: Services) -> None:
        """Write something."""
        with services.catalogue.writing():
            pass

    with pytest.raises(NotAllowed, match="declared to read alone"):
        misdeclared(services)


def test_somebody_else_has_another_catalogue_of_the_same_database(services: Services) -> None:
    other = services.acting(replace(SOMEBODY, name="anna"))
    queues.pause(services, ["cpu"], "")
    queues.resume(other, ["cpu"])
    assert [who for _, who, _ in told(services)] == ["somebody", "anna"]
    with closing(services.catalogue.for_reading()) as catalogue:
        assert catalogue.describe() == services.catalogue.describe()


def test_a_deed_that_changed_nothing_is_not_told(services: Services) -> None:
    with pytest.raises(Conflict, match="was not paused"):
        queues.resume(services, ["cpu"])
    with pytest.raises(Conflict, match="no recording runs"):
        recordings.abort(services)
    assert told(services) == []
