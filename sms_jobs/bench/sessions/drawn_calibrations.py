"""Measurements of the virtual rig with calibrations that are off by what their covariance says.

No draws: with a square root L of r columns the r calibrations off by sqrt(r) L_k have exactly the covariance
L L^T among them, and the mean square over them is what one would come to by infinitely many.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sms_jobs.bench.sessions.bar_session import BarSession
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.deformation import correlate, gauges, strain
from sms_jobs.kinds.deformation.gauges import GaugesParameters
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.surface_ports import maker_of, position_covariance
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.bundle.adjustment import adjust
from sms_jobs.metrology.calibration.pair_points import moved_sensor
from sms_jobs.metrology.calibration.point_factor import square_root
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS
from sms_jobs.records.calibration import CalibrationUncertainty
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import DisplacementField, StrainField, Surface
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of
from sms_jobs.testing.shelf import Shelf

_DIAGONAL = [0, 3, 5]
_SQUARE_PX = 32


GAUGES = ("along x=0 y=0 length=30 width=20", "across x=0 y=0 length=30 width=20 angle=90")


@dataclass(frozen=True)
class Found:
    """What was measured, by quantity, (components, rows, columns): NaN where nothing was.

    Attributes
    ----------
    value
        Points, displacement (mm), strain and gauges.
    noise
        Standard deviations, but for the calibration's part; of vectors those of lengths, (1, rows, columns).
    calibration
        The calibration's part of them.
    """

    value: dict[str, Floats]
    noise: dict[str, Floats]
    calibration: dict[str, Floats]


@dataclass(frozen=True)
class Ratios:
    """Of one quantity, rms over values and calibrations.

    Attributes
    ----------
    calibration
        The stated part of the calibration over the scatter about what the exact calibration makes of the same
        frames; of means over squares of pixels, which it is as large for as for one pixel.
    total, noise
        Errors over the stated standard deviation, of both parts and without the calibration's; NaN where the
        truth was not asked for.
    observed
        That scatter, in mm or as strain.
    """

    calibration: float
    total: float
    noise: float
    observed: float


def off_calibrations(
    calibration: Calibration, uncertainty: CalibrationUncertainty, view: str
) -> Iterator[Calibration]:
    """Yield calibrations that have the covariance of a view's sensors among them, the others as they are."""
    names = view_of(view).sensors
    root = square_root(uncertainty.of(names))
    for column in np.sqrt(root.shape[1]) * root.T:
        yield moved(calibration, names, column)


def moved(calibration: Calibration, names: Sequence[str], steps: Floats) -> Calibration:
    """Return a calibration whose sensors of some names are off by steps of all their parameters in turn."""
    by_name = dict(zip(names, steps.reshape(-1, PER_SENSOR), strict=True))
    sensors = []
    for one in calibration.rig.sensors:
        if one.name in by_name:
            intrinsics, pose = moved_sensor((one.intrinsics, one.pose), by_name[one.name])
            one = replace(one, intrinsics=intrinsics, pose=pose)
        sensors.append(one)
    return replace(calibration, rig=replace(calibration.rig, sensors=tuple(sensors)))


def of_a_bar_session(calibration: Calibration, session: BarSession) -> CalibrationUncertainty:
    """Return what a calibration from poses of a bar would not know of the sensors of a rig."""
    names = tuple(sensor.name for sensor in calibration.rig.sensors)
    size = PER_SENSOR * len(names)
    covariance = adjust(session.problem).covariance[:size, :size].copy()
    return CalibrationUncertainty(names, SENSOR_PARAMETERS, covariance)


def measured_with(
    shelf: Shelf,
    subjects: tuple[Subject, Subject],
    calibration: Calibration,
    uncertainty: CalibrationUncertainty,
    parameters: Parameters,
) -> Found:
    """Measure what is recorded of two states with a calibration."""
    at_rest, last = subjects
    maker = maker_of(last.view).kind
    for subject in subjects:
        shelf.records[CALIBRATION, subject] = {"calibration": calibration, "uncertainty": uncertainty}
        shelf.run(all_kinds()[maker], subject, parameters)
    shelf.run(correlate.KIND, last, correlate.KIND.parameters())
    shelf.run(strain.KIND, last, strain.KIND.parameters())
    shelf.run(gauges.KIND, last, GaugesParameters(gauge=GAUGES))
    surface: Surface = shelf.records[maker, at_rest]["surface"]
    moved: DisplacementField = shelf.records[correlate.KIND.name, last]["displacement"]
    strained: StrainField = shelf.records[strain.KIND.name, last]["strain"]
    read: GaugeReadings = shelf.records[gauges.KIND.name, last]["gauges"]
    parts = surface.sigma_calibration, moved.sigma_calibration, strained.sigma_calibration
    return Found(
        {
            "points": _field(surface.position),
            "displacement": _field(moved.displacement),
            "strain": _field(strained.strain),
            "gauges": _field(read.strain),
        },
        {
            "points": _lengths(position_covariance(surface)),
            "displacement": _lengths(moved.covariance),
            "strain": _field(strained.sigma),
        },
        dict(zip(("points", "displacement", "strain"), map(_field, parts), strict=True))
        | {"gauges": _field(read.sigma_calibration)},
    )


