"""The calibration's part of what is measured: from the record that stands beside a surface to sigma."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.kind import Inputs, Port
from sms_jobs.kinds.products import CALIBRATION_FACTOR, UNCERTAINTY
from sms_jobs.metrology.arrays import Floats, Ints, Mask, Singles
from sms_jobs.metrology.calibration.point_factor import (
    KnownView,
    economical,
    motion_factor,
    point_factor,
    sigma_of,
    square_root,
    turns,
)
from sms_jobs.metrology.deformation.fields.rigid_motion import RigidMotion, common_factor
from sms_jobs.metrology.deformation.strain.common_errors import (
    directional,
    mean_slopes,
    strain_factor,
    tangents,
)
from sms_jobs.metrology.deformation.strain.gauges import GaugeValue
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS, Camera, Pose
from sms_jobs.metrology.images.coarse_maps import Samples, sample_blocks, spread
from sms_jobs.records.calibration import CalibrationFactor, CalibrationUncertainty
from sms_jobs.records.fields import DisplacementField, Surface
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import Vector
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject

States: TypeAlias = tuple[KnownView, KnownView]
"""A view at the reference state and at a deformed one."""

REFERENCE, DEFORMED = "reference", "deformed"
"""Keys of the factors of both states, beside a displacement."""
OF_BOTH = (CALIBRATION_FACTOR.of(REFERENCE), CALIBRATION_FACTOR.of(DEFORMED))
_MOST_UNDER_A_GAUGE = 2000
_BLOCKS_OF_STRAIN = 32  # along the longer side: strain is that of a disc, and each place costs eight points


def calibration_factor(
    inputs: Inputs, port: Port, calibration: Calibration, orientations_rad: tuple[float, ...] = ()
) -> CalibrationFactor:
    """Return how well the sensors of the job's view are known; without columns where nobody says."""
    names = inputs.view.triangulating
    root = np.zeros((PER_SENSOR * len(names), 0))
    uncertainty = inputs.read(port, UNCERTAINTY) if inputs.has(port, UNCERTAINTY) else None
    if uncertainty is not None:
        rows = [PER_SENSOR * uncertainty.sensors.index(name) + np.arange(PER_SENSOR) for name in names]
        root = square_root(uncertainty.of(uncertainty.sensors))[np.concatenate(rows)]
    return CalibrationFactor(
        str(inputs.view),
        _named(calibration, uncertainty),
        tuple(calibration.rig.sensor(name) for name in names),
        orientations_rad,
        SENSOR_PARAMETERS,
        root,
    )


def _named(calibration: Calibration, uncertainty: CalibrationUncertainty | None) -> str:
    """Return what names a calibration by what is in it."""
    if uncertainty is None:
        return hashlib.sha256(repr(calibration.rig.sensors).encode()).hexdigest()
    known = hashlib.sha256(repr((calibration.rig.sensors, uncertainty.sensors)).encode())
    known.update(uncertainty.covariance.tobytes())
    return known.hexdigest()


def known_view(factor: CalibrationFactor) -> KnownView:
    """Return a view as metrology takes it; a parameter that sensors had not got then is known exactly."""
    own, places = len(factor.parameters), [SENSOR_PARAMETERS.index(name) for name in factor.parameters]
    root = np.zeros((PER_SENSOR * len(factor.sensors), factor.root.shape[1]))
    for number in range(len(factor.sensors)):
        rows = [PER_SENSOR * number + place for place in places]
        root[rows] = factor.root[own * number : own * (number + 1)]
    cameras = tuple(Camera(s.intrinsics, s.pose, s.columns, s.rows) for s in factor.sensors)
    return KnownView(cameras, factor.calibration, root, factor.orientations_rad)


def moved_since(reference: CalibrationFactor, deformed: CalibrationFactor) -> CalibrationFactor:
    """Return how well sensors are known at a deformed state, beside the reference state.

    What one calibration is wrong by in both states nearly cancels in a displacement, unless a sensor has
    moved in between. Then it has changed by how much rays are missed. Nobody knows which sensor has turned,
    and nothing is seen of turns that move what it sees along these images: all are taken to have, about both
    axes.
    """
    if reference.calibration != deformed.calibration:
        return deformed
    each = zip(reference.missed, deformed.missed, strict=False)
    change = max((now.change_px(before) for before, now in each), default=0.0)
    # That rays contradict the calibration at the deformed state alone is in its root, and does not cancel.
    counted = (deformed.times - reference.times) * max(deformed.stated_px, default=0.0)
    return replace(deformed, turned_px=float(np.sqrt(max(0.0, change**2 - counted**2))))


