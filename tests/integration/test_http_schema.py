"""What the interface over HTTP says of itself holds, whatever it is asked."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any, cast

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from pydantic import SecretStr
from support.homes import make_home
from support.over_http import app_of, served

from sms_jobs import bootstrap
from sms_jobs.app.accounts import people
from sms_jobs.app.work import jobs, new_jobs
from sms_jobs.app.work.new_jobs import Work
from sms_jobs.bootstrap import Services
from sms_jobs.records.people import Actor, Role

_ENDLESS = "/api/v1/events"
PARTS = range(10)
"""Of the operations. What is described is told by the tests, since it takes seconds to load and to make."""


@cache
def operations() -> list[Any]:
    """Return all that the description offers, and that ends by itself."""
    import schemathesis
    from schemathesis.config import SchemathesisConfig

    # What a schema cannot say, such as which campaigns there are, is refused too.
    statuses = [200, 201, 204, 401, 403, 404, 409, 422, 502]
    checks = {
        "positive_data_acceptance": {"expected-statuses": statuses},
        # Whoever sits at the desk needs no name before anybody has one; tried by itself below.
        "ignored_auth": {"enabled": False},
    }
    config = SchemathesisConfig.from_dict({"checks": checks})
    description = app_of(cast(Services, None)).openapi()
    found = schemathesis.openapi.from_dict(description, config=config).get_all_operations()
    return [one.ok() for one in found if one.ok().path != _ENDLESS]


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, dict[str, str]]]:
    """Address of a home with a small campaign, whose jobs have ended, and names of what is there."""
    home = tmp_path_factory.mktemp("home")
    make_home(home, {})
    with bootstrap.services(home, "web") as services:
        submitted = new_jobs.submit(services, Work("plate", ("simulate", "pipeline")))
        jobs.cancel(services, [], "plate")  # whoever waits for them does not wait
        there = {"name": "plate", "job": submitted.job_ids[0], "number": "1"}
        with served(app_of(services)) as client:
            yield str(client.base_url).removesuffix("/api/v1/"), there


@pytest.mark.parametrize("part", PARTS)
def test_the_description_holds(part: int, home: tuple[str, dict[str, str]]) -> None:
    for operation in operations()[part :: len(PARTS)]:
        assert_holds(operation, *home)


def assert_holds(operation: Any, address: str, there: dict[str, str]) -> None:
    from schemathesis import GenerationMode

    asked = st.one_of(*(operation.as_strategy(generation_mode=mode) for mode in GenerationMode))

    @settings(
        max_examples=6,
        derandomize=True,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=asked, named=st.booleans())
    def holds(case: Any, named: bool) -> None:
        if named and case.meta.generation.mode is GenerationMode.POSITIVE:
            case.path_parameters.update({k: v for k, v in there.items() if k in case.path_parameters})
        case.call_and_validate(base_url=address)

    holds()


@pytest.fixture(scope="module")
def named(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Services]]:
    """Address of a home in which an administrator has a name, and services in that name."""
    home = tmp_path_factory.mktemp("named")
    make_home(home, {})
    with bootstrap.services(home, "web") as services:
        people.add(services, "ada", Role.ADMINISTRATOR, SecretStr("correct horse battery"))
        with served(app_of(services)) as client:
            ada = services.acting(Actor("ada", Role.ADMINISTRATOR, "command", "here"))
            yield str(client.base_url).removesuffix("/api/v1/"), ada


@pytest.mark.parametrize("part", PARTS)
def test_an_address_that_asks_who_it_is_does_ask(part: int, named: tuple[str, Services]) -> None:
    for operation in operations()[part :: len(PARTS)]:
        assert_asks(operation, *named)


def assert_asks(operation: Any, address: str, ada: Services) -> None:
    from schemathesis import GenerationMode
    from schemathesis.specs.openapi.checks import ignored_auth

    said = operation.definition.raw
    ways = [{"token": []}, {"session": []}] if said.get("x-right") else None
    assert said.get("security") == ways, operation.label
    # Of its own, since some addresses end tokens.
    headers = {"Authorization": f"Bearer {people.create_token(ada, 'schema').secret}"}

    @settings(
        max_examples=2,
        derandomize=True,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(case=operation.as_strategy(generation_mode=GenerationMode.POSITIVE))
    def asks(case: Any) -> None:
        # The first of its sort may compile what the others find compiled.
        case.call_and_validate(base_url=address, headers=headers, checks=[ignored_auth], timeout=120.0)

    asks()
