"""The two deployments that pass one conformance suite."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from sms_jobs.catalogue.database import Catalogue


@dataclass(frozen=True)
class Deployment:
    """What distinguishes the two: the environment in which `sms` is started."""

    name: str
    home: Path
    environment: dict[str, str]

    def catalogue(self, *, create: bool = False) -> Catalogue:
        """Open the deployment's catalogue."""
        embedded = f"sqlite:///{self.home / 'catalogue.sqlite'}"
        return Catalogue(self.environment.get("SMS_DATABASE_URL", embedded), create=create)


def mainly(name: str) -> list[Any]:
    """Return both deployments as parameters of a test that every run has on one, and `-m long` on the other.

    For what takes seconds of a service, and of which the two are tried by each other's tests as well.
    """
    return [
        pytest.param(each, marks=() if each == name else (pytest.mark.long,))
        for each in ("embedded", "grown")
    ]
