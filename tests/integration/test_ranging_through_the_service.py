"""Fourier domain ranging as a person uses it: from a test plan to the points of a plate beside a mirror."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command import answer, service, sms

from sms_jobs.archive import Archive, FolderStore
from sms_jobs.records.fields import PhaseMaps, ReturnMaps, Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason

pytestmark = pytest.mark.long  # a minute of rendering and ranging; each step has tests of its own in memory

PLAN = """
name = "mirror"
rig = "virtual"
specimen = { name = "plate and mirror" }
states = [{ label = "S00" }]

[sequence]
densities = "fdr-16"
orientations_deg = [45, -45]

[scene]
seed = 3
volume = { low_mm = [-330.0, -330.0, -330.0], high_mm = [330.0, 330.0, 330.0] }
surface = { shape = "plate-and-mirror", plate_width_mm = 400.0, height_mm = 300.0, opening_angle_deg = 120.0 }
camera = { exposure = 0.6, blur_px = 0.1 }

[scene.placement]
rotation_deg = [-23.513055789501532, -23.513055789501532, -87.75191884762128]
translation_mm = [0.0, -110.0, -50.0]

[[scene.sensors]]
name = "C1"
columns = 96
rows = 96
fx = 345.6
fy = 345.6
cx = 47.5
cy = 47.5
position_mm = [-600.0, 40.0, 2427.0]
target_mm = [0.0, 0.0, 0.0]

[[scene.sensors]]
name = "P1"
columns = 1024
rows = 768
fx = 2867.0
fy = 2867.0
cx = 511.5
cy = 383.5
position_mm = [600.0, -30.0, 2427.0]
target_mm = [0.0, 0.0, 0.0]
"""


MIRROR = PLAN[PLAN.index("surface = ") : PLAN.index("camera = ")]
SHINING = """surface = { shape = "cylinder", radius_mm = 300.0, width_mm = 400.0, height_mm = 300.0 }
gloss = { strength = 20.0, exponent = 300.0 }
"""
PLACEMENT = PLAN[PLAN.index("[scene.placement]") : PLAN.index("[[scene.sensors]]")]
GLOSSY = (
    PLAN.replace('"mirror"', '"glossy"')
    .replace('"fdr-16"', '"reverse-exponential-16"')
    .replace(MIRROR, SHINING)
    .replace(PLACEMENT, "")
)


def run(home: Path, *arguments: str) -> Any:
    return answer(*arguments, "--home", str(home))


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Range two campaigns, the second of which cannot be, and measure a glossy one.

    Return the home and what was said of the second.
    """
    home = tmp_path_factory.mktemp("ranging")
    assert sms("init", "--home", str(home)).returncode == 0
    exponential = PLAN.replace('"mirror"', '"other"').replace('"fdr-16"', '"reverse-exponential-16"')
    for name, plan in (("mirror", PLAN), ("other", exponential), ("glossy", GLOSSY)):
        (home / f"{name}.toml").write_text(plan)
        run(home, "campaign", "create", str(home / f"{name}.toml"))
    acquisitions = [
        run(home, "job", "submit", "simulate", "-c", name)["jobs"] for name in ("mirror", "other")
    ]
    acquisitions.append(
        run(home, "job", "submit", "simulate", "--adaptive", "exposures", "-c", "glossy")["jobs"]
    )
    ranging = ("job", "submit", "reconstruct", "--method", "fdr", "--returns", "2", "-c")
    with service(home):
        run(home, "job", "wait", *acquisitions[0], *acquisitions[1], *acquisitions[2])
        good, bad = (run(home, *ranging, name)["jobs"] for name in ("mirror", "other"))
        shiny = run(home, "job", "submit", "reconstruct", "--response", "measured", "-c", "glossy")["jobs"]
        run(home, "job", "wait", *good, *shiny)
        waited = sms("job", "wait", *bad, "--home", str(home))
    assert waited.returncode == 5
    return home, waited.stderr


