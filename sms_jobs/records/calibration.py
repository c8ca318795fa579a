"""How accurate a calibration is, and whether it is used."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.calibration.estimates import Estimated, name_of
from sms_jobs.metrology.calibration.missed_rays import MissedRays
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS
from sms_jobs.records.quantity import array
from sms_jobs.records.sensors import Sensor


@dataclass(frozen=True)
class Signed:
    """Who has decided something, and why; empty where nobody has a name, and where nobody was asked."""

    by: str = ""
    reason: str = ""


NOBODY = Signed()


@dataclass(frozen=True)
class Acceptance:
    """A decision whether a calibration is used: for its rig, or for one campaign alone.

    Attributes
    ----------
    rig
        Whose calibration it is.
    calibration
        SHA-256 of its contents, in hexadecimal.
    campaign
        The only campaign that it is used for; None for all of the rig that have none of their own.
    in_use
        False to use it no longer.
    signed
        Who has decided it.
    """

    rig: str
    calibration: str
    campaign: str | None = None
    in_use: bool = True
    signed: Signed = NOBODY


@dataclass(frozen=True)
class CalibrationUncertainty:
    """The covariance of all parameters of all sensors of a calibration.

    What was held fixed has zeros.

    Attributes
    ----------
    sensors, parameters
        Names, in the order of the covariance: of the sensors, and of the parameters that each of them has.
    """

    sensors: tuple[str, ...]
    parameters: tuple[str, ...]
    covariance: NDArray[np.float64] = array(
        "1", "covariance of the parameters, in rad, mm and px", ("parameter", "by")
    )

    def of(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Return the covariance of sensors in this order, each with `SENSOR_PARAMETERS`.

        A parameter that sensors did not have yet when it was written was held fixed. Raises `InvalidInput`
        where sensors do not have one any more.
        """
        if not set(self.parameters) <= set(SENSOR_PARAMETERS):
            raise InvalidInput(
                f"the uncertainty of this calibration is that of {', '.join(self.parameters)}, but sensors "
                f"have {', '.join(SENSOR_PARAMETERS)} here: calibrate again"
            )
        own = len(self.parameters)
        places = np.array([SENSOR_PARAMETERS.index(name) for name in self.parameters])
        given = np.concatenate([own * self.sensors.index(name) + np.arange(own) for name in names])
        taken = np.concatenate([PER_SENSOR * k + places for k in range(len(names))])
        full = np.zeros((PER_SENSOR * len(names), PER_SENSOR * len(names)))
        full[np.ix_(taken, taken)] = self.covariance[np.ix_(given, given)]
        return full


@dataclass(frozen=True)
class CalibrationFactor:
    """How well the sensors of a view are known, as `metrology.calibration.point_factor` takes it.

    It stands beside what was measured with them. Columns of the root mean the same for all views of one
    calibration; there are none where it says nothing of itself.

    Attributes
    ----------
    view
        Whose points these sensors make.
    calibration
        SHA-256, in hexadecimal, of the sensors and the covariance of the calibration.
    sensors
        The reference camera first.
    orientations_rad
        Of the fringes; empty for cameras.
    parameters
        Names, in the order of the root: of those that each sensor has.
    missed, stated_px
        By how much each partner of a camera sees points beside the images of its rays, where that was looked
        at, and the deviation that the calibration states of such distances, rms over the points, px.
    times
        How many times as large as the calibration states the root is, since rays contradict it.
    turned_px
        By how much sensors have turned since the reference state, beyond what the root says, as far as rays
        tell: in px of the first partner.
    """

    view: str
    calibration: str
    sensors: tuple[Sensor, ...]
    orientations_rad: tuple[float, ...]
    parameters: tuple[str, ...]
    root: NDArray[np.float64] = array(
        "1", "square root of the covariance of the parameters, in rad, mm and px", ("parameter", "cause")
    )
    missed: tuple[MissedRays, ...] = ()
    stated_px: tuple[float, ...] = ()
    times: float = 1.0
    turned_px: float = 0.0

    @property
    def is_stated(self) -> bool:
        """Whether the calibration says how well the sensors are known."""
        return bool(self.root.shape[1])


