"""Recordings to which something happened are refused by name, and those to which nothing did are not."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from sms_jobs.bench.fringes.fringe_mishaps import (
    SUBJECT,
    Session,
    is_named,
    mishaps,
    perfect_session,
    reconstructed,
    silent_points,
)
from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.kinds.shape.frame_watch import FramePatches
from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.records.measurement import ArrayStack, FringeSequence
from sms_jobs.records.reasons import Reason
from sms_jobs.testing.in_memory import run_kind


@pytest.fixture(scope="module")
def session() -> Session:
    return perfect_session(np.random.default_rng(7))


def test_each_of_ten_mishaps_is_named(session: Session) -> None:
    each = list(mishaps(session, np.random.default_rng(7)))
    assert len(each) == 10
    for mishap in each:
        surface, said = reconstructed(session, mishap.measurement)
        assert surface is None, mishap.name
        assert is_named(mishap, said), f"{mishap.name}: {said}"


@pytest.mark.parametrize("seed", range(5))
def test_a_perfect_recording_is_not_refused(seed: int) -> None:
    # Of 30 such sessions none was; each is judged by some 60 limits of six standard deviations.
    one = perfect_session(np.random.default_rng(seed))
    surface, said = reconstructed(one, one.measurement)
    assert said == ""
    assert surface is not None
    assert (surface.reason == Reason.VALID)[one.shape.lit].mean() > 0.9
    assert silent_points(one, surface) == 0


def test_the_tolerance_that_is_told_lets_a_frame_pass(session: Session) -> None:
    frames = session.measurement.frames.rows(0, 128).copy()
    frames[3] = np.rint(0.85 * frames[3])
    records = {
        "measurement": replace(session.measurement, frames=ArrayStack(frames)),
        "calibration": session.calibration,
    }
    with pytest.raises(MeasurementFailed, match=r"frame 3 \(.* is 0.85 times as bright"):
        run_kind(KIND, SUBJECT, records, 1, ReconstructParameters())
    output = run_kind(KIND, SUBJECT, records, 1, ReconstructParameters(maximum_phase_error_rad=0.2))
    assert output.statistics["valid_fraction"] > 0.8


def test_a_scene_that_drifts_is_refused_without_texture(session: Session) -> None:
    frames = session.measurement.frames.rows(0, 128)
    sequence = session.measurement.sequence
    plain = np.broadcast_to(np.linspace(0.4, 0.9, 128), (128, 128)) * 2.0 * pi
    n, q = len(sequence.densities), sequence.steps
    drifting = np.empty_like(frames)
    for number, (_, density, step) in enumerate(sequence.patterns()):
        # By 0.3 rad of the largest density over each orientation: a plane that moves along its normal.
        moved = plain + 0.3 / max(sequence.densities) * (number % (n * q)) / (n * q)
        drifting[number] = 1000.0 + 700.0 * np.cos(density * moved + 2.0 * pi * step / q)
    told = replace(session.measurement, frames=ArrayStack(drifting))
    _, said = reconstructed(session, told)
    assert "keep camera and specimen still" in said


def test_phases_that_agree_by_chance_are_refused(session: Session) -> None:
    random = np.random.default_rng(3)
    frames = session.measurement.frames.rows(0, 128)
    noise = random.integers(200, 3000, frames.shape).astype(np.uint16)
    _, said = reconstructed(session, replace(session.measurement, frames=ArrayStack(noise)))
    assert "hardly more than chance" in said


def test_another_number_of_frames_than_the_sequence_has_is_refused(session: Session) -> None:
    frames = session.measurement.frames.rows(0, 128)
    more = np.concatenate([frames, frames[-1:]])
    told = replace(session.measurement, frames=ArrayStack(more))
    with pytest.raises(InvalidInput, match=f"has {len(more)} frames and its fringe sequence {len(frames)}"):
        reconstructed(session, told)


def test_a_single_direction_told_across_is_named(session: Session) -> None:
    frames = session.measurement.frames.rows(0, 128)
    sequence = session.measurement.sequence
    vertical = frames[: len(frames) // 2]
    right = FringeSequence(sequence.densities, sequence.steps, (0.0,))
    told = replace(session.measurement, frames=ArrayStack(vertical))
    _, said = reconstructed(session, replace(told, sequence=right))
    assert said == ""
    turned = FringeSequence(sequence.densities, sequence.steps, (pi,))
    _, said = reconstructed(session, replace(told, sequence=turned))
    assert "seem to run along 0 deg, not along 180 deg" in said


def test_patches_are_the_same_whatever_slabs_they_come_from(rng: np.random.Generator) -> None:
    frames = rng.integers(0, 4000, (6, 100, 150)).astype(np.uint16)
    taken = []
    for height in (100, 64, 16):
        patches = FramePatches(100, 150)
        for start in range(0, 100, height):
            rows = slice(start, min(start + height, 100))
            patches.take(rows, frames[:, rows])
        taken.append(patches.stacked())
    assert taken[0].shape == (6, 4 * 8, 2, 16)
    for other in taken[1:]:
        np.testing.assert_array_equal(taken[0], other)


def test_uniform_fields_are_checked_too() -> None:
    sequence = FringeSequence(tuple(range(6)))
    one = perfect_session(np.random.default_rng(1), sequence)
    frames = one.measurement.frames.rows(0, 128)
    records = {"measurement": one.measurement, "calibration": one.calibration}
    ranged = ReconstructParameters(method="fdr")
    assert run_kind(KIND, SUBJECT, records, 1, ranged).statistics["valid_fraction"] > 0.8
    for mended, said in (([1, 0], "frames 0 and 1, bright and dark"), ([1, 1], "frame 0 does not show")):
        changed = frames.copy()
        changed[:2] = frames[mended]
        told = replace(one.measurement, frames=ArrayStack(changed))
        with pytest.raises(MeasurementFailed, match=said):
            run_kind(KIND, SUBJECT, records | {"measurement": told}, 1, ranged)
