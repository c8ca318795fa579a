"""How an address offers a use case: its rule is checked first, its words describe it, its answer is JSON."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator
from typing import Any, get_type_hints

from fastapi import APIRouter, Depends, Request
from fastapi.responses import JSONResponse

from sms_jobs.app.rules import Rule, require, rule_of
from sms_jobs.errors import InvalidInput
from sms_jobs.records.plain import SCHEMA, plain
from sms_jobs.web import identity
from sms_jobs.web.refusals import DESCRIBED

ROUTE_RULES: dict[tuple[str, str], Rule] = {}
"""Rule of each method and path that is offered, for who walks them all."""


def answer(value: Any, status: int = 200) -> JSONResponse:
    """Return what a command prints with `--json`: one object with its schema version, or a list."""
    if isinstance(value, list | tuple):
        return JSONResponse(plain(value), status)
    return JSONResponse({"schema": SCHEMA} | plain(value), status)


def returned(use_case: Callable[..., Any]) -> Any:
    """Return the type of what a use case returns, as a description of an answer that repeats it."""
    return get_type_hints(inspect.unwrap(use_case))["return"]


def _only_known(request: Request) -> None:
    """Refuse a name in the query that the address does not take, rather than answer another question."""
    known = dict.fromkeys(_names_in_the_query(request.scope["route"].dependant))
    for name in request.query_params:
        if name not in known:
            taken = f"it takes {', '.join(known)}" if known else "it takes none"
            raise InvalidInput(f"'{name}' is no parameter of {request.url.path}; {taken}")


def _names_in_the_query(dependant: Any) -> Iterator[str]:
    yield from (field.alias for field in dependant.query_params)
    for one in dependant.dependencies:
        yield from _names_in_the_query(one)


class Routes:
    """The addresses of one subject."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.router = APIRouter(tags=[name])

    def offer(
        self,
        method: str,
        path: str,
        use_case: Callable[..., Any],
        *,
        answers: Any = None,
        media: Iterable[str] = (),
        status: int = 200,
    ) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        """Offer a use case at a path: whoever may not call it is refused before anything is read.

        Parameters
        ----------
        method, path
            Below `/api/v1`.
        use_case
            With a rule; its first sentence is the summary of the address.
        answers
            Type of the answer, for the description; none where it is no JSON.
        media
            Types of an answer that is no JSON.
        status
            Of the answer.
        """
        rule = rule_of(use_case)
        if rule is None:
            raise TypeError(f"{use_case} has no rule")
        ROUTE_RULES[method, path] = rule

        def permitted(request: Request) -> None:
            if rule.right is None:
                return
            # The password, where one is asked for, comes with the body; the use case asks for it.
            require(identity.services_for(request), Rule(rule.name, rule.right))

        asked_for = () if rule.right is None else identity.WAYS
        summary, _, more = (use_case.__doc__ or rule.name).strip().partition("\n")
        described: dict[int | str, dict[str, Any]] = dict(DESCRIBED)
        if media:
            described[status] = {"content": {kind: {} for kind in media}, "description": "As it is"}

        def declare(endpoint: Callable[..., Any]) -> Callable[..., Any]:
            self.router.add_api_route(
                path,
                endpoint,
                methods=[method],
                name=rule.name,
                operation_id=f"{rule.name}:{method}:{path}",
                summary=summary.rstrip("."),
                description=more.partition("Raises")[0].strip() or None,
                response_model=answers,
                status_code=status,
                dependencies=[*asked_for, Depends(permitted), Depends(_only_known)],
                responses=described,
                openapi_extra={"x-use-case": rule.name, "x-right": rule.right and rule.right.value},
            )
            return endpoint

        return declare
