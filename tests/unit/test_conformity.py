"""Decisions at a stated risk are as seldom wrong as they say."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.conformity import Decision, conformance_probability, decide


def test_the_probability_is_that_of_the_normal_distribution() -> None:
    assert conformance_probability(0.0, 1.0, 1.0) == pytest.approx(0.6826895)
    assert conformance_probability(1.0, 0.01, 1.0) == pytest.approx(0.5)
    assert conformance_probability(-1.0 + 1.6448536 * 0.01, 0.01, 1.0) == pytest.approx(0.95)
    assert conformance_probability(0.9, 0.0, 1.0) == 1.0
    assert conformance_probability(1.1, 0.0, 1.0) == 0.0
    with pytest.raises(InvalidInput, match="a limit is above 0 mm, not 0"):
        conformance_probability(0.0, 1.0, 0.0)


@pytest.mark.parametrize(
    ("probabilities", "missing", "decision"),
    [
        ([0.99, 0.98], 0, Decision.CONFORM),
        ([0.97, 0.97], 0, Decision.UNDECIDED),
        ([0.99, 0.04], 0, Decision.NOT_CONFORM),
        ([1.0, 1.0], 1, Decision.UNDECIDED),
        ([0.01], 1, Decision.NOT_CONFORM),
        ([], 0, Decision.UNDECIDED),
    ],
)
def test_decisions(probabilities: list[float], missing: int, decision: Decision) -> None:
    assert decide(probabilities, 0.05, missing).decision is decision


@pytest.mark.parametrize("risk", [0.0, 0.5, 1.0, float("nan")])
def test_a_risk_that_is_none_is_refused(risk: float) -> None:
    with pytest.raises(InvalidInput, match="a risk is between 0 and"):
        decide([1.0], risk)


@pytest.mark.parametrize("shared", [0.0, 1.0])
def test_what_is_called_conform_is_seldom_not(rng: np.random.Generator, shared: float) -> None:
    """Truths come from a wide range, errors of the five values are independent or the same."""
    limit, sigma, risk, wrong, called = 1.0, 0.1, 0.1, 0, 0
    for _ in range(6000):
        truth = rng.uniform(-1.5, 1.5, 5) * (rng.uniform() < 0.5) + rng.uniform(-1.2, 1.2)
        noise = shared * rng.normal(0.0, sigma) + (1.0 - shared) * rng.normal(0.0, sigma, 5)
        found = decide([conformance_probability(v, sigma, limit) for v in truth + noise], risk)
        inside = bool((np.abs(truth) <= limit).all())
        if found.decision is not Decision.UNDECIDED:
            called += 1
            wrong += inside is not (found.decision is Decision.CONFORM)
    assert called > 3000
    assert wrong / called <= risk
