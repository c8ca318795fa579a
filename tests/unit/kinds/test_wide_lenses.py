"""Sessions of boards before rational lenses and fisheyes, calibrated from nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from sms_jobs.bench.sessions.board_sessions import (
    BoardDesign,
    BoardSession,
    board_session,
    calibrated,
    parameter_z,
)
from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.kinds.calibration import calibrate_boards
from sms_jobs.metrology.geometry.lens import Model


@pytest.fixture(scope="module", params=["rational", "fisheye"])
def session(request: pytest.FixtureRequest) -> tuple[Model, BoardSession]:
    model: Model = request.param
    return model, board_session(BoardDesign(poses=24, lens=model), 3)


def test_a_wide_lens_is_found_with_its_deviations(session: tuple[Model, BoardSession]) -> None:
    model, made = session
    found = calibrated(made, lens=model)
    assert found.quality.warnings == ()
    assert {s.intrinsics.model for s in found.calibration.rig.sensors} == {model}
    z = np.array(list(parameter_z(made, found).values()))
    # 28 correlated normal numbers: none beyond 4.5, and an rms of 1 within half.
    assert np.abs(z).max() < 4.5
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.6


def test_a_plain_lens_does_not_pass_for_a_wide_one(session: tuple[Model, BoardSession]) -> None:
    _, made = session
    try:
        warnings = calibrated(made).quality.warnings
    except CalibrationFailed:
        return
    assert any("calibrate with lens=rational" in w for w in warnings)


def test_the_hint_does_not_speak_of_a_lens_that_is_plain() -> None:
    made = board_session(BoardDesign(poses=12), 3)
    assert calibrated(made).quality.warnings == ()


def test_a_radial_term_that_a_plain_lens_lacks_is_told() -> None:
    made = board_session(BoardDesign(poses=12), 3)
    bent = {}
    for subject, seen in made.observations.items():
        lens = made.rig.sensor(seen.camera).intrinsics
        off = seen.camera_px - [lens.cx, lens.cy]
        # k3 = 5: 3 px where r is 0.3, of which k1 and k2 take most.
        r6 = (np.sum(off**2, axis=1, keepdims=True) / lens.fx**2) ** 3
        bent[subject] = replace(seen, camera_px=seen.camera_px + 5.0 * r6 * off)
    other = made.changed(bent)
    assert any("grow outwards as those of another lens do" in w for w in calibrated(other).quality.warnings)
    # With k3 free nothing is left of it.
    assert calibrated(other, fixed="none").quality.warnings == ()


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ({"lens": "wide"}, "there is no lens 'wide': say plain, rational, fisheye"),
        ({"lens": "C1=plain,C1=fisheye"}, "names a lens twice"),
        ({"fixed": "fisheye=1"}, "is set by the lens"),
    ],
)
def test_a_lens_that_cannot_be_is_refused(said: dict[str, str], why: str) -> None:
    with pytest.raises(ValidationError, match=why):
        calibrate_boards.CalibrateParameters(**said)


def test_a_lens_of_a_sensor_that_is_not_there_is_refused() -> None:
    with pytest.raises(InvalidInput, match="lens=C7=fisheye names C7, but the sensors are C1, C2"):
        calibrated(board_session(BoardDesign(poses=6), 3), lens="C7=fisheye")
