"""Merging the pairs of a camera is better than each, and the mesh carries everything."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sms_jobs.kinds import merge
from sms_jobs.records.reasons import Reason


def test_the_merged_field_is_nearer_to_the_truth_than_its_pairs(plate: Any) -> None:
    merged = plate.results["merge", plate.subject("S01")]["C1"]
    truth = plate.truth("C1P1").displacement
    pairs = [plate.results["correlate", plate.subject("S01", p)]["displacement"] for p in merged.pairs]
    both = (merged.contributors == 2) & np.isfinite(truth[0])
    assert both.sum() > 1000
    rms = [np.sqrt(np.mean((d[:, both] - truth[:, both]) ** 2)) for d in (p.displacement for p in pairs)]
    assert np.sqrt(np.mean((merged.displacement[:, both] - truth[:, both]) ** 2)) < max(rms)
    trace = [p.covariance[[0, 3, 5]].sum(axis=0)[both] for p in pairs]
    # Inverse variance: 1 / (1 / a + 1 / b), in single precision.
    np.testing.assert_allclose(
        merged.covariance[[0, 3, 5]].sum(axis=0)[both], 1.0 / (1.0 / trace[0] + 1.0 / trace[1]), rtol=1e-4
    )
    difference = np.linalg.norm(pairs[0].displacement - pairs[1].displacement, axis=0)
    assert merged.discrepancy_rms_mm == pytest.approx(np.sqrt(np.nanmean(difference**2)))
    assert merged.pairs == ("C1P1", "C1P2")


def test_every_value_is_known_or_has_a_reason(plate: Any) -> None:
    merged = plate.results["merge", plate.subject("S01")]["C1"]
    valid = merged.reason == Reason.VALID
    np.testing.assert_array_equal(valid, merged.contributors > 0)
    for values in (merged.displacement, merged.xyz, merged.covariance):
        np.testing.assert_array_equal(np.isfinite(values).all(axis=0), valid)


def test_the_mesh_covers_the_plate_and_looks_outwards(plate: Any) -> None:
    records = plate.results["merge", plate.subject("S01")]
    assert list(records) == ["C1", "mesh"]
    mesh = records["mesh"]
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    # 150 x 150 mm, less up to two pixels of 1.4 mm at each edge.
    area = 0.5 * np.linalg.norm(cross, axis=1).sum()
    assert 142.0**2 < area < 152.0**2
    to_camera = plate.calibration.rig.sensor("C1").pose.centre() - a
    assert (np.sum(cross * to_camera, axis=1) > 0).all()
    assert len(mesh.value_names) == len(mesh.value_units) == len(mesh.values)
    assert np.isfinite(mesh.values[:5]).all()
    length = mesh.values[mesh.value_names.index("displacement")]
    np.testing.assert_allclose(length, np.linalg.norm(mesh.values[:3], axis=0))
    along = mesh.values[mesh.value_names.index("strain xx")]
    assert np.nanmedian(along) == pytest.approx(0.005, abs=5e-4)


def test_a_coarse_mesh_is_coarser(plate: Any) -> None:
    coarse = plate.run(merge.KIND, plate.subject("S01"), merge.MergeParameters(mesh_step_px=4))
    fine = plate.results["merge", plate.subject("S01")]["mesh"]
    assert len(coarse.records["mesh"].faces) == pytest.approx(len(fine.faces) / 16, rel=0.15)


def test_nothing_measured_gives_an_empty_mesh_and_no_error(plate: Any) -> None:
    results = dict(plate.results)
    for pair in plate.campaign.pairs:
        key = ("correlate", plate.subject("S01", pair))
        moved = results[key]["displacement"]
        lost = replace(
            moved,
            displacement=np.full_like(moved.displacement, np.nan),
            covariance=np.full_like(moved.covariance, np.nan),
            reason=np.full_like(moved.reason, Reason.NO_MATCH),
        )
        results[key] = {**results[key], "displacement": lost}
    output = replace(plate, results=results).run(merge.KIND, plate.subject("S01"))
    assert len(output.records["mesh"].faces) == 0
    assert (output.records["C1"].reason == Reason.NO_MATCH).all()
    assert output.statistics["valid_fraction_C1"] == 0.0
