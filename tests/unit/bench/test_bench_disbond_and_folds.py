"""What the studies of the disbond and of folds compute from fields is right on exact ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sms_jobs.bench.studies.disbond_buckling import lift_of, out_of_plane, part_errors
from sms_jobs.bench.studies.fold_angle import distance_from_edges
from sms_jobs.records.fields import DisplacementField
from sms_jobs.records.scene import Simulation, StiffenedPanel
from sms_jobs.virtual_rig.truth import Truth, exact_truth
from sms_jobs.virtual_rig.wing_campaigns import disbond_buckling

CAMPAIGN = disbond_buckling("stringer", "small")[1]


@pytest.fixture(scope="module")
def truth() -> Truth:
    assert CAMPAIGN.scene is not None
    rest, end = (Simulation(CAMPAIGN.scene, "C1", "P1", s.deformation, s.label) for s in CAMPAIGN.states[::4])
    return exact_truth(rest, end, threads=2)


def test_the_exact_field_lifts_as_the_bond_opens_and_has_no_error(truth: Truth) -> None:
    scene = CAMPAIGN.scene
    assert scene is not None
    assert isinstance(scene.surface, StiffenedPanel)
    out = out_of_plane(truth.displacement, scene.placement.matrix()[:, 2])
    lift = lift_of(out, truth.shape.lit, truth, scene.surface)
    # 3 mm x (1 +- 0.008 x 37) in the middle of the strip; f falls to 1 - 12 x 0.1^2 + 16 x 0.1^3 = 0.9 at
    # 20 mm of 200 and to 0.963 on average; the skin bends by 24 x 240 / 600^2 = 0.02 mm less.
    for found, sign in ((lift.positive, 1.0), (lift.negative, -1.0)):
        assert found == pytest.approx(3.0 * 0.963 * (1.0 + sign * 0.008 * 37.0), abs=0.04)
    reason = np.where(truth.shape.lit & truth.lit_and_seen_at_end, 0, 1).astype(np.uint32)
    rows, columns = reason.shape
    exact = DisplacementField(
        "C1P1", "S00", "mm", truth.displacement, np.zeros((6, rows, columns), np.float32),
        np.zeros((2, rows, columns)), reason,
    )  # fmt: skip
    assert part_errors(exact, truth) == dict.fromkeys(("skin", "foot", "web"), (0.0, 1.0))
    off = replace(exact, displacement=np.where(truth.shape.region == 4, 0.01, 0.0) + truth.displacement)
    errors = part_errors(off, truth)
    assert errors["web"][0] == pytest.approx(0.01 * np.sqrt(3.0))
    assert errors["skin"][0] == errors["foot"][0] == 0.0


def test_nothing_measured_has_no_lift(truth: Truth) -> None:
    scene = CAMPAIGN.scene
    assert scene is not None
    assert isinstance(scene.surface, StiffenedPanel)
    lift = lift_of(truth.displacement[2], np.zeros_like(truth.shape.lit), truth, scene.surface)
    assert np.isnan([lift.positive, lift.negative]).all()


def test_the_distance_from_edges_is_in_mm(truth: Truth) -> None:
    distance = distance_from_edges(truth)
    _, y, _ = truth.shape.material
    assert (distance[truth.shape.region == 0] == 0.0).all()
    # On the foot's half between its edge and the web the nearer of both, to two pixels of 0.65 mm, along y;
    # the direction of sight is 16 degrees off the normal and makes up to 4 % of the way.
    own = (truth.shape.region == 2) & (np.abs(truth.shape.material[0]) < 100.0)
    expected = np.minimum(40.0 - y[own], y[own] - 4.0)
    np.testing.assert_allclose(distance[own], expected, atol=1.3, rtol=0.06)
