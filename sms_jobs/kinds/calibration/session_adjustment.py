"""From the observations of a calibration session to a bundle adjustment, and from its result to records."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial.transform import Rotation

from sms_jobs.errors import CalibrationFailed
from sms_jobs.kinds.calibration.seen_boards import Boards, board_views, told_board
from sms_jobs.kinds.calibration.sessions import SessionPlan
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.board_views import Refusal
from sms_jobs.metrology.calibration.bundle.covariance import point_covariance
from sms_jobs.metrology.calibration.bundle.cross_validation import CrossValidation
from sms_jobs.metrology.calibration.bundle.problem import (
    BarPoints,
    BarPose,
    BoardPoints,
    BoardPose,
    BundleBar,
    BundleProblem,
    BundleSensor,
    SensorPrior,
)
from sms_jobs.metrology.calibration.bundle.result import Adjustment, Nuisance
from sms_jobs.metrology.calibration.estimates import Estimated
from sms_jobs.metrology.calibration.pair_points import box_grid
from sms_jobs.metrology.calibration.starting.sensor_start import seen_pose, usable_views
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS, Pose, project
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.transforms import transform
from sms_jobs.metrology.geometry.wrapped_sheets import in_space
from sms_jobs.records.artefacts import BallBar
from sms_jobs.records.calibration import CalibrationQuality, CalibrationUncertainty, Estimate
from sms_jobs.records.observations import BarObservation, BoardObservation
from sms_jobs.records.scene import Rigid
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor
from sms_jobs.records.times import UNTIMED
from sms_jobs.records.views import Role, role_of, view_of

Bars = Mapping[str, Sequence[BarObservation]]

_OUTER = 6  # parameters of a sensor that place it
_GRID = 7  # places along each side of the volume at which the expected deviation is given


@dataclass(frozen=True)
class Start:
    """What an adjustment begins with.

    Attributes
    ----------
    rig
        The sensors.
    boards
        X_world = R X_board + T of each pose of a board.
    world
        The pose whose board is the world; None where the world is that of an earlier calibration.
    origin
        In words.
    pitch
        Scale and relative standard deviation of boards whose pitch was found before, by name.
    prior
        What is known of the inner parameters.
    usable
        Sensors and poses whose views of a board show it.
    refused
        Why points of other views are left out, and how many.
    wrong
        Views that are not what they are said to be: why, by pose.
    """

    rig: Rig
    boards: Mapping[str, Pose]
    world: str | None
    origin: str
    pitch: Mapping[str, tuple[float, float]]
    prior: SensorPrior | None = None
    usable: frozenset[tuple[str, str]] = frozenset()
    refused: Mapping[str, int] = field(default_factory=dict)
    wrong: Mapping[str, str] = field(default_factory=dict)


def refusals(refused: Iterable[Refusal]) -> dict[str, int]:
    """Return how many points of views were refused, by reason."""
    counts: dict[str, int] = {}
    for one in refused:
        name = f"{one.sensor} in pose {one.pose}: {one.reason}"
        counts[name] = counts.get(name, 0) + one.count
    return counts


def rigid_pose(motion: Rigid) -> Pose:
    """Return a rigid motion as a pose: X = R x + T."""
    return Pose.from_arrays(
        Rotation.from_rotvec(motion.rotation_rad).as_matrix(), np.array(motion.translation_mm)
    )


def start_of_rig(plan: SessionPlan, sensors: Mapping[str, tuple[Intrinsics, Pose]]) -> Rig:
    """Return the rig of a session with inner parameters and poses by the names of its sensors."""
    found = []
    for size in plan.session.sensors:
        role = role_of(size.name)
        found.append(Sensor(size.name, role, size.columns, size.rows, *sensors[size.name]))
    return Rig(plan.rig, tuple(found))


def start_from_last(
    plan: SessionPlan,
    last: Calibration,
    uncertainty: CalibrationUncertainty | None,
    quality: CalibrationQuality | None,
    boards: Boards,
) -> Start:
    """Return the start of a session on site: the last calibration, in whose frame the boards are placed.

    The lenses keep what was known of them; where the sensors stand is found anew, but for the first, which
    keeps the world's frame. The length of the board's pitch is that which the last calibration found.
    """
    sensors = {s.name: s for s in last.rig.sensors}
    poses: dict[str, Pose] = {}
    bent = [s.name for s in last.rig.sensors if s.intrinsics.model != "plain"]
    usable, refused = usable_views([v for v in board_views(plan, boards) if v.sensor in sensors], bent)
    for view, _ in sorted(usable, key=lambda seen: -len(seen[0].point)):
        if view.pose in poses:
            continue
        sensor = sensors[view.sensor]
        seen = seen_pose(sensor.intrinsics, view.in_space, view.pixel)
        turn = sensor.pose.matrix().T
        poses[view.pose] = Pose.from_arrays(
            turn @ seen.matrix(), turn @ (np.array(seen.translation) - np.array(sensor.pose.translation))
        )
    prior = None if uncertainty is None else SensorPrior(_lens_information(last.rig, uncertainty))
    pitch = {}
    for name in {one.artefact for seen_in in boards.values() for one in seen_in}:
        scale = None if quality is None else quality.estimate(Estimated.PITCH_SCALE, name)
        if scale is not None:
            pitch[name] = (scale.value, scale.sigma or 0.0)
    shown = frozenset((v.sensor, v.pose) for v, _ in usable)
    return Start(last.rig, poses, None, known_as(last), pitch, prior, shown, refusals(refused))


def known_as(calibration: Calibration) -> str:
    """Return how an adjustment that starts from a calibration names it."""
    return f"the calibration valid from {calibration.valid_from}"


def _lens_information(rig: Rig, uncertainty: CalibrationUncertainty) -> Floats:
    """Return the inverse covariance of all lenses; 0 for where sensors stand and for what was fixed."""
    names = [s.name for s in rig.sensors]
    covariance = uncertainty.of(names)
    lens = np.tile(np.arange(PER_SENSOR) >= _OUTER, len(names)) & (np.diag(covariance) > 0.0)
    information: Floats = np.zeros(covariance.shape)
    which = np.flatnonzero(lens)
    information[np.ix_(which, which)] = np.linalg.inv(covariance[np.ix_(which, which)])
    return information


def problem_of(
    plan: SessionPlan, start: Start, boards: Boards, bars: Bars, fixed: Mapping[str, tuple[str, ...]]
) -> BundleProblem:
    """Return the adjustment of everything that was observed.

    Parameters
    ----------
    plan, start
        What was shown, and what to begin with.
    boards, bars
        Observations by pose; poses that nobody saw are left out.
    fixed
        Parameters that a sensor is not given freely, by its name.
    """
    sensors = tuple(
        BundleSensor(s.name, s.intrinsics, s.pose, (s.columns, s.rows), _fixed(start, s, fixed[s.name]))
        for s in start.rig.sensors
    )
    number = {s.name: k for k, s in enumerate(start.rig.sensors)}
    board_names = tuple(dict.fromkeys(o.artefact for seen in boards.values() for o in seen))
    bar_names = tuple(dict.fromkeys(o.artefact for seen in bars.values() for o in seen))
    views = [
        v for v in board_views(plan, boards) if (v.sensor, v.pose) in start.usable and v.pose in start.boards
    ]
    poses = list(dict.fromkeys(v.pose for v in views))
    if start.world is not None and start.world not in poses:
        raise CalibrationFailed(
            f"no sensor shows the board in pose {start.world}, which is to be the world's frame; record it "
            "again, or start the session with another pose"
        )
    artefact_of = {p.label: p.artefact for p in plan.poses}
    centres = {pose: middle_centres(seen) for pose, seen in bars.items()}
    bar_poses = [pose for pose, c in centres.items() if np.isfinite(c).any()]
    return BundleProblem(
        sensors,
        tuple(told_board(plan, name, start.pitch.get(name), views, bool(bar_names)) for name in board_names),
        tuple(_bar(plan, name) for name in bar_names),
        tuple(BoardPose(p, board_names.index(artefact_of[p]), start.boards[p]) for p in poses),
        tuple(BarPose(p, bar_names.index(artefact_of[p]), centres[p]) for p in bar_poses),
        tuple(
            BoardPoints(
                poses.index(v.pose),
                number[v.sensor],
                start.rig.sensors[number[v.sensor]].role is Role.PROJECTOR,
                v.point * start.pitch.get(artefact_of[v.pose], (1.0, 0.0))[0],
                v.pixel,
                v.sigma_px,
            )
            for v in views
        ),
        tuple(
            BarPoints(
                bar_poses.index(pose),
                number[one.camera],
                number[one.projector],
                one.sphere,
                one.camera_px,
                one.projector_px,
                one.projector_sigma_px,
            )
            for pose, seen in bars.items()
            for one in seen
            if len(one.sphere) and pose in bar_poses
        ),
        None if start.world is None else poses.index(start.world),
        start.prior,
        None if plan.session.volume is None else _corners(plan.session.volume),
    )


_PLACED = ("rx", "ry", "rz", "tx", "ty", "tz")


def _fixed(start: Start, sensor: Sensor, fixed: tuple[str, ...]) -> tuple[str, ...]:
    """Return what a sensor keeps; the first one keeps its place where no board is the world."""
    holds = start.world is None and sensor.name == start.rig.sensors[0].name
    return (*_PLACED, *fixed) if holds else fixed


def _bar(plan: SessionPlan, name: str) -> BundleBar:
    bar = plan.session.artefacts[name]
    assert isinstance(bar, BallBar)
    return BundleBar(name, bar.length_mm, bar.length_sigma_mm, bar.radius_mm, bar.radius_sigma_mm)


def _corners(box: Box) -> tuple[Floats, Floats]:
    return np.array(box.low), np.array(box.high)


def middle_centres(seen: Sequence[BarObservation]) -> Floats:
    """Return the middle of where views saw the spheres, (2, 3); NaN for one that none saw."""
    centres = np.stack([one.centre for one in seen])
    finite = np.isfinite(centres.sum(axis=2))
    middle = np.full((2, 3), np.nan)
    for k in range(2):
        if finite[:, k].any():
            middle[k] = np.median(centres[finite[:, k], k], axis=0)
    return middle


def calibration_of(
    plan: SessionPlan, start: Start, found: Adjustment, problem: BundleProblem, origin: str
) -> Calibration:
    """Return the calibration that an adjustment found."""
    sensors = tuple(
        replace(old, intrinsics=new.intrinsics, pose=new.pose)
        for old, new in zip(start.rig.sensors, found.sensors, strict=True)
    )
    volume = plan.session.volume or _observed_box(found, problem)
    return Calibration(Rig(plan.rig, sensors), volume, plan.began or UNTIMED, origin)


def _observed_box(found: Adjustment, problem: BundleProblem) -> Box:
    """Return the box around all spheres, or, without any, around all points of boards."""
    seen = found.centres.reshape(-1, 3)
    seen = seen[np.isfinite(seen).all(axis=1)]
    if not len(seen):
        boards = [
            transform(found.board_poses[p.pose], in_space(p.point, radius))
            for p in problem.board_points
            for radius in (problem.boards[problem.board_poses[p.pose].board].radius_mm,)
        ]
        seen = np.concatenate(boards)
    low, high = seen.min(axis=0), seen.max(axis=0)
    if np.any(high <= low):
        raise CalibrationFailed(
            "the poses span no volume; move the artefact in all directions, or give [session.volume]"
        )
    return Box(
        (float(low[0]), float(low[1]), float(low[2])), (float(high[0]), float(high[1]), float(high[2]))
    )


def uncertainty_of(found: Adjustment) -> CalibrationUncertainty:
    """Return the covariance of the sensors' parameters."""
    count = PER_SENSOR * len(found.sensors)
    covariance = np.ascontiguousarray(found.covariance[:count, :count])
    return CalibrationUncertainty(tuple(s.name for s in found.sensors), SENSOR_PARAMETERS, covariance)