@dataclass(frozen=True)
class Estimate:
    """A number that a calibration found of an artefact or of a camera.

    Attributes
    ----------
    what, owner
        What it is of which of them, by name.
    value, sigma
        In the unit of `what`; no standard deviation where none is known.
    sphere
        Of which sphere of a bar, 1 or 2; None of what is of the whole.
    """

    what: Estimated
    owner: str
    value: float
    sigma: float | None = None
    sphere: int | None = None

    def labelled(self) -> dict[str, float]:
        """Return it as tables for people have it, by names that carry the unit."""
        name, unit = name_of(self.what, self.owner, self.sphere), self.what.unit
        told = {f"{name} [{unit}]": self.value}
        return told if self.sigma is None else {**told, f"{name}, sigma [{unit}]": self.sigma}


@dataclass(frozen=True)
class CalibrationQuality:
    """How an adjustment went, and what it says of its own result.

    Attributes
    ----------
    gauge
        What fixes the world's frame.
    started_from
        Where its first values came from.
    iterations, residuals, parameters
        Of the adjustment.
    rms_by_type, rms_by_sensor, rms_by_pose
        Root mean square of the residuals, by what they are; names carry the unit.
    refused
        How many observations were left out, by reason.
    warnings
        What a person has to look at before this calibration is used; none for a sound one.
    bar_length_error_mm
        Of every pose of a ball bar, its length by a calibration that it took no part in, less the certified.
    board_rms_px
        Of every pose of a board, the residuals by a calibration that it took no part in.
    estimates
        What was found of artefacts and cameras.
    held
        What parameters of lenses were held at; names carry the unit.
    views
        Views that measure points, C1P1 or of cameras alone C1C2, in the order of `expected_sigma`.
    place, expected_sigma
        Places in the volume, and the standard deviation that the calibration alone gives a point there.
    residual_sensor, residual_px, residual
        A sample of residuals of board points: number of the sensor in the rig, where in its image, and what.
    scale
        What lengths were taken from, and how well it is known, in words.
    shape_sigma_mm
        Standard deviation of a point in the volume from the calibration alone, but for motions and the scale
        of the whole, of the view that knows it worst; None where it was not asked for.
    """

    gauge: str
    started_from: str
    iterations: int
    residuals: int
    parameters: int
    rms_by_type: dict[str, float]
    rms_by_sensor: dict[str, float]
    rms_by_pose: dict[str, float]
    refused: dict[str, int]
    warnings: tuple[str, ...]
    bar_length_error_mm: dict[str, float]
    board_rms_px: dict[str, float]
    estimates: tuple[Estimate, ...]
    held: dict[str, float]
    views: tuple[str, ...]
    place: NDArray[np.float64] = array("mm", "place in the volume", ("place", "component"), ("X", "Y", "Z"))
    expected_sigma: NDArray[np.float64] = array(
        "mm", "standard deviation of a point from the calibration alone", ("view", "place")
    )
    residual_sensor: NDArray[np.int32] = array("1", "number of the sensor", ("residual",))
    residual_px: NDArray[np.float64] = array(
        "px", "place in the image", ("residual", "component"), ("x", "y")
    )
    residual: NDArray[np.float64] = array(
        "px", "observed less expected", ("residual", "component"), ("x", "y")
    )
    scale: str = ""
    shape_sigma_mm: float | None = None

    def labelled(self) -> dict[str, float]:
        """Return what was found and what was held, as tables for people have it, by names with the unit."""
        found = {name: value for one in self.estimates for name, value in one.labelled().items()}
        return found | self.held

    def estimate(self, what: Estimated, owner: str) -> Estimate | None:
        """Return what was found of an artefact as a whole, or of a camera; None where nothing was."""
        same = (e for e in self.estimates if (e.what, e.owner, e.sphere) == (what, owner, None))
        return next(same, None)

    def held_out_bar_rms_mm(self) -> float:
        """Return the rms error of the held-out bar lengths; NaN when there was no bar."""
        errors = np.array(list(self.bar_length_error_mm.values()))
        return float(np.sqrt(np.mean(errors**2))) if errors.size else float("nan")
