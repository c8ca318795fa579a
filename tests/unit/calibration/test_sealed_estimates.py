"""What a calibration found of artefacts is sealed by name; the table for people follows from it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.archive.codec import layout_of, plain_to_json, record_from_parts
from sms_jobs.errors import ArchiveCorrupt
from sms_jobs.metrology.calibration.estimates import Estimated, name_of
from sms_jobs.records.calibration import CalibrationQuality, Estimate

ESTIMATES = (
    Estimate(Estimated.LENGTH, "bar", 500.0021, 0.0004),
    Estimate(Estimated.RADIUS, "bar", 30.001, 0.001, 2),
    Estimate(Estimated.PITCH_SCALE, "board", 1.0002, 3e-5),
    Estimate(Estimated.BLUR, "C1", 0.55),
)


def quality() -> CalibrationQuality:
    nothing: dict[str, float] = {}
    return CalibrationQuality(
        *("board frame of pose B01", "the boards alone", 6, 2000, 30),
        *(nothing, nothing, nothing, {}, (), nothing, nothing),
        estimates=ESTIMATES,
        held={"k2 of C1, held [1]": 0.05},
        views=(),
        place=np.empty((0, 3)),
        expected_sigma=np.empty((0, 0)),
        residual_sensor=np.empty(0, np.int32),
        residual_px=np.empty((0, 2)),
        residual=np.empty((0, 2)),
    )


def read(text: str, like: CalibrationQuality) -> CalibrationQuality:
    arrays = {name: getattr(like, name) for name in layout_of(CalibrationQuality).arrays}
    return record_from_parts(CalibrationQuality, text, arrays, "here")


def test_estimates_are_read_as_they_were_sealed() -> None:
    made = quality()
    assert read(plain_to_json(made), made).estimates == ESTIMATES
    assert made.estimate(Estimated.PITCH_SCALE, "board") == ESTIMATES[2]
    assert made.estimate(Estimated.PITCH_SCALE, "bar") is None
    assert made.estimate(Estimated.RADIUS, "bar") is None  # there is one of each sphere
    assert made.labelled() == {
        "length of bar [mm]": 500.0021,
        "length of bar, sigma [mm]": 0.0004,
        "radius of sphere 2 of bar [mm]": 30.001,
        "radius of sphere 2 of bar, sigma [mm]": 0.001,
        "pitch scale of board [1]": 1.0002,
        "pitch scale of board, sigma [1]": 3e-5,
        "blur of C1 [px]": 0.55,
        "k2 of C1, held [1]": 0.05,
    }


def test_what_a_newer_version_estimates_is_refused_by_name() -> None:
    made = quality()
    newer = json.loads(plain_to_json(made))
    newer["estimates"][0]["what"] = "roughness"
    with pytest.raises(ArchiveCorrupt, match=r"estimates\.0\.what.*was it written by another version"):
        read(json.dumps(newer), made)
    assert replace(made, estimates=()).estimate(Estimated.BLUR, "C1") is None


@pytest.mark.parametrize("what", list(Estimated))
def test_people_call_each_by_its_words(what: Estimated) -> None:
    assert name_of(what, "it") == f"{what.value.replace('-', ' ')} of it"
    assert what.unit == {"pitch-scale": "1", "blur": "px"}.get(what.value, "mm")
