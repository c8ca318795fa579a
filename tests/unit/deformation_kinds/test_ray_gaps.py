"""Rays that met at rest and miss each other later: the displacement says so."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.deformation.ray_gaps import told_of_gaps
from sms_jobs.kinds.kind import Inputs
from sms_jobs.records.fields import Surface
from sms_jobs.testing.in_memory import InMemory


def surface(gap_mm: float, sigma_mm: float) -> Surface:
    """Return a flat piece of surface whose rays miss each other by so much."""
    position = np.zeros((3, 4, 5))
    covariance = np.zeros((6, 4, 5), np.float32)
    covariance[[0, 3, 5]] = sigma_mm**2 / 3.0
    return Surface(
        "C1C2", "mm", position, np.zeros((4, 5), np.uint32), covariance, np.full((4, 5), gap_mm, np.float32)
    )


@pytest.mark.parametrize(
    ("at_rest", "later"),
    [
        ((0.002, 0.007), (0.003, 0.007)),
        ((0.002, 0.007), (0.02, 0.05)),  # ten times less light
        ((0.09, 0.012), (0.1, 0.012)),  # a calibration that was off all the time
    ],
)
def test_gaps_that_noise_or_the_calibration_explain_are_not_told(
    at_rest: tuple[float, float], later: tuple[float, float]
) -> None:
    assert told_of_gaps(surface(*at_rest), surface(*later), 0.01) == ""


def test_gaps_that_have_come_since_are_told() -> None:
    said = told_of_gaps(surface(0.002, 0.007), surface(0.093, 0.013))
    assert "miss each other by 0.093 mm and did by 0.002 mm at rest" in said
    assert "is off by more than its deviation says" in said
    counted = told_of_gaps(surface(0.002, 0.007), surface(0.093, 0.013), 0.01, counted=True)
    assert "the calibration's part of the displacement's deviation is larger for it" in counted
    assert told_of_gaps(replace(surface(0.0, 0.1), ray_gap=None), surface(0.093, 0.013), 0.1) == ""


def test_rays_that_miss_each_other_by_more_than_at_rest_are_told_however_large_the_noise() -> None:
    told = told_of_gaps(surface(0.01, 0.02), surface(0.01, 0.02), 0.12, counted=True)
    assert "miss each other by 0.12 px more than at rest: a sensor has moved since" in told
    assert "the calibration's part of the displacement's deviation is larger for it" in told


@pytest.mark.parametrize("times", [1.0, 100.0])
def test_the_displacement_says_so(plate: Any, times: float) -> None:
    subject = plate.subject("S01", "C1P1")
    parameters = correlate.KIND.parameters()
    datasets = {
        need.role: plate.find(need)
        for need in correlate.KIND.checked_needs(plate.campaign, subject, parameters)
    }
    records = datasets["deformed"].records
    gap = records["surface"].ray_gap * np.float32(times)
    changed = {**records, "surface": replace(records["surface"], ray_gap=gap)}
    datasets["deformed"] = InMemory(subject, changed)
    said: list[str] = []
    context = correlate.KIND.context(plate.campaign, subject)
    inputs = Inputs(subject, context, datasets, 1)
    list(correlate.KIND.run(inputs, parameters, lambda _, message="": said.append(message)))
    assert ("the rays miss each other by" in said[-1]) == (times > 1.0)
