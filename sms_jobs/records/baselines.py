"""How far sensors that measure together stand apart: rays of one point tell no distances."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations

import numpy as np

from sms_jobs.errors import ConfigurationError
from sms_jobs.records.sensors import Sensor

LEAST_APART_MM = 1e-3
"""Between the pin-holes of two sensors; those that are nearer are taken for one, but for rounding."""


def refuse_one_place(sensors: Iterable[Sensor], source: str) -> None:
    """Raise `ConfigurationError` where two sensors stand at one point, whose rays tell no distances."""
    for one, other in combinations(sensors, 2):
        apart_mm = float(np.linalg.norm(one.pose.centre() - other.pose.centre()))
        if apart_mm < LEAST_APART_MM:
            raise ConfigurationError(
                f"{one.name} and {other.name} stand at one point in {source}, {apart_mm:.1g} mm apart (at "
                f"least {LEAST_APART_MM:g} mm are needed): no shape can be measured with them; is their "
                "translation missing, or given twice? Give each the place where it stands"
            )
