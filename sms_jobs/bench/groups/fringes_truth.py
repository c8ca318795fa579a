"""Where what was told is not so: boards, frames, codes, and what a projector and a pixel do to light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import sqrt

import numpy as np

from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.fringes.accepted_cases import ACCEPTED, AcceptedCase
from sms_jobs.bench.fringes.broken_models import CASES, Case, rms
from sms_jobs.bench.fringes.code_mishaps import CODED, code_mishaps, coded_session
from sms_jobs.bench.fringes.fringe_mishaps import (
    SILENT_MM,
    SILENT_SIGMA,
    Mishap,
    Session,
    is_named,
    mishaps,
    perfect_session,
    reconstructed,
    silent_points,
)
from sms_jobs.bench.fringes.moved_sensors import panel_seen
from sms_jobs.bench.fringes.plate_before_wall import random_scene, record
from sms_jobs.bench.fringes.plate_before_wall import reconstructed as reconstructed_scene
from sms_jobs.bench.sessions.bar_session import MANY_SESSIONS
from sms_jobs.bench.sessions.board_sessions import (
    BOARD,
    BoardDesign,
    board_session,
    bow,
    calibrated,
    parameter_z,
)
from sms_jobs.errors import CalibrationFailed
from sms_jobs.kinds.shape.reconstruct import ReconstructParameters
from sms_jobs.metrology.geometry.planes import trace
from sms_jobs.metrology.phase.frame_noise import noise_of_steps
from sms_jobs.records.gray_code import GrayCode
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.reasons import Reason
from sms_jobs.records.views import view_of

_BOWS_MM = (0.1, 0.3, 0.5)
_MOST_Z = 1.5
_KNOCKS_PX = (0.03, 0.1)
_PERFECT = 20
_SILENT_MM, _SILENT_Z = 1.0, 10.0
_METHODS = (
    (FringeSequence((16, 15, 14, 12, 8)), ReconstructParameters()),
    (FringeSequence(tuple(range(12))), ReconstructParameters(method="fdr", returns=2)),
    (FringeSequence((16,), 4, (0.0,), gray=GrayCode(5, (32.0,))), ReconstructParameters()),
)
_NOISES = (0.3, 0.5, 0.8, 1.3, 2.0, 3.0)  # grey levels of 255
_TWO_WAYS, _ONE_WAY, _PATTERNS_ALONE = (0, 1, 3, 5), (7, 8), 2  # among the sequences with a code
_FULL_SCALES = (255, 4095)
_STEPS = (3, 4, 5)


def warm_up() -> None:
    """Compile what a calibration from boards and a reconstruction use."""
    calibrated(board_session(BoardDesign(poses=6), 1))
    for sequence, parameters in _METHODS:
        reconstructed_scene(record(random_scene(np.random.default_rng(1)), sequence), parameters)


def _bent(run: Run, seed: int) -> Iterator[Found]:
    """Yield the worst rms z of a parameter over sessions of bent boards, each with a rig of its own."""
    each = 2 if run.quick else 8
    squares: dict[str, list[float]] = {}
    for number, height in enumerate(np.repeat(_BOWS_MM, each)):
        run.say(f"fringes_truth: a board bowed by {height} mm, {number + 1} of {each * len(_BOWS_MM)}")
        made = board_session(BoardDesign(bend=bow(float(height))), seed + number)
        try:
            found = parameter_z(made, calibrated(made))
        except CalibrationFailed:
            continue
        for name, z in found.items():
            squares.setdefault(name, []).append(z * z)
    rms = {name: sqrt(np.mean(own)) for name, own in squares.items()}
    worst = max(rms, key=lambda name: rms[name])
    count = len(squares[worst])
    random = np.random.default_rng(seed)
    draws = np.sqrt(np.mean(random.standard_normal((4000, len(rms), count)) ** 2, axis=2)).max(axis=1)
    low, high = np.percentile(draws, (5.0, 95.0))
    yield Figure("bent_board_worst_parameter_z", rms[worst], "1", _MOST_Z, "at most")
    yield Condition(
        "bent_board",
        f"{count} sessions of two cameras and 20 poses of a chessboard of 144 by 96 mm, bowed by "
        f"{', '.join(map(str, _BOWS_MM))} mm, points printed off by 2 um, noise of 0.03 px, nothing told of "
        f"its flatness; seeds from {seed}; rms over the sessions of error over stated deviation of each of "
        f"{len(rms)} parameters: inner ones of both cameras, and their motion. The worst is {worst}; "
        f"of independent normal numbers the worst of as many would be {np.mean(draws):.2f}, between "
        f"{low:.2f} and {high:.2f} in nine of ten benchmarks",
    )


def _perfect(run: Run, seed: int) -> Iterator[Found]:
    """Yield how many sessions in which all is as told have no warning."""
    count = 4 if run.quick else _PERFECT
    random = np.random.default_rng(seed)
    certified, refused = 0, ""
    for number in range(count):
        run.say(f"fringes_truth: a perfect session, {number + 1} of {count}")
        board = replace(
            BOARD,
            pitch_relative_sigma=None if number % 2 else 1e-3,
            flatness_mm=None if number % 3 else 0.05,
        )
        design = BoardDesign(
            cameras=int(random.integers(1, 4)),
            poses=int(random.integers(15, 31)),
            sigma_px=float(random.uniform(0.01, 0.05)),
            board=board,
        )
        try:
            warnings = calibrated(board_session(design, seed + 100 + number)).quality.warnings
        except CalibrationFailed as error:
            warnings = (str(error),)
        certified += not warnings
        refused = refused or "".join(warnings[:1])
    yield Figure("perfect_sessions_certified", float(certified), "1", float(count), "at least")
    first = f"; the first warning: {refused}" if refused else ""
    yield Condition(
        "perfect_sessions",
        f"{count} sessions of one to three cameras, 15 to 30 poses and noise of 0.01 to 0.05 px, every other "
        "one with a pitch of which nobody has told how well it is known, the others with 1/1000; certified "
        f"are those without a warning; seeds from {seed + 100}{first}",
    )


def _mishaps(run: Run, seed: int) -> Iterator[Found]:
    """Yield how many mishaps are named in all sessions, and the points that are silently wrong."""
    sessions = 1 if run.quick else 4
    missed: set[str] = set()
    silent = lit = 0
    names: set[str] = set()
    for number in range(sessions):
        for session, mishap in _each_mishap(seed + number):
            run.say(f"fringes_truth: {mishap.name}, session {number + 1} of {sessions}")
            surface, said = reconstructed(session, mishap.measurement)
            names.add(mishap.name)
            if not is_named(mishap, said):
                missed.add(mishap.name)
            silent += silent_points(session, surface)
            lit += int(session.shape.lit.sum())
    yield Figure("mishaps_named", float(len(names - missed)), "1", float(len(names)), "at least")
    yield Figure("mishaps_silent_per_million", 1e6 * silent / lit, "1", 0.0, "at most")
    not_named = f"; not always named: {', '.join(sorted(missed))}" if missed else ""
    yield Condition(
        "mishaps",
        f"{sessions} recordings of a plate by a camera of 128 px, and three times as many of fringes beside "
        f"a Gray code ('code'), each with one of {', '.join(sorted(names))}; named are those of which the "
        "refusal names the frame, the word or the motion in every recording; the gain of 0.7 to 1.3 is of a "
        "frame not darker than the median, and patterns are those that change where the specimen is; silent "
        f"are valid points, of all lit pixels, off by more than {SILENT_SIGMA:g} stated deviations and "
        f"{SILENT_MM:g} mm; default parameters, noise, speckle, exposure 0.3 to 1.1, gamma 1 to 1.2, defocus "
        "0 to 1 px and three sequences, with a code exposure 0.7 to 1, gamma 1 to 1.3, defocus 0 to 1.5 px, "
        f"four surfaces and seven sequences, drawn from seeds from {seed}{not_named}",
    )


def _each_mishap(seed: int) -> Iterator[tuple[Session, Mishap]]:
    """Yield each mishap of fringes, and of fringes beside three codes, one of one direction."""
    random = np.random.default_rng(seed)
    session = perfect_session(random)
    yield from ((session, mishap) for mishap in mishaps(session, random))
    for shown in (CODED[random.choice(_TWO_WAYS)], CODED[_PATTERNS_ALONE], CODED[random.choice(_ONE_WAY)]):
        session = coded_session(random, shown)
        yield from ((session, mishap) for mishap in code_mishaps(session, random))


def _accepted(run: Run, seed: int) -> Iterator[Found]:
    """Yield how many recordings to which nothing happened are reconstructed."""
    count = 4 if run.quick else _PERFECT
    accepted, refused = 0, ""
    for number in range(2 * count):
        run.say(f"fringes_truth: a recording to which nothing happened, {number + 1} of {2 * count}")
        random = np.random.default_rng(seed + 1000 + number)
        session = coded_session(random, hard=True) if number % 2 else perfect_session(random)
        _, said = reconstructed(session, session.measurement)
        accepted += not said
        refused = refused or said
    yield Figure("perfect_recordings_accepted", float(accepted), "1", 2.0 * count, "at least")
    first = f"; the first refusal: {refused}" if refused else ""
    yield Condition(
        "perfect_recordings",
        f"{count} of those recordings, and {count} of fringes beside a Gray code with noise of 8 to 100 "
        f"levels of 4095, exponents up to 2.2 and half the depth of the fringes, "
        f"seeds from {seed + 1000}{first}",
    )


def _mixed(run: Run, seed: int) -> Iterator[Found]:
    """Yield how many mixed pixels are far off and valid all the same, and what telling them costs."""
    count = 2 if run.quick else 10
    valid, silent, told, good, lost = 0, 0, 0, 0, 0
    for number in range(count * len(_METHODS)):
        run.say(f"fringes_truth: a plate before a wall, {number + 1} of {count * len(_METHODS)}")
        sequence, parameters = _METHODS[number % len(_METHODS)]
        seen = record(random_scene(np.random.default_rng(seed + number)), sequence)
        cloud = reconstructed_scene(seen, parameters)
        assert cloud.covariance is not None
        sigma = np.sqrt(trace(cloud.covariance))
        error, measured = seen.error(cloud.position), cloud.reason == Reason.VALID
        valid += int((measured & seen.mixed).sum())
        silent += int((measured & seen.mixed & (error > _SILENT_MM) & (error > _SILENT_Z * sigma)).sum())
        between = cloud.reason == Reason.BETWEEN_SURFACES
        told += int((between & seen.mixed).sum())
        lost += int((between & ~seen.mixed).sum())
        good += int(((between | measured) & ~seen.mixed).sum())
    yield Figure("mixed_pixels_silent", float(silent), "1", 0.0, "at most")
    yield Figure("mixed_pixels_good_lost", lost / good, "1", 0.01, "at most")
    yield Condition(
        "mixed_pixels",
        f"{count} scenes each by unwrapping of 16, 15, 14, 12, 8 fringes, by ranging of two returns over 0 "
        "to 11, and by 16 fringes in one direction beside a Gray code: a square plate 3 to 150 mm before a "
        "wall at 1 m, edges at any angle, lit and in shadow, "
        "plain or textured, a camera of 0.67 mm a pixel with 8 or 12 bits, rendered with 8 x 8 rays a pixel; "
        f"silent are valid pixels with light of both surfaces or a part in the dark, {valid} in all, that "
        f"are off either surface by over {_SILENT_MM:g} mm and {_SILENT_Z:g} stated deviations; {told} mixed "
        f"pixels were told by lying between surfaces, and {lost} of {good} others; seeds from {seed}",
    )


def _noise(run: Run, seed: int) -> Iterator[Found]:
    """Yield the worst ratio of the noise that frames are found to have and of what they have."""
    random = np.random.default_rng(seed)
    rows, columns = (32, 400) if run.quick else (64, 1000)
    worst, at = 1.0, "none"
    for full_scale in _FULL_SCALES:
        for steps in _STEPS:
            run.say(f"fringes_truth: noise of {steps} steps up to level {full_scale}")
            level = full_scale * random.uniform(0.1, 0.6, (rows, columns))
            phases = random.uniform(0.0, 2.0 * np.pi, (5, 1, rows, columns))
            angles = 2.0 * np.pi * np.arange(steps)[:, None, None] / steps
            clean = level * (1.0 + 0.5 * np.cos(phases + angles))
            for sigma in _NOISES:
                shown = np.rint(clean + random.normal(0.0, sigma * full_scale / 255.0, clean.shape))
                found = noise_of_steps(shown.astype(np.uint16), full_scale)
                assert found is not None
                ratio = found.read_noise / float((shown - clean).std())
                if max(ratio, 1.0 / ratio) > max(worst, 1.0 / worst):
                    worst, at = ratio, f"{sigma} levels of 255, {steps} steps, full scale {full_scale}"
    yield Figure("noise_8bit_stated_over_true", max(worst, 1.0 / worst), "1", 1.1, "at most")
    yield Condition(
        "noise_8bit",
        f"read noise that is found in phase-stepped frames of five densities, {rows * columns} pixels, over "
        "that of the recorded frames, the rounding to whole levels included; full scales of "
        f"{', '.join(map(str, _FULL_SCALES))}, {', '.join(map(str, _STEPS))} steps, normal noise of "
        f"{', '.join(map(str, _NOISES))} levels of 255 before rounding, the same at every level; the ratio "
        f"farthest from 1, or its inverse: {worst:.3f} for {at}; seed {seed}",
    )


def judged_cases(
    run: Run, seed: int, cases: tuple[Case | AcceptedCase, ...] = (*CASES, *ACCEPTED)
) -> Iterator[Found]:
    """Yield how far off points are in all cases that are accepted though something is not as it is told."""
    each = 2 if run.quick else 6
    far, count, worst, told = 0, 0, ("", 0.0), []
    for index, case in enumerate(cases):
        found, valid = [], []
        for number in range(each):
            run.say(f"fringes_truth: {case.name}, {number + 1} of {each}")
            z, part = case.judged(np.random.default_rng((seed, index, number)))
            found.append(z)
            valid.append(part)
        every = np.concatenate(found)
        far, count = far + int(np.count_nonzero(every > _SILENT_Z)), count + every.size
        worst = max(worst, (case.name, rms(every)), key=lambda one: one[1])
        told.append(f"{case.name} {rms(every):.2f}, {np.mean(valid):.0%} valid")
    yield Figure("beyond_10_sigma_per_million", 1e6 * far / count, "1", 100.0, "at most")
    yield Figure("worst_z", worst[1], "1", 1.3, "at most")
    yield Condition(
        "broken_models",
        f"{each} recordings of each of {len(cases)} cases, {count} valid points, with exact truth: a tilted "
        "plate lit once or, on two thirds of it, twice by a projector of an exponent of 1.2 to 2.2, noise of "
        "0.1 to 0.5 % of full scale, or with a texture seen through pixels with and without a lens's spot; "
        "plates before a wall, all points and those of pixels that see both; 8 bits, the noise as their "
        "frames show it; a gain of 3 %, a shift of 0.04 px and a lamp that drifts by 2 % at most, up to 3 % "
        "of the light of the frame before or after, a lamp that flickers by up to 2 % of the light, and what "
        f"is accepted of the mishaps; seeds from {seed}; rms of error over stated deviation of all points of "
        f"a case: {'; '.join(told)}; the worst is {worst[0]}",
    )


def _moved(run: Run, seed: int) -> Iterator[Found]:
    """Yield how far displacement is off when a sensor turns between two states."""
    told, worst = [], 0.0
    seen = panel_seen(seed, run.threads)
    names = view_of(seen.last.view).sensors
    for name, stated in ((name, stated) for name in names for stated in (True, False)):
        for knock in _KNOCKS_PX[:1] if run.quick else _KNOCKS_PX:
            for turn in (0.25 * np.pi, 0.65 * np.pi):
                run.say(f"fringes_truth: {name} turns by {knock:g} px")
                by = knock * np.cos(turn), knock * np.sin(turn)
                z = seen.z(name, *by, stated=stated)
                worst = max(worst, rms(z))
                what = f"{name} {by[0]:.2f}, {by[1]:.2f} px{'' if stated else ', nothing stated'}"
                told.append(f"{what}: {rms(z):.2f}, at most {z.max():.1f}")
    yield Figure("moved_sensor_worst_z", worst, "1", _MOST_Z, "at most")
    yield Condition(
        "moved_sensor",
        "rms error of displacement over all that is stated of it, the calibration's part included, when the "
        "camera or the projector has turned about its centre between two states, by how far its image has "
        f"moved along x and y ({'; '.join(told)}): tension panel, 512 px, first and last state, the "
        f"calibration exact, and as uncertain as {len(MANY_SESSIONS.angles)} poses of a bar leave it, or "
        f"nothing stated of it; a turn along the images of the rays alone leaves no sign; seed {seed}",
    )


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions; the seeds are new in every run."""
    seed = int(np.random.SeedSequence().generate_state(1)[0] % 1_000_000)
    yield from _bent(run, seed)
    yield from _perfect(run, seed)
    yield from _mishaps(run, seed)
    yield from _accepted(run, seed)
    yield from _mixed(run, seed)
    yield from _noise(run, seed)
    yield from judged_cases(run, seed)
    yield from _moved(run, seed)


GROUP = Group("fringes_truth", "figures where boards and frames are not what was told", warm_up, measure)
