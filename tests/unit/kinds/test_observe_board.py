"""Observing boards: what a view finds against the exact places of the points, on rendered measurements."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.calibration_sessions import SessionInMemory, recorded_session, simulation
from support.sessions import SMALL_BOARD
from support.true_boards import true_board

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.calibration import observe_board
from sms_jobs.kinds.calibration.sessions import OBSERVE_BOARD, board_states, every_view
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.kinds.recording.simulate import recipe
from sms_jobs.records.measurement import ArrayStack, Measurement
from sms_jobs.records.observations import BoardObservation
from sms_jobs.records.sensors import SensorFormat
from sms_jobs.records.subject import Subject

SUBJECT = Subject("session", "B02", "C1P2")


def darkened(columns: slice) -> SessionInMemory:
    """Return the session with a part of one measurement that nothing lights."""
    session = recorded_session().copy()
    held: Measurement = session.records[MEASUREMENT, str(SUBJECT)]["measurement"]
    frames = held.frames.rows(0, held.frames.shape[1]).copy()
    # Nothing but the camera's read noise.
    dark = np.random.default_rng(4).normal(20.0, held.read_noise, frames[:, :, columns].shape)
    frames[:, :, columns] = np.clip(dark.round(), 0, held.full_scale)
    session.records[MEASUREMENT, str(SUBJECT)] = {"measurement": replace(held, frames=ArrayStack(frames))}
    return session


def test_every_dot_is_found_and_named() -> None:
    session = recorded_session()
    for subject in every_view(session.campaign, board_states(session.campaign)):
        seen = session.observation(OBSERVE_BOARD, subject.state or "", subject.view or "")
        assert len(seen.point) == SMALL_BOARD.columns * SMALL_BOARD.rows
        assert (seen.camera, seen.projector, seen.artefact) == ("C1", (subject.view or "")[2:], "board")
        # Lens and pixel make a spot of sqrt(0.5^2 + 1/12) = 0.577 px; a dot's edge tells it to 2 %.
        assert seen.blur_px == pytest.approx(0.577, rel=0.02)
        truth = true_board(simulation(session.campaign, subject))
        order = np.lexsort(seen.place.T)
        np.testing.assert_array_equal(seen.place[order], truth.place[np.lexsort(truth.place.T)])
        np.testing.assert_allclose(seen.point[order], truth.point[np.lexsort(truth.place.T)], atol=1e-9)


def test_points_scatter_as_stated() -> None:
    session = recorded_session()
    cameras, projectors = [], []
    for subject in every_view(session.campaign, board_states(session.campaign)):
        seen = session.observation(OBSERVE_BOARD, subject.state or "", subject.view or "")
        truth = true_board(simulation(session.campaign, subject))
        order, own = np.lexsort(seen.place.T), np.lexsort(truth.place.T)
        off = seen.camera_px[order] - truth.camera_px[own]
        cameras.append(off / seen.camera_sigma_px[order][:, None])
        off = seen.projector_px[order] - truth.projector_px[own]
        projectors.append(off / seen.projector_sigma_px[order][:, None])
    # 588 numbers tell a standard deviation to 3 %. In the camera 1/1000 px of an ellipse's model error comes
    # on top of noise of the same size; in the projector one number stands for x and y, which differ by 4/3.
    assert 0.9 < np.sqrt(np.mean(np.square(cameras))) < 1.5
    assert 0.9 < np.sqrt(np.mean(np.square(projectors))) < 1.2
    # A single wrong point would spoil a calibration: none is beyond what noise does, times the 1.3 above.
    assert np.max(np.abs(cameras)) < 1.3 * 4.5
    assert np.max(np.abs(projectors)) < 1.3 * 4.5


def test_observations_do_not_depend_on_threads() -> None:
    session = recorded_session().copy()
    first: BoardObservation = session.observation(OBSERVE_BOARD, "B02", "C1P2")
    second: BoardObservation = session.run(observe_board, SUBJECT, threads=1)["observation"]
    np.testing.assert_array_equal(first.camera_px, second.camera_px)
    np.testing.assert_array_equal(first.projector_px, second.projector_px)


def test_a_board_that_nothing_lights_gives_no_points_and_says_why() -> None:
    session = darkened(slice(None))
    seen: BoardObservation = session.run(observe_board, SUBJECT)["observation"]
    assert len(seen.point) == 0
    assert seen.camera_px.shape == seen.projector_px.shape == (0, 2)
    assert "dark" in seen.reason
    statistics = session.statistics[OBSERVE_BOARD, str(SUBJECT)]
    assert statistics["points_count"] == 0.0
    assert all(np.isfinite(v) for v in statistics.values())


def test_a_part_in_the_dark_costs_its_points_alone() -> None:
    whole = recorded_session().observation(OBSERVE_BOARD, "B02", "C1P2")
    # From the middle between its last two columns of dots, which hold no marker.
    columns = [whole.camera_px[whole.place[:, 0] == k, 0].mean() for k in (5, 6)]
    edge = int(np.mean(columns))
    first, last = (edge, 256) if columns[1] > columns[0] else (0, edge)
    seen: BoardObservation = darkened(slice(first, last)).run(observe_board, SUBJECT)["observation"]
    assert 35 <= len(seen.point) < 49
    # What is left is where it was; dots beside the dark have a phase on one side only, or a cut edge.
    kept = {tuple(p): x for p, x in zip(whole.place, whole.camera_px, strict=True)}
    clear = np.abs(seen.camera_px[:, 0] - edge) > 15.0
    off = np.array([x - kept[tuple(p)] for p, x in zip(seen.place, seen.camera_px, strict=True)])[clear]
    assert np.abs(off).max() < 0.01
    assert sum(seen.refused.values()) > 0


def test_a_state_without_a_board_gives_no_points() -> None:
    session = recorded_session().copy()
    bar = session.records[MEASUREMENT, "session/S01/C1P2"]
    session.records[MEASUREMENT, str(SUBJECT)] = bar
    seen: BoardObservation = session.run(observe_board, SUBJECT)["observation"]
    assert len(seen.point) == 0
    assert seen.refused


def test_frames_of_another_size_than_the_session_says_are_refused() -> None:
    session = recorded_session().copy()
    described = session.campaign.session
    assert described is not None
    sensors = (SensorFormat("C1", 512, 256), *described.sensors[1:])
    session.campaign = replace(session.campaign, session=replace(described, sensors=sensors))
    with pytest.raises(InvalidInput, match=r"256 x 256 px, but the session says that C1 has 512 x 256"):
        session.run(observe_board, SUBJECT)


def test_a_sensor_that_the_session_does_not_know_is_named() -> None:
    campaign = recorded_session().campaign
    described = campaign.session
    assert described is not None
    lacking = replace(campaign, session=replace(described, sensors=described.sensors[:2]))
    with pytest.raises(InvalidInput, match=r"does not say how many pixels P2 has; it knows C1, P1"):
        observe_board.board_shown(lacking, SUBJECT)
    assert recipe(lacking, Subject("session", "B02")).scene is not None