def quality_of(
    plan: SessionPlan,
    start: Start,
    calibration: Calibration,
    found: Adjustment,
    held_out: CrossValidation,
    problem: BundleProblem,
    boards: Boards,
    bars: Bars,
    doubts: tuple[str, ...],
) -> CalibrationQuality:
    """Return what an adjustment says of itself, and what there is to doubt besides."""
    place = box_grid(*_corners(calibration.volume), _GRID)
    pairs = plan.measuring_pairs()
    sigma = [expected_sigma(calibration.rig, found, pair, place) for pair in pairs]
    refused = {**found.refused, **start.refused}
    every: list[BoardObservation | BarObservation] = [o for seen in boards.values() for o in seen]
    every += [o for seen in bars.values() for o in seen]
    for one in every:
        for why, count in one.refused.items():
            refused[why] = refused.get(why, 0) + count
    for pose, seen in boards.items():
        for view in seen:
            if view.reason:
                refused[f"{view.camera} in pose {pose}: {view.reason}"] = 1
    used = [np.isfinite(r).all(axis=1) for r in found.residual_board]
    points = [*zip(problem.board_points, found.residual_board, used, strict=True)]
    none = np.empty((0, 2))
    return CalibrationQuality(
        gauge=found.gauge,
        started_from=start.origin,
        iterations=found.iterations,
        residuals=round(found.redundancy) + int(found.free.sum()),
        parameters=int(found.free.sum()),
        rms_by_type={f"{r.type} [{r.unit}]": r.rms for r in found.rms if r.of == "all"},
        rms_by_sensor={f"{r.name}, {r.type}": r.whitened for r in found.rms if r.of in ("sensor", "pair")},
        rms_by_pose={f"{r.name}, {r.type}": r.whitened for r in found.rms if r.of == "pose"},
        refused=refused,
        warnings=(*found.warnings, *held_out.failed, *doubts),
        bar_length_error_mm={b.pose: b.error_mm for b in held_out.bars},
        board_rms_px={b.pose: _both(b.camera_rms_px, b.projector_rms_px) for b in held_out.boards},
        estimates=(*map(_estimate, found.nuisance), *_blurs(plan, boards)),
        held={},
        views=tuple("".join(pair) for pair in pairs),
        place=place,
        expected_sigma=np.stack(sigma) if sigma else np.empty((0, len(place))),
        residual_sensor=np.repeat([p.sensor for p, _, _ in points], [k.sum() for k in used]).astype(np.int32),
        residual_px=np.concatenate([none, *(p.pixel[k] for p, _, k in points)]),
        residual=np.concatenate([none, *(r[k] for _, r, k in points)]),
        scale=_scale(plan, start, found, problem),
        shape_sigma_mm=found.shape_sigma_mm,
    )


