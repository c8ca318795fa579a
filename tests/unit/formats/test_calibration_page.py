"""The page about a calibration says what it is worth, and shows it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sms_jobs.formats.report.calibration import calibration_page
from sms_jobs.kinds.calibration.session_adjustment import known_as
from sms_jobs.metrology.calibration.estimates import Estimated
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS
from sms_jobs.records.calibration import CalibrationQuality, CalibrationUncertainty, Estimate
from sms_jobs.records.times import UNTIMED
from sms_jobs.virtual_rig.campaigns import top_hat_bending

CALIBRATION, _ = top_hat_bending("page", "small")
SENSORS = tuple(s.name for s in CALIBRATION.rig.sensors)


def quality(rng: np.random.Generator, **changes: object) -> CalibrationQuality:
    axes = [np.linspace(-250.0, 250.0, 5)] * 3
    place = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    views = CALIBRATION.rig.views()
    sigma = 0.01 + 1e-5 * np.abs(place).sum(axis=1) + np.zeros((len(views), 1))
    sigma[0, :4] = np.nan  # not seen from there
    made = CalibrationQuality(
        gauge="board frame of pose B01",
        started_from="the boards alone",
        iterations=6,
        residuals=200_000,
        parameters=192,
        rms_by_type={"ray gap [mm]": 0.0123},
        rms_by_sensor={"C1": 1.02},
        rms_by_pose={"S01": 0.98},
        refused={"at the limb of the sphere": 812, "of nothing": 0},
        warnings=(),
        bar_length_error_mm={"S01": 0.012, "S02": -0.016},
        board_rms_px={"B01": 0.021},
        estimates=(Estimate(Estimated.LENGTH, "bar", 500.0021),),
        held={},
        views=views,
        place=place,
        expected_sigma=sigma,
        residual_sensor=np.repeat(np.arange(4, dtype=np.int32), 50),
        residual_px=rng.uniform(0.0, 500.0, (200, 2)),
        residual=0.02 * rng.standard_normal((200, 2)),
    )
    return replace(made, **changes)


def written(quality: CalibrationQuality) -> str:
    covariance = np.diag(np.full(PER_SENSOR * len(SENSORS), 1e-6))
    covariance[PER_SENSOR - 1, PER_SENSOR - 1] = 0.0
    uncertainty = CalibrationUncertainty(SENSORS, SENSOR_PARAMETERS, covariance)
    return calibration_page("hall-3-june", CALIBRATION.rig, CALIBRATION, uncertainty, quality, 480)


def test_a_time_that_nobody_knows_is_not_shown(rng: np.random.Generator) -> None:
    timed, untimed = CALIBRATION, replace(CALIBRATION, valid_from=UNTIMED)
    assert "valid from a time that is not known" in written(quality(rng, started_from=known_as(untimed)))
    assert known_as(timed) in written(quality(rng, started_from=known_as(timed)))


def test_the_page_says_what_a_metrologist_asks(rng: np.random.Generator) -> None:
    page = written(quality(rng))
    # rms of 12 and -16 um, and the box of 540 x 540 x 500 mm.
    assert "14.1 µm rms" in page
    assert f"1/{CALIBRATION.volume.diagonal_mm / 0.0141421:,.0f}" in page
    for expected in ("board frame of pose B01", "200,000 residuals", "500.002", "at the limb", "812"):
        assert expected in page
    assert "of nothing" not in page
    assert "Nothing speaks against" in page
    # A map of every sensor's residuals and of every view's expected deviation.
    assert page.count("data:image/png") == len(SENSORS) + len(CALIBRATION.rig.views())


def test_warnings_are_shown_as_text(rng: np.random.Generator) -> None:
    page = written(quality(rng, warnings=("the bar <500.1 mm> and the board disagree",)))
    assert "&lt;500.1 mm&gt;" in page
    assert "Nothing speaks against" not in page


def test_a_session_without_a_bar_has_a_page_too(rng: np.random.Generator) -> None:
    page = written(quality(rng, bar_length_error_mm={}))
    assert "held-out bar lengths" not in page
    assert "pose of the board" in page