def position_sigma(factor: CalibrationFactor, surface: Surface) -> Singles | None:
    """Return the calibration's part of the standard deviation of positions, (3, rows, columns) in mm.

    None where the calibration states nothing.
    """
    if not factor.is_stated:
        return None
    samples = sample_blocks(surface.reason == Reason.VALID)
    view = economical(known_view(factor))
    return spread(samples, sigma_of(point_factor(view, _at(samples, surface.position))).T)


def displacement_sigma(states: States, surface: Surface, moved: DisplacementField) -> Singles:
    """Return the calibration's part of the standard deviation of displacements, (3, rows, columns) in mm."""
    samples = sample_blocks(moved.reason == Reason.VALID)
    factor = motion_factor(
        economical(states[0]),
        economical(states[1]),
        _at(samples, surface.position),
        _at(samples, moved.displacement),
    )
    return spread(samples, sigma_of(factor).T)


def strain_sigma(
    states: States,
    surface: Surface,
    moved: DisplacementField,
    labels: NDArray[np.int32],
    gauge_length: float,
    reach_px: float,
    x_axis: Vector,
    *,
    green_lagrange: bool,
) -> Singles:
    """Return the calibration's part of the standard deviation of strains xx, yy, xy, (3, rows, columns).

    `reach_px` is half the gauge length in the image.
    """
    samples = sample_blocks((moved.reason == Reason.VALID) & (labels > 0), _BLOCKS_OF_STRAIN)
    radius = 0.5 * gauge_length
    found = tangents(
        surface.position,
        moved.displacement,
        labels,
        samples.pixels,
        radius=radius,
        reach_px=max(1, round(reach_px)),
        x_axis=x_axis,
    )
    sigma = np.full((3, len(samples.rows)), np.nan)
    known = np.asarray(np.isfinite(found.axes).all(axis=(1, 2)))
    if known.any():
        own = found.only(known)
        before, after = slopes_of(states, own.place, own.axes, own.moved, own.stretched, 0.5 * radius)
        strain = strain_factor(own.axes, own.stretched, before, after, x_axis, green_lagrange=green_lagrange)
        sigma[:, known] = sigma_of(strain).T
    return spread(samples, sigma)


