"""Calibration: the bundle adjustment's speed, held-out lengths, and whether it says how accurate it is."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace
from statistics import median

import numpy as np

from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.sessions.bar_session import MANY_SESSIONS, BarSession, SessionDesign, bar_session
from sms_jobs.bench.sessions.drawn_calibrations import of_a_bar_session, ratios
from sms_jobs.bench.sessions.sphere_scene import NOISE_MM, sphere_scenes
from sms_jobs.kinds.shape import reconstruct, stereo
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.bundle.adjustment import adjust
from sms_jobs.metrology.calibration.bundle.covariance import point_covariance
from sms_jobs.metrology.calibration.bundle.cross_validation import cross_validate
from sms_jobs.metrology.calibration.bundle.problem import BundleOptions
from sms_jobs.metrology.calibration.bundle.result import Adjustment
from sms_jobs.metrology.calibration.pair_points import meet_rays
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS, project
from sms_jobs.metrology.targets.sphere_layout import SphereLayout
from sms_jobs.metrology.targets.spheres import find_spheres
from sms_jobs.records.calibration import CalibrationUncertainty
from sms_jobs.records.views import Role, role_of
from sms_jobs.virtual_rig.campaigns import top_hat_bending
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign, stereo_rig

_WALL_TARGET_S = 1.5
_DETECTION_TARGET_S = 0.2
_HELD_OUT_TARGET = 1.0 / 20_000.0
_Z_LIMITS = (0.8, 1.2)
_REPEATS = 5
_SEED = 1

THESIS_SESSION = SessionDesign()
"""25 poses x 2 spheres x 4 views x 500 points, and one pose of a board, which is the world."""


def warm_up() -> None:
    """Compile what the adjustment and the search for spheres use."""
    (scene,) = sphere_scenes(1, _SEED)
    find_spheres(scene.points, NOISE_MM, scene.bar.radius_mm, scene.camera_centre)
    adjust(bar_session(MANY_SESSIONS, 0).problem)


def point_errors(made: BarSession, found: Adjustment, grid: Floats) -> tuple[Floats, Floats]:
    """Return errors (views, n, 3) of points (n, 3) due to a calibration, and what it says they are, in mm."""
    errors, sigmas = [], []
    for c, camera in enumerate(made.sensors):
        for p, projector in enumerate(made.sensors):
            if (role_of(camera.name), role_of(projector.name)) != (Role.CAMERA, Role.PROJECTOR):
                continue
            seen = [project(s.intrinsics, s.pose, grid) for s in (camera, projector)]
            own = [(found.sensors[k].intrinsics, found.sensors[k].pose) for k in (c, p)]
            errors.append(meet_rays(own[0], own[1], seen[0], seen[1])[0] - grid)
            covariance = point_covariance(found, camera.name, projector.name, grid)
            sigmas.append(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))
    return np.array(errors), np.array(sigmas)


def _bundle(run: Run) -> Iterator[Found]:
    design = replace(THESIS_SESSION, points=60) if run.quick else THESIS_SESSION
    made = bar_session(design, _SEED)
    run.say("calibration: the bundle adjustment")
    options = BundleOptions(threads=run.threads)
    found, taken, spent = adjust(made.problem, options), [], []
    for _ in range(_REPEATS):
        started, used = time.perf_counter(), time.process_time()
        found = adjust(made.problem, options)
        taken.append(time.perf_counter() - started)
        spent.append(time.process_time() - used)
    count = 2 * sum(len(p.sphere) for p in made.problem.bar_points)
    board = 2 * sum(len(p.point) for p in made.problem.board_points)
    wall = None if run.quick else median(taken)
    yield Figure("bundle_200k_residuals_wall_s", wall, "s", _WALL_TARGET_S, "at most")
    yield Figure("bundle_iterations", float(found.iterations), "1")
    run.say("calibration: held-out poses")
    held = cross_validate(made.problem, options, folds=5, start=found)
    assert made.problem.volume is not None
    diagonal = float(np.linalg.norm(made.problem.volume[1] - made.problem.volume[0]))
    part = held.bar_rms_mm / diagonal
    yield Figure("held_out_bar_over_diagonal", part, "1", _HELD_OUT_TARGET, "at most")
    shortened = "; --quick, so without the wall time, which is that of 200 000" if run.quick else ""
    yield Condition(
        "bundle",
        f"exact geometry and noise, no images: {len(made.problem.bar_poses)} poses of thesis Table 3, 2 "
        "spheres of 30 mm radius 500 mm apart, 4 views of cameras of 1024 px and projectors of 1024 x 768 px "
        f"as in the campaign top-hat-bending, {count} residuals of sphere points with "
        f"{design.phase_sigma_px} px in the projector, {board} of a board with {design.dot_sigma_px} px; "
        "start about 1e-3 rad, 2 mm, 0.3 % of the focal length and 3 px off; "
        f"{int(found.free.sum())} unknowns, Huber weights, estimated variances and covariance; median of "
        f"{_REPEATS}, {run.threads} threads, {median(spent):.2f} CPU-s{shortened}",
    )
    yield Condition(
        "held_out_bar",
        f"{len(held.bars)} bar poses, each held out once in 5 folds; rms length error "
        f"{1e3 * held.bar_rms_mm:.1f} um over the volume's diagonal of {diagonal:.0f} mm",
    )


def _z_scores(run: Run) -> Iterator[Found]:
    sessions = 8 if run.quick else 40
    run.say(f"calibration: {sessions} calibrations for z-scores")
    grid = np.stack(np.meshgrid(*[[-200.0, 0.0, 200.0]] * 3), axis=-1).reshape(-1, 3)
    z, error = [], []
    for seed in range(1, sessions + 1):
        made = bar_session(MANY_SESSIONS, seed)
        errors, sigmas = point_errors(made, adjust(made.problem), grid)
        z.append(errors / sigmas)
        error.append(errors)
    score = float(np.sqrt(np.mean(np.square(z))))
    yield Figure("z_score_rms", score, "1", _Z_LIMITS[1], "at most")
    micrometres = 1e3 * float(np.sqrt(np.mean(np.square(error))))
    yield Condition(
        "z_score",
        f"{sessions} sessions of 13 bar poses with 60 points a sphere and 2 board poses; errors due to the "
        f"calibration of 27 points within +-200 mm, 4 views, {micrometres:.1f} um rms, over their predicted "
        f"standard deviations; wanted between {_Z_LIMITS[0]} and {_Z_LIMITS[1]}",
    )


def _spheres(run: Run) -> Iterator[Found]:
    poses = 3 if run.quick else 9
    run.say(f"calibration: spheres in {poses} clouds of 1 Mpx")
    whole: list[float] = []
    reduced: list[float] = []
    off: list[float] = []
    for scene in sphere_scenes(poses, _SEED):
        for taken, region in ((whole, None), (reduced, scene.region)):
            started = time.perf_counter()
            found = find_spheres(
                scene.points,
                NOISE_MM,
                scene.bar.radius_mm,
                scene.camera_centre,
                layout=SphereLayout(
                    bar_length_mm=scene.bar.length_mm, predicted=None if region is None else scene.centres
                ),
                region=region,
                threads=run.threads,
            )
            taken.append(time.perf_counter() - started)
            off += [float(np.linalg.norm(s.centre - scene.centres[s.number - 1])) for s in found.spheres]
    yield Figure("sphere_detection_1mpx_s", median(whole), "s", _DETECTION_TARGET_S, "at most")
    yield Figure("sphere_detection_reduced_s", median(reduced), "s", _DETECTION_TARGET_S, "at most")
    yield Condition(
        "sphere_detection",
        f"C1P1 of the campaign top-hat-bending with 1024 px, {poses} poses of thesis Table 3, spheres of "
        f"{scene.bar.radius_mm:g} mm before a wall, noise of {NOISE_MM} mm along the rays; wall time, "
        f"median, {run.threads} threads; {len(off)} of {4 * poses} spheres found, centres "
        f"{1e3 * float(np.sqrt(np.mean(np.square(off)))):.1f} um rms off. The thesis took 10 s, and 5.7 s "
        "with reduced regions",
    )


def _of_what_is_measured(run: Run) -> Iterator[Found]:
    """Yield the calibration's part of sigma over what calibrations that are off make of one recording."""
    if run.quick:
        yield Condition("part", "left out with --quick: some thirty calibrations measure two states each")
        return
    calibration, campaign = top_hat_bending("hat", "small")
    hat = of_a_bar_session(calibration, bar_session(MANY_SESSIONS, _SEED))
    before = stereo_rig(320, 240, stand_off_mm=500.0)
    two_cameras = stereo_campaign("two-cameras", rig=before)
    each = np.zeros(PER_SENSOR)
    each[:3], each[3:6], each[6:10], each[10:12], each[12:14] = 5e-5, 0.03, 0.1, 2e-4, 2e-5
    both = CalibrationUncertainty(
        tuple(sensor.name for sensor in before.sensors), SENSOR_PARAMETERS, np.diag(np.tile(each, 2) ** 2)
    )
    for name, (known, tested), stated, parameters in (
        ("part_fringes", (calibration, campaign), hat, reconstruct.KIND.parameters()),
        ("part_stereo", two_cameras, both, stereo.KIND.parameters()),
    ):
        made = ratios(known, tested, stated, parameters, run.say, run.threads)
        for quantity, one in made.items():
            yield Figure(f"{name}_{quantity}_reported_over_observed", one.calibration, "1")
        points = made["points"]
        yield Figure(f"{name}_points_total_z", points.total, "1")
        yield Figure(f"{name}_points_noise_z", points.noise, "1")
        rms = ", ".join(f"{quantity} {one.observed:.2g}" for quantity, one in made.items())
        yield Condition(
            name,
            f"campaign {tested.name}, view {tested.views[0]}, cameras of {known.rig.sensors[0].columns} px, "
            "12 bit, defaults, first and last state; calibrations off by the square root of their "
            "number times each column of a root of the covariance, so that they have exactly that "
            "covariance; of means over 32 x 32 px, and of two gauges of 30 x 20 mm, observed about "
            f"what the exact calibration makes of the same frames, {rms} rms (mm, strain); z of points "
            "against the truth, with both parts of sigma and with noise alone, errors at edges included; "
            "observed of strain, and of the displacement of two cameras, is mostly noise: pixels that "
            "cross the rim of a disc or a subset",
        )


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions."""
    yield from _spheres(run)
    yield from _bundle(run)
    yield from _z_scores(run)
    yield from _of_what_is_measured(run)


GROUP = Group("calibration", "spheres found; speed and honesty of the bundle adjustment", warm_up, measure)
