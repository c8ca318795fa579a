"""Decisions about conformity from a value and its uncertainty, at a stated risk (JCGM 106:2012).

The measurand is taken as normally distributed about the measured value with its standard uncertainty, nothing
else being known of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from math import erfc, inf, sqrt

from sms_jobs.errors import InvalidInput


class Decision(Enum):
    """What can be said at the stated risk."""

    CONFORM = "conform"
    NOT_CONFORM = "not conform"
    UNDECIDED = "undecided"


@dataclass(frozen=True)
class Conformity:
    """The probability that all of several values conform lies between two bounds.

    Attributes
    ----------
    least, most
        Of the probability.
    decision
        At the risk that was given.
    """

    least: float
    most: float
    decision: Decision


def conformance_probability(value: float, sigma: float, limit: float) -> float:
    """Return the probability that a measurand lies within -limit .. limit (JCGM 106:2012).

    A span cannot be negative, and what lies below -limit hardly counts. `sigma` 0 stands for a value that is
    known exactly. Raises `InvalidInput` for a limit that is not above 0.
    """
    if not 0.0 < limit < inf:
        raise InvalidInput(f"a limit is above 0 mm, not {limit:g}: give the largest error that is allowed")
    if sigma == 0.0:
        return float(abs(value) <= limit)
    return _below((limit - value) / sigma) - _below((-limit - value) / sigma)


def _below(standard: float) -> float:
    return 0.5 * erfc(-standard / sqrt(2.0))


def decide(probabilities: Sequence[float], risk: float, missing: int = 0) -> Conformity:
    """Decide whether all of several measurands conform, at most `risk` of each decision being wrong.

    Parameters
    ----------
    probabilities
        Of each alone.
    risk
        Largest probability that a decision is wrong, above 0 and below 0.5.
    missing
        How many have no value: they may conform or not.

    Raises
    ------
    InvalidInput
        The risk is none.

    Notes
    -----
    However the errors of the values go together, the probability that all conform is at least
    1 - sum(1 - p) (Boole's inequality) and at most the least p. *Conform* asks for the lower bound to be at
    least 1 - risk, *not conform* for the upper to be at most risk: guarded acceptance and guarded rejection
    of JCGM 106:2012, with guard bands that follow from the probability.
    """
    if not 0.0 < risk < 0.5:
        raise InvalidInput(f"a risk is between 0 and 0.5, not {risk:g}: give 0.05 for one in twenty")
    most = min(probabilities, default=1.0)
    least = 0.0 if missing or not probabilities else max(0.0, 1.0 - sum(1.0 - p for p in probabilities))
    if least >= 1.0 - risk:
        return Conformity(least, most, Decision.CONFORM)
    return Conformity(least, most, Decision.NOT_CONFORM if most <= risk else Decision.UNDECIDED)
