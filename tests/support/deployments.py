"""The two deployments that pass one conformance suite."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Deployment:
    """What distinguishes the two: the environment in which `sms` is started."""

    name: str
    home: Path
    environment: dict[str, str]
