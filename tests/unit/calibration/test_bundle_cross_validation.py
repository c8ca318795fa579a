"""Held-out poses of the bundle adjustment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.bench.sessions.bar_session import TABLE_3, SessionDesign, bar_session
from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.calibration.bundle.adjustment import adjust
from sms_jobs.metrology.calibration.bundle.cross_validation import cross_validate, restarted

TILTS = ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, -0.3, 0.2), (-0.2, 0.2, 0.0))
SMALL = SessionDesign(points=40, camera_pixels=512, angles=TABLE_3[::2], board_tilts=TILTS)
DIAGONAL_MM = 913.0


def test_every_pose_is_held_out_once_and_measured_well() -> None:
    made = bar_session(SMALL, 1)
    found = cross_validate(made.problem, folds=4, start=adjust(made.problem))
    assert [b.pose for b in found.bars] == [p.name for p in made.problem.bar_poses]
    # The pose that is the world takes part always.
    assert [b.pose for b in found.boards] == ["B02", "B03", "B04"]
    assert found.failed == ()
    # The target of the project; noise of 0.05 px on 160 points a sphere makes about a fifth of it.
    assert found.bar_rms_mm < DIAGONAL_MM / 20_000
    true = np.linalg.norm(made.centres[:, 1] - made.centres[:, 0], axis=1)
    for bar, length in zip(found.bars, true, strict=True):
        assert bar.error_mm == pytest.approx(bar.length_mm - 500.0)
        assert abs(bar.length_mm - length) < 0.1
    # Dots have 0.02 px, with what 0.002 mm of print adds; 990 and more coordinates tell it to 2 %.
    assert found.camera_rms_px == pytest.approx(0.02, rel=0.15)
    assert found.projector_rms_px == pytest.approx(0.02, rel=0.15)


def test_a_pose_that_is_held_out_does_not_help_itself() -> None:
    # A bar that was bent in one pose spoils its own length there, however much the rest is trusted.
    made = bar_session(SMALL, 2)
    poses = list(made.problem.bar_poses)
    clean = cross_validate(made.problem, folds=4)
    shifted = tuple(
        replace(p, projector_px=p.projector_px + np.where(p.sphere == 2, 0.1, 0.0)[:, None])
        if p.pose == 3
        else p
        for p in made.problem.bar_points
    )
    spoiled = cross_validate(replace(made.problem, bar_points=shifted), folds=4)
    assert poses[3].name == spoiled.bars[3].pose
    # 0.1 px is twice the noise of a point, and both projectors' shifts cancel in part: a tenth is left.
    assert abs(spoiled.bars[3].error_mm - clean.bars[3].error_mm) > 5e-3
    # Others of its fold are measured by a calibration that never saw it.
    assert spoiled.bars[7].error_mm == pytest.approx(clean.bars[7].error_mm, abs=1e-3)


def test_one_fold_holds_nothing_out() -> None:
    with pytest.raises(InvalidInput, match="ask for at least 2"):
        cross_validate(bar_session(SMALL, 1).problem, folds=1)


def test_a_restart_is_at_the_optimum() -> None:
    problem = bar_session(SMALL, 1).problem
    first = adjust(problem)
    again = adjust(restarted(problem, first))
    assert again.cost == pytest.approx(first.cost, rel=1e-6)
    assert again.iterations <= 3