def _field(field: NDArray[np.floating] | None) -> Floats:
    """Return a field (components, rows, columns) or readings (gauges,) in doubles, as a field."""
    assert field is not None
    return np.asarray(field if field.ndim > 1 else field[None, None], dtype=np.float64)


def _means(field: Floats) -> Floats:
    """Return means over squares of pixels of which most have a value; single readings as they are.

    A calibration that is off by micrometres moves some pixels across the rim of a gauge disc or of a region:
    what that makes of their noise is no part of the calibration's, and means have next to nothing of it.
    """
    if len(field[0]) < _SQUARE_PX:
        return field
    rows, columns = (length // _SQUARE_PX for length in field.shape[1:])
    inside = field[:, : rows * _SQUARE_PX, : columns * _SQUARE_PX]
    squares = inside.reshape(len(field), rows, _SQUARE_PX, columns, _SQUARE_PX)
    known = np.isfinite(squares)
    count = known.sum(axis=(2, 4))
    mean = np.where(known, squares, 0.0).sum(axis=(2, 4)) / np.maximum(count, 1)
    return np.where(2 * count >= _SQUARE_PX**2, mean, np.nan)


def _lengths(covariance: NDArray[np.floating]) -> Floats:
    """Return the root of the trace: noise lies along the rays, and some components have next to none."""
    trace = covariance[_DIAGONAL].sum(axis=0, dtype=np.float64)
    return np.asarray(np.sqrt(trace))[None]


def ratios(
    calibration: Calibration,
    campaign: Campaign,
    uncertainty: CalibrationUncertainty,
    parameters: Parameters,
    say: Callable[[str], None],
    threads: int,
) -> dict[str, Ratios]:
    """Return what is stated over what is found, of the first view at rest and at the last state."""
    shelf = Shelf(campaign, threads)
    states = campaign.reference.label, campaign.states[-1].label
    subjects = (
        Subject(campaign.name, states[0], campaign.views[0]),
        Subject(campaign.name, states[1], campaign.views[0]),
    )
    for subject in subjects:
        shelf.record(subject)
    exact = measured_with(shelf, subjects, calibration, uncertainty, parameters)
    truth = shelf.truth(subjects[1])
    true = {
        "points": _field(truth.shape.xyz),
        "displacement": _field(truth.displacement),
        "strain": _field(truth.strain("green-lagrange")),
    }
    square: dict[str, list[Floats]] = {}
    each = list(off_calibrations(calibration, uncertainty, campaign.views[0]))
    for count, off in enumerate(each, start=1):
        say(f"{campaign.name}: calibration {count} of {len(each)} that are off")
        found = measured_with(shelf, subjects, off, uncertainty, parameters)
        for name in found.value:
            sums = np.array(_sums(name, found, exact, true.get(name)))
            square.setdefault(name, []).append(sums)
    return {name: _ratios(np.sum(each, axis=0)) for name, each in square.items()}


def _sums(name: str, found: Found, exact: Found, true: Floats | None) -> tuple[float, ...]:
    """Return sums over values: stated part, scatter, scores by both parts and by noise alone, and counts."""
    difference = found.value[name] - exact.value[name]
    part, off = (np.square(_means(each)) for each in (exact.calibration[name], difference))
    both = np.isfinite(part).all(axis=0) & np.isfinite(off).all(axis=0)
    scored = total = noise = 0.0
    if true is not None:
        error, common = (np.square(each) for each in (found.value[name] - true, found.calibration[name]))
        alone = np.square(found.noise[name])
        if len(alone) == 1:
            error, common = error.sum(axis=0, keepdims=True), common.sum(axis=0, keepdims=True)
        known = np.isfinite(error + common + alone) & (alone > 0.0)
        scored = float(np.count_nonzero(known))
        total = float(np.sum((error / (common + alone))[known]))
        noise = float(np.sum((error / alone)[known]))
    return float(part[:, both].sum()), float(off[:, both].sum()), total, noise, scored, float(both.sum())


def _ratios(sums: Floats) -> Ratios:
    part, off, total, noise, scored, count = sums
    nothing = float("nan")
    return Ratios(
        float(np.sqrt(part / off)),
        float(np.sqrt(total / scored)) if scored else nothing,
        float(np.sqrt(noise / scored)) if scored else nothing,
        float(np.sqrt(off / count)),
    )