def test_two_returns_are_found_paired_and_kept(done: tuple[Path, str]) -> None:
    home, _ = done
    (measurement,) = run(home, "data", "find", "-c", "mirror", "--kind", "measurement")
    shape = run(home, "data", "show", str(measurement["id"]))["records"]["measurement"]["frames"]["shape"]
    assert shape == [2 * (4 * 16 - 2), 96, 96]  # thesis section 7.2.2
    (found,) = run(home, "data", "find", "-c", "mirror", "--kind", "reconstruct")
    statistics = run(home, "data", "show", str(found["id"]))["statistics"]
    assert statistics["several_returns_fraction"] > 0.3
    with Archive(FolderStore(home / "archive")).open_unrecorded(found["path"]) as dataset:
        assert dataset.names == ("surface", "phase", "returns")
        assert dataset.provenance.parameters["method"] == "fdr"
        cloud, returns = dataset.read("surface", Surface), dataset.read("returns", ReturnMaps)
    valid = cloud.reason == Reason.VALID
    # The plate faces the scanner; where it is lit twice its points lie on the plane of the others. Within
    # 80 mm of the hinge the two returns are less than a bin apart with so few fringes.
    twice = valid & np.isfinite(returns.omega[:, 1]).all(axis=0) & (cloud.position[1] > -30.0)
    once = valid & np.isnan(returns.omega[:, 1]).all(axis=0)
    assert min(twice.sum(), once.sum()) > 300
    centre = cloud.position[:, once].mean(axis=1)
    normal = np.linalg.svd((cloud.position[:, once].T - centre), full_matrices=False)[2][2]
    off = np.abs(normal @ (cloud.position[:, twice] - centre[:, None]))
    # Noise alone gives 0.08 mm with 16 fringes. A pixel of 4 mm blurs the two returns unequally, which the
    # model lacks, and as much again comes from that; mixed returns would be off by millimetres.
    assert np.median(off) < 0.4


def test_a_sequence_that_cannot_be_ranged_fails_with_a_sentence(done: tuple[Path, str]) -> None:
    home, said = done
    assert "needs the fringe densities 0, 1, 2" in said
    refused = sms("job", "submit", "reconstruct", "--returns", "2", "-c", "other", "--home", str(home))
    assert refused.returncode == 2
    assert "set method=fdr" in refused.stderr


def test_a_bracket_that_acquire_chose_is_archived_and_merged(done: tuple[Path, str]) -> None:
    home, _ = done
    (measured,) = run(home, "data", "find", "-c", "glossy", "--kind", "measurement")
    (found,) = run(home, "data", "find", "-c", "glossy", "--kind", "reconstruct")
    archive = Archive(FolderStore(home / "archive"))
    with archive.open_unrecorded(measured["path"]) as dataset:
        measurement = dataset.read("measurement", Measurement)
        sequence = measurement.sequence
        assert len(sequence.exposures) > 1
        assert measurement.frames.shape == (len(sequence.exposures) * 2 * 5 * 4, 96, 96)
        dazzled = measurement.texture >= measurement.full_scale  # white is recorded at the exposure 1
    assert dazzled.sum() > 200
    statistics = run(home, "data", "show", str(found["id"]))["statistics"]
    # Some 700 pixels, with noise of 1e-3 where ten thousand are asked; a linear projector.
    assert statistics["gamma"] == pytest.approx(1.0, abs=0.02)
    with archive.open_unrecorded(found["path"]) as dataset:
        assert dataset.provenance.parameters["response"] == "measured"
        cloud, phase = dataset.read("surface", Surface), dataset.read("phase", PhaseMaps)
    assert phase.exposure is not None
    assert set(np.unique(phase.exposure)) == {np.float32(e) for e in sequence.exposures}
    # All of the highlight but what a shadow's edge takes: it is measured as any other part.
    assert (cloud.reason[dazzled] == Reason.VALID).mean() > 0.9
    valid = cloud.reason == Reason.VALID
    off = (
        np.hypot(cloud.position[0], cloud.position[2] + 300.0)[valid & dazzled] - 300.0
    )  # about the axis x = 0
    # Noise of 0.1 mm in a shorter exposure.
    assert np.median(np.abs(off)) < 0.2
