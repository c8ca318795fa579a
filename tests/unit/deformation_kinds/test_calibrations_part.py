"""The calibration's part of sigma, from the points to the merged displacement and the gauges."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sms_jobs.bench.sessions.drawn_calibrations import off_calibrations
from sms_jobs.kinds.calibration_factors import states_from
from sms_jobs.kinds.deformation import gauges
from sms_jobs.kinds.deformation.gauges import GaugesParameters
from sms_jobs.kinds.shape import reconstruct
from sms_jobs.metrology.calibration.point_factor import motion_factor, point_factor, sigma_of
from sms_jobs.records.field_names import SIGMA_CALIBRATION
from sms_jobs.virtual_rig.truth import exact_shape

VIEW = "C1P1"


def records(plate: Any, kind: str, state: str, view: str = VIEW) -> dict[str, Any]:
    found: dict[str, Any] = plate.results[kind, plate.subject(state, view)]
    return found


def test_maps_are_what_the_factor_says_at_every_pixel(known_plate: Any) -> None:
    surface = records(known_plate, "reconstruct", "S00")["surface"]
    moved = records(known_plate, "correlate", "S01")
    states = states_from(moved["factor_reference"], moved["factor_deformed"])
    field = moved["displacement"]
    for found, valid, exact in (
        (surface.sigma_calibration, surface.reason == 0, lambda x, d: point_factor(states[0], x)),
        (field.sigma_calibration, field.reason == 0, lambda x, d: motion_factor(*states, x, d)),
    ):
        place, shift = (each[:, valid].T for each in (surface.position, field.displacement))
        expected = sigma_of(exact(place, shift)).T
        # Blocks of 2 px, between which sigma is linear but for its curvature, and one part in a thousand; the
        # displacement that it follows has noise of its own, of 10 um in 1 mm.
        off = np.abs(found[:, valid] / expected - 1.0)
        assert np.median(off) < 0.005
        assert np.sqrt(np.mean(off**2)) < 0.03
        assert np.isnan(found[:, ~valid]).all()


def test_a_displacement_has_hardly_any_of_what_its_points_have(known_plate: Any) -> None:
    points = np.nanmedian(records(known_plate, "reconstruct", "S00")["surface"].sigma_calibration)
    moved = np.nanmedian(records(known_plate, "correlate", "S01")["displacement"].sigma_calibration)
    assert 0.0 < moved < 0.05 * points


def test_a_gauge_reads_what_strain_about_it_says(known_plate: Any) -> None:
    # Several places: which pixels a gauge takes in changes what it reads at one by up to a fifth.
    places = [(5 + dx, dy - 10) for dx in (-2, 0, 2) for dy in (-2, 0, 2)]
    placed = [f"along{n} x={x} y={y} length=20 width=20" for n, (x, y) in enumerate(places)]
    output = known_plate.run(
        gauges.KIND,
        known_plate.subject("S01", VIEW),
        GaugesParameters(gauge=(*placed, "away x=500 y=0 length=9")),
    )
    read = output.records["gauges"]
    strain = records(known_plate, "strain", "S01")["strain"]
    placement = known_plate.campaign.scene.placement
    position = records(known_plate, "reconstruct", "S00")["surface"].position
    own = np.einsum(
        "ji,jrc->irc", placement.matrix(), position - np.array(placement.translation)[:, None, None]
    )
    away = np.hypot(own[0] - 5.0, own[1] + 10.0)
    near = np.isfinite(strain.sigma_calibration[0]) & (away < 3.0)
    # The slope over 20 mm, and over a disc of 20 mm, of a part that changes by some per cent meanwhile.
    expected = np.mean(strain.sigma_calibration[0][near])
    assert np.mean(read.sigma_calibration[:-1]) == pytest.approx(expected, rel=0.05)
    assert np.isnan(read.sigma_calibration[-1])


def test_views_that_are_merged_have_their_camera_in_common(known_plate: Any) -> None:
    merged = known_plate.results["merge", known_plate.subject("S01")]
    views = known_plate.campaign.views
    own = [records(known_plate, "correlate", "S01", view)["displacement"].sigma_calibration for view in views]
    name = next(key for key in merged if key.startswith("merged"))
    part = merged[name].sigma_calibration
    both = np.isfinite(own[0]) & np.isfinite(own[1]) if len(own) > 1 else np.isfinite(own[0])
    # No more than the worse of two, and no less than if they were independent.
    most = np.maximum(*own)[both] if len(own) > 1 else own[0][both]
    least = (1.0 / np.sqrt(1.0 / own[0] ** 2 + 1.0 / own[1] ** 2))[both] if len(own) > 1 else 0.9 * most
    assert np.mean(part[both] <= 1.02 * most) > 0.99
    assert np.mean(part[both] >= 0.5 * least) > 0.99
    mesh = merged["mesh"]
    assert np.isfinite(mesh.value(SIGMA_CALIBRATION)).all()


def test_what_is_not_known_is_absent_and_not_zero(plate: Any) -> None:
    for kind, name in (("reconstruct", "surface"), ("correlate", "displacement"), ("strain", "strain")):
        found = records(plate, kind, "S01")
        assert found[name].sigma_calibration is None
        assert not [key for key in found if key.startswith("factor") and found[key].is_stated]
    merged = plate.results["merge", plate.subject("S01")]
    assert SIGMA_CALIBRATION not in merged["mesh"].value_names
    output = plate.run(
        gauges.KIND, plate.subject("S01", VIEW), GaugesParameters(gauge=("g x=0 y=0 length=20",))
    )
    assert output.records["gauges"].sigma_calibration is None


def test_a_view_of_which_one_state_is_not_known_has_no_part(known_plate: Any, plate: Any) -> None:
    from sms_jobs.kinds.deformation import correlate

    mixed = replace(known_plate, results=dict(known_plate.results))
    subject = plate.subject("S00", VIEW)
    mixed.results["reconstruct", subject] = plate.results["reconstruct", subject]
    found = mixed.run(correlate.KIND, mixed.subject("S01", VIEW)).records
    assert found["displacement"].sigma_calibration is None


def test_points_are_off_by_what_both_parts_say_and_by_more_than_noise(known_plate: Any) -> None:
    """Calibrations that have the stated covariance among them, each with the noise of one recording."""
    subject = known_plate.subject("S00", VIEW)
    measurement = records(known_plate, "measurement", "S00")["measurement"]
    truth = exact_shape(measurement.simulation).xyz
    total, alone = [], []
    for off in off_calibrations(known_plate.calibration, known_plate.uncertainty, VIEW):
        made = replace(known_plate, calibration=off)
        surface = made.run(reconstruct.KIND, subject).records["surface"]
        valid = (surface.reason == 0) & np.isfinite(truth).all(axis=0)
        error = np.sum((surface.position - truth)[:, valid] ** 2, axis=0)
        noise = surface.covariance[[0, 3, 5]][:, valid].sum(axis=0, dtype=np.float64)
        part = np.sum(surface.sigma_calibration[:, valid].astype(np.float64) ** 2, axis=0)
        total.append(np.mean(error / (noise + part)))
        alone.append(np.mean(error / noise))
    # Exactly 1 to first order; a calibration is off by five deviations in one direction, and the noise of the
    # rig is predicted to some per cent.
    assert np.sqrt(np.mean(total)) == pytest.approx(1.0, abs=0.1)
    assert np.sqrt(np.mean(alone)) > 1.5