def _scale(plan: SessionPlan, start: Start, found: Adjustment, problem: BundleProblem) -> str:
    """Say what lengths were taken from, and how well it is known."""
    # A camera alone measures no points, and has the scale of what it was told.
    sigma = found.scale_sigma or max((b.pitch_relative_sigma for b in problem.boards), default=0.0)
    part = f"known to 1/{1.0 / sigma:,.0f}" if sigma > 0.0 else "taken as exact"
    if problem.bar_points:
        return f"the length of {' and '.join(bar.name for bar in problem.bars)}, {part}"
    names = " and ".join(board.name for board in problem.boards)
    told = [plan.session.artefacts[b.name] for b in problem.boards if b.name not in start.pitch]
    if any(not isinstance(one, BallBar) and one.pitch_relative_sigma is None for one in told):
        return (
            f"the nominal pitch of {names}, of which nobody has told how well it is known: lengths are as "
            "good as the pitch is (pitch_relative_sigma)"
        )
    return f"the pitch of {names}, {part}"


def _both(camera_px: float, projector_px: float) -> float:
    finite = [x for x in (camera_px, projector_px) if np.isfinite(x)]
    return float(np.sqrt(np.mean(np.square(finite)))) if finite else float("nan")


def _estimate(one: Nuisance) -> Estimate:
    return Estimate(one.what, one.artefact, one.value, one.sigma, one.sphere)


def _blurs(plan: SessionPlan, boards: Boards) -> Iterator[Estimate]:
    """Yield the blur of each camera, as the edges of the board's dots show it."""
    for camera in dict.fromkeys(view_of(view).camera for view in plan.views):
        blurs = [o.blur_px for seen in boards.values() for o in seen if o.camera == camera]
        finite = [b for b in blurs if np.isfinite(b)]
        if finite:
            yield Estimate(Estimated.BLUR, camera, float(np.median(finite)))


def expected_sigma(rig: Rig, found: Adjustment, pair: tuple[str, str], place: Floats) -> Floats:
    """Return the deviation (n,) in mm that the calibration gives points; NaN out of their sight."""
    covariance = point_covariance(found, *pair, place)
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    for name in pair:
        sensor = rig.sensor(name)
        pixel = project(sensor.intrinsics, sensor.pose, place)
        inside = (pixel > -0.5) & (pixel < [sensor.columns - 0.5, sensor.rows - 0.5])
        sigma[~inside.all(axis=1)] = np.nan
    return np.asarray(sigma)
