"""The share of errors within two deviations is counted where there are enough of them, and holds."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from sms_jobs.bench.correlated.truth_pairs import pairs
from sms_jobs.bench.figures import Condition, Figure, Run
from sms_jobs.bench.groups import coverage
from sms_jobs.virtual_rig.campaigns import small_plate, top_hat_bending


def test_a_share_is_that_within_two_deviations() -> None:
    assert coverage._share(np.array([0.0, 1.9, -2.1, 3.0])) == 0.5


def test_drawn_calibrations_are_off_in_what_they_do_not_know_alone(rng: np.random.Generator) -> None:
    exact, _ = top_hat_bending("top-hat", "small")
    (known,) = coverage._calibrations(exact, 1, rng)
    for before, after in zip(exact.rig.sensors, known["calibration"].rig.sensors, strict=True):
        assert after.intrinsics.fisheye == before.intrinsics.fisheye
        assert after.intrinsics.fx != before.intrinsics.fx


def test_strata_of_a_plate_and_of_a_camera_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """128 px of a plate and one clean pair: 0.9545 is what normal errors have; a few per cent are what
    errors that go together over a subset make of some hundred independent ones."""
    scene = coverage._Scene(coverage._fresh(small_plate("plate"), 3))
    monkeypatch.setattr(coverage, "_scenes", lambda quick, seed: iter([scene]))
    monkeypatch.setattr(coverage, "pairs", lambda seed, quick: islice(pairs(seed), 1))
    run = Run(quick=True, say=lambda text: None, threads=1, folder=tmp_path)
    found = list(coverage.measure(run))
    shares = {one.name: one.value for one in found if isinstance(one, Figure)}
    assert {"2sigma_shape_flat", "2sigma_displacement_flat", "2sigma_strain_flat"} <= set(shares)
    assert 0.9 < shares["2sigma_displacement_alone_flat"] < 1.0
    assert all(0.85 < share <= 1.0 for share in shares.values())
    worst = shares.pop("2sigma_worst_stratum")
    assert abs(worst - 0.9545) == max(abs(share - 0.9545) for share in shares.values())
    (condition,) = (one.text for one in found if isinstance(one, Condition))
    assert "displacement alone_crack" not in condition
