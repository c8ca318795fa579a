"""How far results on the virtual rig are from the exact truth."""

from __future__ import annotations

from dataclasses import dataclass

from sms_jobs.metrology.arrays import Singles
from sms_jobs.records.fields import VECTOR_IMAGE
from sms_jobs.records.quantity import STRAIN_COMPONENTS, array


@dataclass(frozen=True)
class Errors:
    """The errors of one result over all of its valid pixels; nothing is trimmed.

    Attributes
    ----------
    count
        Number of valid pixels whose truth is known.
    rms
        Root mean square: of the length of a vector's error, or over all components of a strain.
    bias
        The same of the mean error.
    largest
        Largest length of a vector's error, or largest error of a component.
    score_rms
        Root mean square of error over predicted standard deviation: 1 for an honest prediction.
    expected_count
        Number of pixels where a value can be had: seen by the camera and lit by the projector, at the end
        too where that matters.
    valid_fraction
        The part of the expected pixels that is valid.
    false_valid_count
        Number of valid pixels where there is nothing to measure; they have no error and enter no rms.
    """

    count: int
    rms: float
    bias: float
    largest: float
    score_rms: float
    expected_count: int
    valid_fraction: float
    false_valid_count: int


@dataclass(frozen=True)
class Assessment:
    """Measured minus true of one tuple.

    `shape` and `displacement` are in mm, `strain` is a ratio. Displacement and strain are None at the
    reference state.
    """

    shape: Errors
    displacement: Errors | None
    strain: Errors | None
    shape_error: Singles = array("mm", "length of the error of the position")
    displacement_error: Singles | None = array("mm", "length of the error of the displacement", default=None)
    strain_error: Singles | None = array(
        "1", "error of the strain", VECTOR_IMAGE, STRAIN_COMPONENTS, default=None
    )