def gauge_sigma(
    states: States,
    surface: Surface,
    moved: DisplacementField,
    read: GaugeValue,
    frame: Pose,
    angle_rad: float,
    *,
    green_lagrange: bool,
) -> float:
    """Return the calibration's part of the standard deviation of what a gauge reads; NaN without.

    The fit under the grid is done to the factor's columns as it was to the displacement, over at most 2000 of
    the pixels. `frame` brings the gauge's frame into the world, and `angle_rad` is its direction there.
    """
    rows, columns = np.nonzero(read.under)
    if not len(rows):
        return float("nan")
    some = slice(None, None, -(-len(rows) // _MOST_UNDER_A_GAUGE))
    place, shift = (each[:, rows[some], columns[some]].T for each in (surface.position, moved.displacement))
    turn = frame.matrix()
    axes, slopes = read.axes @ turn.T, read.slopes @ turn.T
    before, after = columns_of_both(
        states,
        *(
            mean_slopes(point_factor(view, points), place, axes)
            for view, points in zip(states, (place, place + shift), strict=True)
        ),
    )
    x, y, z = turn @ [np.cos(angle_rad), np.sin(angle_rad), 0.0]
    found = strain_factor(
        axes[None],
        (axes + slopes)[None],
        before[None],
        after[None],
        (float(x), float(y), float(z)),
        green_lagrange=green_lagrange,
    )
    return float(sigma_of(found[0, 0]))


@dataclass(frozen=True)
class RelativeSigma:
    """The calibration's part of the standard deviations of a motion (6,), and of what is left without it."""

    motion: Floats
    field: Singles


def relative_sigma(
    states: States,
    surface: Surface,
    moved: DisplacementField,
    motion: RigidMotion,
    pixels: tuple[Ints, Ints],
) -> RelativeSigma:
    """Return what the calibration adds to a region's motion, and to a displacement without it.

    The motion is fitted to the factor's columns as it was to the displacement, over at most 2000 of the
    region's `pixels`: what region and displacement have in common cancels.
    """
    before, after = map(economical, states)
    some = slice(None, None, -(-len(pixels[0]) // _MOST_UNDER_A_GAUGE))
    rows, columns = pixels[0][some], pixels[1][some]
    points, shift = (field[:, rows, columns].T for field in (surface.position, moved.displacement))
    of_motion = common_factor(motion, points, motion_factor(before, after, points, shift))
    samples = sample_blocks(moved.reason == Reason.VALID)
    points, shift = (_at(samples, field) for field in (surface.position, moved.displacement))
    left = motion_factor(before, after, points, shift) - motion.modes(points) @ of_motion
    return RelativeSigma(sigma_of(of_motion), spread(samples, sigma_of(left).T))


def merged_sigma(
    views: Sequence[tuple[States, Surface, DisplacementField]],
    weights: Sequence[Floats],
    valid: Mask,
) -> Singles:
    """Return the calibration's part of the standard deviation of a displacement that views are merged to.

    Parameters
    ----------
    views
        Both states of each, its surface at the reference state and its displacement.
    weights
        (rows, columns) of each, which add up to 1.
    valid
        (rows, columns), where there is a merged displacement.

    Returns
    -------
    (3, rows, columns) in mm. What views have in common, as all that one calibration says, adds up as such.
    """
    samples = sample_blocks(valid)
    total: dict[tuple[str, int], Floats] = {}
    for number, ((states, surface, moved), weight) in enumerate(zip(views, weights, strict=True), start=1):
        share = weight[samples.pixels]
        seen = share > 0.0
        place, shift = (_at(samples, field)[seen] for field in (surface.position, moved.displacement))
        ends = ((states[0], place, -share[seen]), (states[1], place + shift, share[seen]))
        for view, points, signed in ends:
            factor = signed[:, None, None] * point_factor(view, points)
            common, own = np.split(factor, [factor.shape[2] - view.own], axis=2)
            for of, columns in ((0, common), (number, own)):
                nothing = np.zeros((len(samples.rows), 3, columns.shape[2]))
                total.setdefault((view.calibration, of), nothing)[seen] += columns
    return spread(samples, np.sqrt(sum(sigma_of(sums) ** 2 for sums in total.values())).T)


def slopes_of(
    states: States, place: Floats, axes: Floats, moved: Floats, stretched: Floats, step: float
) -> tuple[Floats, Floats]:
    """Return the changes of both states' factors along vectors (n, 2, 3) of a surface, (n, 2, 3, r) each."""
    before, after = (
        directional(partial(point_factor, view), at, along, step)
        for view, at, along in zip(map(economical, states), (place, moved), (axes, stretched), strict=True)
    )
    return columns_of_both(states, before, after)


def columns_of_both(states: States, before: Floats, after: Floats) -> tuple[Floats, Floats]:
    """Return what both states' factors (..., r) make in columns that both have.

    Those of one calibration mean the same; those of two are independent, and stand side by side.
    """
    if states[0].calibration == states[1].calibration:
        return before, after
    without = np.zeros_like(after), np.zeros_like(before)
    return np.concatenate([before, without[0]], axis=-1), np.concatenate([without[1], after], axis=-1)


def states_of(inputs: Inputs, port: Port, about: Subject | None = None) -> States | None:
    """Return how well a view was known in both states of a displacement at a port; None where it is not."""
    if not all(inputs.has(port, product, about) for product in OF_BOTH):
        return None
    return states_from(*(inputs.read(port, product, about) for product in OF_BOTH))


def states_from(reference: CalibrationFactor, deformed: CalibrationFactor) -> States:
    """Return how well a view was known in both states, with what has turned in between."""
    before, after = known_view(reference), known_view(deformed)
    if deformed.turned_px == 0.0:
        return before, after
    turned = deformed.turned_px * turns(after.sensors)
    return before.with_own(np.zeros_like(turned)), after.with_own(turned)


def median_part(sigma: Singles | None, unit: str) -> dict[str, float]:
    """Return the median length of the calibration's part (3, rows, columns), for people to search by."""
    if sigma is None:
        return {}
    length = np.sqrt(np.sum(np.square(sigma[:, np.isfinite(sigma[0])], dtype=np.float64), axis=0))
    return {f"median_sigma_calibration_{unit}": float(np.median(length))} if length.size else {}


def _at(samples: Samples, field: Floats) -> Floats:
    """Return a vector field (3, rows, columns) at samples, (n, 3)."""
    return np.ascontiguousarray(field[:, samples.rows, samples.columns].T)
