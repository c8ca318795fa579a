"""Views of one camera that contradict each other: the merged displacement says so."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sms_jobs.kinds.deformation import merge
from sms_jobs.kinds.deformation.view_gaps import told_of_views
from sms_jobs.kinds.kind import Inputs
from sms_jobs.records.fields import DisplacementField
from sms_jobs.records.reasons import Reason

PIXELS = (4, 5)


def moved(z_mm: float, sigma_mm: float, from_calibration_mm: float | None = None) -> DisplacementField:
    """Return a displacement along Z that is the same at every pixel."""
    displacement = np.zeros((3, *PIXELS))
    displacement[2] = z_mm
    covariance = np.zeros((6, *PIXELS), np.float32)
    covariance[5] = sigma_mm**2
    part = None
    if from_calibration_mm is not None:
        part = np.zeros((3, *PIXELS), np.float32)
        part[2] = from_calibration_mm
    image = np.zeros((2, *PIXELS))
    reason = np.zeros(PIXELS, np.uint32)
    return DisplacementField(
        "C1C2", "S00", "mm", displacement, covariance, image, reason, sigma_calibration=part
    )


@pytest.mark.parametrize(
    "other", [moved(0.05, 0.01), moved(1.0, 0.5), moved(1.0, 0.01, from_calibration_mm=0.4)]
)
def test_differences_that_are_stated_are_not_told(other: DisplacementField) -> None:
    assert told_of_views(("C1C2", "C1C3"), (moved(0.0, 0.01), other)) == ""


def test_views_that_share_no_pixel_do_not_contradict_each_other() -> None:
    nothing = replace(moved(1.0, 0.01), reason=np.full(PIXELS, Reason.NO_MATCH, np.uint32))
    assert told_of_views(("C1C2", "C1C3"), (moved(0.0, 0.01), nothing)) == ""


def test_of_three_views_those_that_differ_are_told() -> None:
    said = told_of_views(("C1C2", "C1C3", "C1C4"), (moved(0.0, 0.03), moved(0.01, 0.03), moved(1.0, 0.04)))
    assert "C1C2 and C1C3" not in said
    assert "C1C2 and C1C4 differ by 1 mm (median) where 0.05 mm is stated" in said
    assert "C1C3 and C1C4 differ by 0.99 mm" in said


def test_the_merged_deviation_has_what_views_differ_by(plate: Any) -> None:
    """Of weights w and 1 - w the mean is off by w of the difference and states sqrt(w (1 - w)) of it.

    So the score is sqrt(w / (1 - w)): within a factor of two for weights up to 4 to 1.
    """
    key = ("correlate", plate.subject("S01", "C1P2"))
    field = plate.results[key]["displacement"]
    off = replace(field, displacement=field.displacement + np.array([0.0, 0.0, 1.0])[:, None, None])
    changed = replace(plate, results={**plate.results, key: {**plate.results[key], "displacement": off}})
    merged = changed.run(merge.KIND, plate.subject("S01")).records["merged_C1"]
    before = plate.results["merge", plate.subject("S01")]["merged_C1"]
    both = merged.contributors == 2
    error = merged.displacement[2] - plate.truth("C1P1").displacement[2]
    known = both & np.isfinite(error)
    # Either view may be right: the deviation is half of what they differ by, as the error is.
    score = error[known] / np.sqrt(merged.covariance[5][known])
    assert 0.5 < np.sqrt(np.mean(score**2)) < 2.0
    np.testing.assert_array_equal(merged.covariance[:, ~both], before.covariance[:, ~both])


@pytest.mark.parametrize("off_mm", [0.0, 1.0])
def test_the_merged_displacement_says_so(plate: Any, off_mm: float) -> None:
    key = ("correlate", plate.subject("S01", "C1P2"))
    field = plate.results[key]["displacement"]
    off = replace(field, displacement=field.displacement + off_mm)
    results = {**plate.results, key: {**plate.results[key], "displacement": off}}
    changed, subject, said = replace(plate, results=results), plate.subject("S01"), list[str]()
    parameters = merge.KIND.parameters()
    needs = merge.KIND.checked_needs(plate.campaign, subject, parameters)
    datasets = {need.role: changed.find(need) for need in needs}
    inputs = Inputs(subject, merge.KIND.context(plate.campaign, subject), datasets, 1)
    list(merge.KIND.run(inputs, parameters, lambda _, message="": said.append(message)))
    assert ("the displacements of C1P1 and C1P2 differ by 1.7 mm" in said[-1]) == (off_mm > 0.0)
