"""Observing a ball bar: points against the exact image of its spheres, on rendered measurements."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.calibration_sessions import SessionInMemory, observed_session, recorded_session, simulation
from support.sessions import SMALL_BAR

from sms_jobs.kinds.calibration import observe_bar
from sms_jobs.kinds.calibration.sessions import (
    CALIBRATE_BOARDS,
    OBSERVE_BAR,
    bar_states,
    every_view,
)
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, Need
from sms_jobs.metrology.calibration.estimates import Estimated
from sms_jobs.metrology.targets.sphere_blur import sphere_image_in_projector
from sms_jobs.records.calibration import CalibrationQuality
from sms_jobs.records.measurement import ArrayStack, Measurement
from sms_jobs.records.observations import BarObservation
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.artefact_truth import true_bar

Floats = NDArray[np.float64]
ORDINARY = Subject("session", "S05", "C1P2")
"""A pose that is none of the special ones."""


def off_the_spheres(session: SessionInMemory, subject: Subject, seen: BarObservation) -> Floats:
    """Return by how much points miss the exact image of their sphere, (n, 2) in projector px."""
    shown = simulation(session.campaign, subject)
    camera, projector = (shown.scene.rig.sensor(n) for n in (shown.camera, shown.projector))
    centres = true_bar(shown).centre
    exact = np.empty_like(seen.projector_px)
    for number in (1, 2):
        own = seen.sphere == number
        exact[own] = sphere_image_in_projector(
            (camera.intrinsics, camera.pose),
            (projector.intrinsics, projector.pose),
            centres[number - 1],
            SMALL_BAR.radius_mm,
            seen.camera_px[own],
        )
    return seen.projector_px - exact


def darkened(subject: Subject, hidden: NDArray[np.bool_]) -> SessionInMemory:
    """Return the session with some pixels of one measurement (rows, columns) in the dark."""
    session = observed_session().copy()
    held: Measurement = session.records[MEASUREMENT, str(subject)]["measurement"]
    frames = held.frames.rows(0, held.frames.shape[1]).copy()
    dark = np.random.default_rng(4).normal(20.0, held.read_noise, frames.shape).round()
    frames = np.where(hidden, np.clip(dark, 0, held.full_scale), frames).astype(np.uint16)
    session.records[MEASUREMENT, str(subject)] = {"measurement": replace(held, frames=ArrayStack(frames))}
    return session


def about_sphere(number: int, reach_px: float = 26.0) -> NDArray[np.bool_]:
    """Return the pixels about a sphere of `ORDINARY`."""
    x, y = true_bar(simulation(recorded_session().campaign, ORDINARY)).camera_px[number - 1]
    rows, columns = np.mgrid[:256, :256]
    return np.asarray(np.hypot(columns - x, rows - y) < reach_px)


def needs_of(session: SessionInMemory, subject: Subject) -> tuple[Need, ...]:
    return observe_bar.KIND.checked_needs(session.campaign, subject, observe_bar.ObserveBarParameters())


def test_points_scatter_about_the_exact_image_as_stated() -> None:
    session = observed_session()
    whitened = []
    for subject in every_view(session.campaign, bar_states(session.campaign)):
        seen = session.observation(OBSERVE_BAR, subject.state or "", subject.view or "")
        assert (np.bincount(seen.sphere, minlength=3)[1:] > 400).all()
        assert seen.projector_sigma_px.shape == seen.projector_px.shape
        # A projector of 512 x 384: one phase noise makes pixels of x 4/3 as uncertain as those of y, but for
        # defocus: the same number of fringes is 4/3 as fine along y, and loses a few percent more contrast.
        ratio = np.median(seen.projector_sigma_px[:, 0] / seen.projector_sigma_px[:, 1])
        assert ratio == pytest.approx(4.0 / 3.0, rel=0.1)
        whitened.append(off_the_spheres(session, subject, seen) / seen.projector_sigma_px)
    z = np.concatenate(whitened)
    # 12 000 points tell it to 1 %; what is left of blur adds a few percent. Both coordinates alike.
    rms = np.sqrt(np.mean(z**2, axis=0))
    assert (rms > 0.95).all()
    assert (rms < 1.15).all()


def test_the_pull_of_blur_is_taken_back() -> None:
    session = observed_session().copy()
    plain = session.run(observe_bar, ORDINARY, blur_px=0.0)["observation"]
    session = observed_session().copy()
    mended = session.run(observe_bar, ORDINARY)["observation"]
    before = off_the_spheres(session, ORDINARY, plain).mean(axis=0)
    after = off_the_spheres(session, ORDINARY, mended).mean(axis=0)
    # Noise of 0.016 px over the root of 1000 points makes 0.0005 px of a shift of 0.03 px.
    assert np.linalg.norm(before) > 0.02
    # The renderer has no light between its 2 x 2 sub-samples, so that its spot has 0.3125 px^2 for phases,
    # but 0.333 for edges of dots, whose blur is 1 % more than true besides: 8 % too much is taken back.
    assert np.linalg.norm(after) < 0.15 * np.linalg.norm(before)


def test_the_blur_comes_from_the_board() -> None:
    session = recorded_session()
    quality: CalibrationQuality = session.records[CALIBRATE_BOARDS, "session"]["quality"]
    blur = quality.estimate(Estimated.BLUR, "C1")
    assert blur is not None
    assert quality.labelled()["blur of C1 [px]"] == blur.value
    told = blur.value
    first = session.copy().run(observe_bar, ORDINARY_FIRST)["observation"]
    same = session.copy().run(observe_bar, ORDINARY_FIRST, blur_px=told)["observation"]
    np.testing.assert_array_equal(first.projector_px, same.projector_px)


ORDINARY_FIRST = Subject("session", "S01", "C1P2")
"""The home pose, which needs no other."""


def test_a_start_without_quality_tells_no_blur() -> None:
    session = recorded_session().copy()
    start = session.records[CALIBRATE_BOARDS, "session"]
    session.records[CALIBRATE_BOARDS, "session"] = {"calibration": start["calibration"]}
    without = session.run(observe_bar, ORDINARY_FIRST)["observation"]
    plain = recorded_session().copy().run(observe_bar, ORDINARY_FIRST, blur_px=0.0)["observation"]
    np.testing.assert_array_equal(without.projector_px, plain.projector_px)


def test_ordinary_poses_need_the_special_ones_and_search_little() -> None:
    session = observed_session()
    assert observe_bar.special_labels(session.campaign) == ("S01", "S02", "S03")
    roles = {n.role for n in needs_of(session, ORDINARY)}
    assert roles == {"measurement", "start", "home", "pan", "tilt"}
    assert {n.role for n in needs_of(session, ORDINARY_FIRST)} == {
        "measurement",
        "start",
    }
    reduced = session.observation(OBSERVE_BAR, "S05", "C1P2")
    whole = session.copy().run(observe_bar, ORDINARY, reduced_regions=False)["observation"]
    assert whole.searched_fraction == 1.0
    # Two discs of 20 px and a margin of 5 mm = 4 px, in 256 x 256 px.
    assert reduced.searched_fraction < 0.06
    # The same spheres, but for which of their points are at hand near the limb.
    for k in (0, 1):
        off = np.abs(reduced.centre[k] - whole.centre[k])
        assert (off < 3.0 * whole.centre_sigma[k]).all()


def test_a_special_pose_that_shows_one_sphere_costs_the_prediction_alone() -> None:
    session = observed_session()

    def blind(seen: BarObservation) -> BarObservation:
        return replace(seen, centre=np.stack([seen.centre[0], np.full(3, np.nan)]))

    lacking = session.changed(OBSERVE_BAR, blind, states=("S02",))
    found = lacking.run(observe_bar, ORDINARY)["observation"]
    assert found.searched_fraction == 1.0
    assert np.isfinite(found.centre).all()


@pytest.mark.parametrize("state", ["S02", "S03"])
def test_a_special_pose_whose_spheres_are_exchanged_predicts_as_well(state: str) -> None:
    session = observed_session()

    def exchanged(seen: BarObservation) -> BarObservation:
        return replace(
            seen, sphere=3 - seen.sphere, centre=seen.centre[::-1], centre_sigma=seen.centre_sigma[::-1]
        )

    found = session.changed(OBSERVE_BAR, exchanged, states=(state,)).run(observe_bar, ORDINARY)["observation"]
    plain = session.observation(OBSERVE_BAR, "S05", "C1P2")
    # Numbers and weights go together: the very same prediction.
    np.testing.assert_array_equal(found.centre, plain.centre)
    np.testing.assert_array_equal(found.camera_px, plain.camera_px)
    assert found.searched_fraction == plain.searched_fraction


def test_angles_that_are_not_recorded_are_no_obstacle() -> None:
    session = observed_session().copy()
    states = tuple(replace(s, channels={}) for s in session.campaign.states)
    session.campaign = replace(session.campaign, states=states)
    assert observe_bar.special_labels(session.campaign) == ()
    found = session.run(observe_bar, ORDINARY)["observation"]
    assert found.searched_fraction == 1.0
    assert np.isfinite(found.centre).all()


def test_a_hidden_sphere_leaves_the_other_one() -> None:
    session = darkened(ORDINARY, about_sphere(2))
    seen: BarObservation = session.run(observe_bar, ORDINARY)["observation"]
    assert set(np.unique(seen.sphere)) == {1}
    assert np.isfinite(seen.centre[0]).all()
    assert np.isnan(seen.centre[1]).all()
    assert np.isnan(seen.centre_sigma[1]).all()
    assert any("sphere" in why for why in seen.refused)
    statistics = session.statistics[OBSERVE_BAR, str(ORDINARY)]
    assert statistics["spheres_count"] == 1.0
    assert statistics["problems_count"] >= 1.0
    assert "separation_mm" not in statistics


def test_a_bar_that_nothing_lights_gives_no_points_and_says_why() -> None:
    session = darkened(ORDINARY, np.ones((256, 256), np.bool_))
    seen: BarObservation = session.run(observe_bar, ORDINARY)["observation"]
    assert len(seen.sphere) == 0
    assert seen.camera_px.shape == seen.projector_px.shape == seen.projector_sigma_px.shape == (0, 2)
    assert np.isnan(seen.centre).all()
    assert seen.refused
    assert session.statistics[OBSERVE_BAR, str(ORDINARY)]["points_count"] == 0.0


def test_points_are_as_many_as_asked_for_and_do_not_depend_on_threads() -> None:
    session = observed_session().copy()
    one = session.run(observe_bar, ORDINARY, threads=1, points_per_sphere=80)["observation"]
    two = session.run(observe_bar, ORDINARY, threads=2, points_per_sphere=80)["observation"]
    np.testing.assert_array_equal(one.projector_px, two.projector_px)
    np.testing.assert_array_equal(one.centre, two.centre)
    assert (np.bincount(one.sphere)[1:] <= 80).all()
    assert (np.bincount(one.sphere)[1:] >= 70).all()


def test_a_session_of_a_bar_alone_starts_from_the_calibration_that_is_valid() -> None:
    recorded = recorded_session()
    session = recorded.showing(lambda s: s.artefact == "bar")
    needs: dict[str, Any] = {n.role: n for n in needs_of(session, ORDINARY_FIRST)}
    assert needs["start"].source == CALIBRATION
    session.know({"calibration": recorded.records[CALIBRATE_BOARDS, "session"]["calibration"]})
    found = session.run(observe_bar, ORDINARY_FIRST, blur_px=0.577)["observation"]
    assert np.isfinite(found.centre).all()
