"""The addresses of the interface: which there are, and what they ask of whoever uses them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sms_jobs.web.refusals import DESCRIBED
from sms_jobs.web.routes import ROUTE_RULES, Routes, answer

ROUTES = Routes("addresses")


@dataclass(frozen=True)
class Address:
    """An address; `right` is empty where anybody may use it."""

    method: str
    path: str
    use_case: str
    right: str


@ROUTES.router.get("", response_model=list[Address], responses=DESCRIBED)
def addresses() -> Any:
    """Return the addresses, which /api/v1/openapi.json describes in full."""
    return answer(
        [
            Address(method, path, rule.name, "" if rule.right is None else rule.right.value)
            for (method, path), rule in sorted(ROUTE_RULES.items())
        ]
    )
