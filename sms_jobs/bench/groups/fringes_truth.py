"""Where what was told is not so: boards that are bent, and boards that are perfect."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from math import sqrt

import numpy as np

from sms_jobs.bench.board_sessions import (
    BOARD,
    BoardDesign,
    board_session,
    bow,
    calibrated,
    parameter_z,
)
from sms_jobs.bench.figures import Condition, Figure, Found, Group, Run
from sms_jobs.bench.fringe_mishaps import (
    SILENT_MM,
    SILENT_SIGMA,
    is_named,
    mishaps,
    perfect_session,
    reconstructed,
    silent_points,
)
from sms_jobs.errors import CalibrationFailed

_BOWS_MM = (0.1, 0.3, 0.5)
_MOST_Z = 1.5
_PERFECT = 20


def warm_up() -> None:
    """Compile what a calibration from boards uses."""
    calibrated(board_session(BoardDesign(poses=6), 1))


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
    """Yield how many of ten mishaps are named in all sessions, and the points that are silently wrong."""
    sessions = 1 if run.quick else 4
    missed: set[str] = set()
    silent = lit = 0
    names: set[str] = set()
    for number in range(sessions):
        random = np.random.default_rng(seed + number)
        session = perfect_session(random)
        for mishap in mishaps(session, random):
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
        f"{sessions} recordings of a plate by a camera of 128 px, each with one of "
        f"{', '.join(sorted(names))}; named are those of which the refusal names the frame, the word or the "
        "motion in every recording; the gain of 0.7 to 1.3 is of a frame not darker than the median; silent "
        "are valid points, of all lit pixels, off by more than "
        f"{SILENT_SIGMA:g} stated deviations and {SILENT_MM:g} mm; default parameters, noise, speckle, "
        "exposure 0.3 to 1.1, gamma 1 to 1.2, defocus 0 to 1 px and three sequences drawn from seeds from "
        f"{seed}{not_named}",
    )


def _accepted(run: Run, seed: int) -> Iterator[Found]:
    """Yield how many recordings to which nothing happened are reconstructed."""
    count = 4 if run.quick else _PERFECT
    accepted, refused = 0, ""
    for number in range(count):
        run.say(f"fringes_truth: a recording to which nothing happened, {number + 1} of {count}")
        session = perfect_session(np.random.default_rng(seed + 1000 + number))
        _, said = reconstructed(session, session.measurement)
        accepted += not said
        refused = refused or said
    yield Figure("perfect_recordings_accepted", float(accepted), "1", float(count), "at least")
    first = f"; the first refusal: {refused}" if refused else ""
    yield Condition("perfect_recordings", f"{count} of those recordings, seeds from {seed + 1000}{first}")


def measure(run: Run) -> Iterator[Found]:
    """Yield the figures and their conditions; the seeds are new in every run."""
    seed = int(np.random.SeedSequence().generate_state(1)[0] % 1_000_000)
    yield from _bent(run, seed)
    yield from _perfect(run, seed)
    yield from _mishaps(run, seed)
    yield from _accepted(run, seed)


GROUP = Group("fringes_truth", "figures where boards and frames are not what was told", warm_up, measure)
