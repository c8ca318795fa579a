"""Strain of the stretched plate, in the plate's own frame, from stored fields alone."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.deformation import relative, strain
from sms_jobs.kinds.deformation.strain import StrainParameters
from sms_jobs.kinds.shape.plane import PlaneParameters
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject

VIEW = "C1P1"


def test_strain_is_the_true_one_within_its_sigma(plate: Any) -> None:
    field = plate.results["strain", plate.subject("S01", VIEW)]["strain"]
    truth = plate.truth(VIEW).strain(field.measure)
    known = (field.reason == Reason.VALID) & np.isfinite(truth[0])
    error = (field.strain - truth)[:, known]
    assert known.mean() > 0.3
    # 0.5 % along the plate's own axis, -0.15 % across, told apart from each other and from the shear.
    assert np.abs(error.mean(axis=1)).max() < 5e-4
    ratio = np.sqrt(np.mean((error / field.sigma[:, known]) ** 2, axis=1))
    # A plate of eight gauge lengths has some 40 independent values: 11 %, besides the required 20 %.
    assert ratio.min() > 0.6
    assert ratio.max() < 1.45


def test_every_value_is_known_or_has_a_reason(plate: Any) -> None:
    field = plate.results["strain", plate.subject("S01", VIEW)]["strain"]
    for values in (field.strain, field.sigma, field.bias, field.principal, field.von_mises[None]):
        np.testing.assert_array_equal(np.isfinite(values).all(axis=0), field.reason == Reason.VALID)


def test_what_bends_within_the_gauge_is_part_of_sigma(plate: Any) -> None:
    field = plate.results["strain", plate.subject("S01", VIEW)]["strain"]
    known = field.reason == Reason.VALID
    assert (field.bias[:, known] <= field.sigma[:, known]).all()
    # The plate is stretched evenly: at most points there is noise alone.
    assert np.median(field.bias[:, known]) < 0.1 * np.median(field.sigma[:, known])


def test_the_resolution_on_a_surface_is_that_in_the_image_times_what_a_pixel_covers(plate: Any) -> None:
    moved = plate.results["correlate", plate.subject("S01", VIEW)]["displacement"]
    found = plate.results["strain", plate.subject("S01", VIEW)]["strain"]
    position = plate.results["reconstruct", plate.subject("S00", VIEW)]["surface"].position
    steps = [np.linalg.norm(np.diff(position, axis=axis), axis=0) for axis in (1, 2)]
    pitch = max(float(np.nanmedian(one)) for one in steps)
    # The plate is turned about both axes: a diagonal covers up to a tenth more than the longer of the two.
    ratio = np.nanmedian(moved.resolution) / (pitch * moved.resolution_px)
    assert 0.95 < ratio < 1.15
    assert np.nanmedian(found.resolution) > max(np.nanmedian(moved.resolution), found.gauge_length)
    np.testing.assert_array_equal(np.isfinite(found.resolution), found.reason == Reason.VALID)


def test_the_thesiss_squares_find_the_strain_too(plate: Any) -> None:
    """A plate is 40 px wide: squares of 15 px see what is left of subsets of 21 px."""
    subject = plate.subject("S01", VIEW)
    for measure in ("green-lagrange", "small"):
        parameters = StrainParameters(method="square", square_px=15, measure=measure)
        output = plate.run(strain.KIND, subject, parameters)
        field = output.records["strain"]
        known = field.reason == Reason.VALID
        error = (field.strain - plate.truth(VIEW).strain(measure))[:, known]
        assert known.mean() > 0.3
        # As of the disc.
        assert np.abs(error.mean(axis=1)).max() < 5e-4
        ratio = np.sqrt(np.mean((error / field.sigma[:, known]) ** 2, axis=1))
        assert ratio.min() > 0.6
        assert ratio.max() < 1.45
        for values in (field.strain, field.sigma, field.bias, field.principal, field.resolution[None]):
            np.testing.assert_array_equal(np.isfinite(values).all(axis=0), known)
    moved = plate.results["correlate", subject]["displacement"]
    lost = (moved.reason == Reason.VALID) & ~known
    assert (field.reason[lost] == Reason.TOO_FEW_NEIGHBOURS).all()
    position = plate.results["reconstruct", plate.subject("S00", VIEW)]["surface"].position
    steps = np.concatenate([np.linalg.norm(np.diff(position, axis=a), axis=0).ravel() for a in (1, 2)])
    assert field.square_px == 15
    assert field.gauge_length == pytest.approx(15.0 * np.nanmedian(steps), rel=0.02)
    assert plate.results["strain", subject]["strain"].square_px is None
    # Lines across a wave leave 90 % of it from four sides on: sin(z) / z = 0.9 at z = 0.79.
    assert np.nanmedian(field.resolution) > 3.9 * field.gauge_length


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"square_px": 9}, "square_px = 9 means nothing with method = disc"),
        ({"method": "square", "gauge_length_mm": 20.0}, "gauge_length_mm = 20 is of discs"),
        ({"method": "square", "gauge_length_px": 60.0}, "gauge_length_px = 60 is of discs"),
        ({"method": "square", "square_px": 8}, "no pixel in the middle; choose 9"),
        ({"method": "square", "square_px": 1}, "greater than or equal to 3"),
    ],
)
def test_a_gauge_that_cannot_be_is_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        StrainParameters.model_validate(given)


def test_a_longer_gauge_is_less_noisy(plate: Any) -> None:
    sigma = [
        plate.run(strain.KIND, plate.subject("S01", VIEW), StrainParameters(gauge_length_mm=g)).statistics[
            "median_sigma_strain"
        ]
        for g in (10.0, 20.0, 40.0)
    ]
    # It falls with the square of the length once that exceeds the subsets, here 29 mm, and always falls.
    assert sigma[0] > 1.3 * sigma[1]
    assert sigma[1] > 1.3 * sigma[2]


def test_a_gauge_of_few_pixels_is_refused_with_the_shortest(plate: Any) -> None:
    subject = plate.subject("S01", VIEW)
    said = (
        r"0.5 mm is (0\.\d+) px in the image of C1P1, .* at least 12 pixels, .* of 4 px, (.*) mm, holds: give"
    )
    with pytest.raises(InvalidInput, match=said) as refused:
        plate.run(strain.KIND, subject, StrainParameters(gauge_length_mm=0.5))
    found = re.search(said, str(refused.value))
    assert found is not None
    in_px, least_mm = map(float, found.groups())
    assert least_mm == pytest.approx(4.0 * 0.5 / in_px, rel=0.02)
    # Of the shortest, where pixels lie closer than in the middle of the image has values already.
    output = plate.run(strain.KIND, subject, StrainParameters(gauge_length_mm=1.05 * least_mm))
    reason = output.records["strain"].reason
    assert (reason == Reason.VALID).any()
    assert (reason == Reason.TOO_FEW_NEIGHBOURS).any()


def test_the_axis_is_the_specimens(plate: Any) -> None:
    subject = plate.subject("S01", VIEW)
    placement = plate.campaign.scene.placement.matrix()
    assert strain.x_axis_of(plate.campaign, subject) == pytest.approx(tuple(placement[:, 0]))
    assert strain.x_axis_of(replace(plate.campaign, scene=None), subject) == (1.0, 0.0, 0.0)
    field = plate.results["strain", subject]["strain"]
    assert field.x_axis == strain.x_axis_of(plate.campaign, subject)


def test_the_reference_state_has_no_strain(plate: Any) -> None:
    assert strain.KIND.subjects is not None
    assert tuple(strain.KIND.subjects(plate.campaign)) == tuple(
        Subject("plate", "S01", view) for view in plate.campaign.views
    )


def test_a_gauge_beyond_the_image_is_refused_with_its_limit(plate: Any) -> None:
    with pytest.raises(InvalidInput, match=r"1e\+09 mm is .* px in the image of C1P1, which has .* at most"):
        plate.run(strain.KIND, plate.subject("S01", VIEW), StrainParameters(gauge_length_mm=1e9))


def test_a_parameter_that_is_none_is_told_from_a_wrong_value() -> None:
    with pytest.raises(
        InvalidInput, match=r"^strain has no parameter 'gauge'; its parameters are gauge_length_mm"
    ):
        StrainParameters.checked("strain", {"gauge": 3})
    with pytest.raises(
        InvalidInput, match=r"parameter 'fold_angle_deg' of strain cannot be -1: .* greater than 0"
    ):
        StrainParameters.checked("strain", {"fold_angle_deg": -1})
    with pytest.raises(InvalidInput, match=r"^relative needs the parameter 'region': of the ref"):
        relative.RelativeParameters.checked("relative", {})
    for size in (0.0, -1.0, 1e300):
        with pytest.raises(InvalidInput, match="parameter 'mm_per_px' of plane cannot be"):
            PlaneParameters.checked("plane", {"mm_per_px": size})
