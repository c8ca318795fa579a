"""Measurements of the virtual rig with calibrations that are off by what their covariance says.

No draws: with a square root L of r columns the r calibrations off by sqrt(r) L_k have exactly the covariance
L L^T among them, and the mean square over them is what one would come to by infinitely many.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.shelf import Shelf
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.deformation import correlate, gauges, strain
from sms_jobs.kinds.deformation.gauges import GaugesParameters
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.kinds.surface_ports import maker_of
from sms_jobs.metrology.calibration.pair_points import moved_sensor
from sms_jobs.metrology.calibration.point_factor import square_root
from sms_jobs.metrology.geometry.camera import PER_SENSOR
from sms_jobs.metrology.geometry.planes import covariance_in_space
from sms_jobs.records.calibration import CalibrationUncertainty
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of

Floats: TypeAlias = NDArray[np.float64]

_DIAGONAL = [0, 3, 5]


@dataclass(frozen=True)
class Stated:
    """Errors of n values, and what is said of them: (n,) each, all in one unit.

    Attributes
    ----------
    error
        Measured less true.
    noise, calibration
        The two parts of the standard deviation.
    """

    error: Floats
    noise: Floats
    calibration: Floats


QUANTITIES = ("points", "displacement", "strain", "gauges")


def off_calibrations(
    calibration: Calibration, uncertainty: CalibrationUncertainty, view: str
) -> Iterator[Calibration]:
    """Yield calibrations that have the covariance of a view's sensors among them, the others as they are."""
    names = view_of(view).sensors
    root = square_root(uncertainty.of(names))
    for column in np.sqrt(root.shape[1]) * root.T:
        steps = dict(zip(names, column.reshape(-1, PER_SENSOR), strict=True))
        sensors = []
        for one in calibration.rig.sensors:
            step = steps.get(one.name)
            if step is not None:
                intrinsics, pose = moved_sensor((one.intrinsics, one.pose), step)
                one = replace(one, intrinsics=intrinsics, pose=pose)
            sensors.append(one)
        yield replace(calibration, rig=replace(calibration.rig, sensors=tuple(sensors)))


def measured_with(
    shelf: Shelf,
    subjects: tuple[Subject, Subject],
    calibration: Calibration,
    uncertainty: CalibrationUncertainty,
    gauge: GaugesParameters,
) -> None:
    """Measure what is recorded of two states with a calibration, in place of what was there."""
    kind = all_kinds()[maker_of(subjects[0].view).kind]
    for subject in subjects:
        shelf.records[CALIBRATION, subject] = {"calibration": calibration, "uncertainty": uncertainty}
        shelf.run(kind, subject, kind.parameters())
    last = subjects[1]
    shelf.run(correlate.KIND, last, correlate.KIND.parameters())
    shelf.run(strain.KIND, last, strain.KIND.parameters())
    shelf.run(gauges.KIND, last, gauge)


def errors_of(
    shelf: Shelf, subjects: tuple[Subject, Subject], true_gauge: Callable[[], Floats]
) -> dict[str, Stated]:
    """Return the errors of what `measured_with` left, by quantity; components pooled."""
    at_rest, last = subjects
    kind = maker_of(last.view).kind
    truth = shelf.truth(last)
    surface = shelf.records[kind, at_rest]["surface"]
    moved, strained = (
        shelf.records[one.name, last][name]
        for one, name in ((correlate.KIND, "displacement"), (strain.KIND, "strain"))
    )
    read = shelf.records[gauges.KIND.name, last]["gauges"]

    def stated(error: Floats, noise: NDArray[np.floating], part: NDArray[np.floating]) -> Stated:
        known = np.isfinite(error) & np.isfinite(noise) & np.isfinite(part)
        return Stated(*(each[known].astype(np.float64) for each in (error, noise, part)))

    def vectors(error: Floats, covariance: NDArray[np.floating], part: NDArray[np.floating]) -> Stated:
        """Return lengths: errors by noise lie along the rays, where single components have no variance."""
        spread = covariance_in_space(covariance)[_DIAGONAL].sum(axis=0, dtype=np.float64)
        lengths = (np.sqrt(np.sum(np.square(each, dtype=np.float64), axis=0)) for each in (error, part))
        length, common = lengths
        return stated(length, np.sqrt(spread), common)

    return {
        "points": vectors(
            surface.position - truth.shape.xyz, surface.covariance, surface.sigma_calibration
        ),
        "displacement": vectors(
            moved.displacement - truth.displacement, moved.covariance, moved.sigma_calibration
        ),
        "strain": stated(
            strained.strain - truth.strain(strained.measure), strained.sigma, strained.sigma_calibration
        ),
        "gauges": stated(read.strain - true_gauge(), read.sigma, read.sigma_calibration),
    }
