"""The drift of a rig over several calibrations: what moves against each other is told, the world is not."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from html import unescape
from pathlib import Path

import httpx2
import numpy as np
import pytest
from support.browser import Browser, browser_or_skip
from support.homes import make_home
from support.serving import serving

from sms_jobs import bootstrap
from sms_jobs.app.calibrating import calibration_drift
from sms_jobs.app.calibrating.calibrations import list_calibrations
from sms_jobs.jobs.archiving.registration import register_calibration
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.transforms import compose, rotation_matrix
from sms_jobs.records.sensors import Calibration, Rig
from sms_jobs.virtual_rig.campaigns import small_plate

TURN_RAD = 1e-4


def turned(rig: Rig, sensor: str, angle_rad: float) -> Rig:
    """Return a rig of which one sensor has turned about its own y axis."""
    turn = Pose.from_arrays(rotation_matrix(np.array([0.0, angle_rad, 0.0])), np.zeros(3))
    return replace(
        rig,
        sensors=tuple(replace(s, pose=compose(turn, s.pose)) if s.name == sensor else s for s in rig.sensors),
    )


def in_another_world(rig: Rig) -> Rig:
    """Return the same rig, whose first board lay elsewhere: 40 mm away and turned by 0.3 rad."""
    moved = Pose.from_arrays(rotation_matrix(np.array([0.0, 0.2, -0.224])), np.array([40.0, -3.0, 10.0]))
    return replace(rig, sensors=tuple(replace(s, pose=compose(s.pose, moved)) for s in rig.sensors))


@pytest.fixture
def calibrations(home: Path) -> tuple[Calibration, ...]:
    """Four calibrations of a rig: the first, another world, a projector that turned, and twice as far."""
    make_home(home, {})
    first, _ = small_plate("plate")
    rig = first.rig
    later = (
        in_another_world(rig),
        in_another_world(turned(rig, "P1", TURN_RAD)),
        turned(rig, "P1", 2.0 * TURN_RAD),
    )
    made = [
        replace(first, rig=one, valid_from=first.valid_from + timedelta(days=10.0 * place))
        for place, one in enumerate(later, start=1)
    ]
    with bootstrap.services(home) as services:
        for one in made:
            register_calibration(services.catalogue, services.archive, one, one.valid_from)
    return (first, *made)


def test_drift_is_what_points_move_against_each_other(
    home: Path, calibrations: tuple[Calibration, ...]
) -> None:
    with bootstrap.services(home) as services:
        found = calibration_drift.drift(services, calibrations[0].rig.name)
    assert found.first == 1
    moved = {(one.calibration, one.view): one.rms_mm for one in found.moved}
    assert {number for number, _ in moved} == {2, 3, 4}
    # The world moved by 40 mm and nothing in it: rounding is left, 1e-15 of some 1000 mm, many times over.
    assert max(moved[2, view] for view in ("C1P1", "C1P2")) < 1e-7
    # A turn by 1e-4 rad at some 500 mm shifts rays by 50 um, of which a motion of the whole takes a part.
    assert moved[3, "C1P1"] > 1e-3
    # Twice the turn moves twice as far, but for its square, 1e-4 of it, and where the robust alignment lies.
    assert moved[4, "C1P1"] == pytest.approx(2.0 * moved[3, "C1P1"], rel=0.01)
    assert moved[3, "C1P2"] < moved[3, "C1P1"]
    assert all(one.expected_mm is None for one in found.moved)  # exact parameters, of no known covariance


def test_one_that_cannot_be_read_is_told_and_the_others_are_compared(
    home: Path, calibrations: tuple[Calibration, ...]
) -> None:
    with bootstrap.services(home) as services:
        (path,) = (one.path for one in list_calibrations(services) if one.id == 3)
        (home / "archive" / path).unlink()
        found = calibration_drift.drift(services, calibrations[0].rig.name)
    assert {one.calibration for one in found.moved} == {2, 4}
    (why,) = found.unread
    assert path in why
    with serving(home) as site:
        page = httpx2.get(f"{site}/calibrations", timeout=60.0)
    assert page.status_code == 200
    assert f"Not compared: {why}" in unescape(page.text)


def test_it_is_drawn_over_time(home: Path, calibrations: tuple[Calibration, ...], tmp_path: Path) -> None:
    with Browser(browser_or_skip(), tmp_path / "profile") as page, serving(home) as site:
        for path in ("/calibrations", "/calibrations/3"):
            for width in (1280, 390):
                page.screen(width, 900)
                page.visit(site + path)
                assert page.run("document.documentElement.scrollWidth") <= width
            marks = page.run("[...document.querySelectorAll('.chart title')].map(e => e.textContent)")
            # Two views, each from the first calibration on.
            assert [title.partition(":")[0] for title in marks] == [
                f"{view}, {number}" for view in ("C1P1", "C1P2") for number in (1, 2, 3, 4)
            ]
            across = page.run(
                "[...document.querySelectorAll('.chart g')].slice(0, 4).map(e => e.getBoundingClientRect().x)"
            )
            steps = np.diff(across)
            assert steps.min() > 0.0
            # Ten days apart each; a place is written with a tenth of a unit, and the picture drawn smaller.
            assert np.ptp(steps) < 0.5
            assert page.run("document.querySelector('caption').textContent").startswith(
                "Points of the volume"
            )
        assert page.complaints == []
