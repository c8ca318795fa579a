"""What is reported of a campaign: answers from the archive, or that nothing was recorded."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from support.report_results import campaign, grid, records_for, run_on_results

from sms_jobs.archive.provenance import Provenance
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.kinds.kind import Need
from sms_jobs.kinds.reporting import conditions, report
from sms_jobs.kinds.reporting.chapter import MERGED_STATES, RECORDINGS, STRAINS
from sms_jobs.kinds.reporting.still_pairs import still_pairs
from sms_jobs.kinds.shape.stereo_parameters import StereoParameters
from sms_jobs.metrology.deformation.fields.noise_floor import noise_floor
from sms_jobs.metrology.deformation.matching.grid import Method
from sms_jobs.metrology.images.spline import Interpolant
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.scene import HalvesApart
from sms_jobs.records.subject import Subject

SIZE = (45, 60)


def still(loads: tuple[float | None, ...] = (0.0, 0.0, 1000.0)) -> Campaign:
    """Return a campaign that is not simulated, with these loads."""
    states = tuple(LoadState(f"S{k:02}", load_n=load) for k, load in enumerate(loads))
    return replace(campaign(virtual=False), states=states)


def noisy(bias: float, noise: float) -> dict[str, Any]:
    """Return displacement and strain of a known bias and noise in every component."""
    rng = np.random.default_rng(3)
    subject = Subject("plate", "S01")
    merged = records_for(Need(MERGED_STATES, subject), SIZE)["merged_C1"]
    strain = records_for(Need(STRAINS, replace(subject, view="C1P1")), SIZE)["strain"]
    hole = 0.0 * merged.displacement
    moved = hole + bias + noise * rng.normal(size=merged.displacement.shape)
    return {
        "merged_C1": replace(merged, displacement=moved),
        "strain": replace(strain, strain=moved),
    }


def rows_of(path: Path) -> dict[tuple[str, str], str]:
    with path.open(encoding="utf-8", newline="") as file:
        return {(row["what"], row["of"]): row["value"] for row in csv.DictReader(file)}


def test_the_noise_floor_is_that_of_a_still_pair(tmp_path: Path) -> None:
    made = run_on_results(tmp_path, conditions.KIND, still(), Subject("plate"), instead=noisy(5e-4, 2e-3))
    (_, table), (_, document) = made
    rows = rows_of(table)
    found = rows["displacement X", "C1, S00 to S01"].split()
    # 2151 of the 2700 pixels are valid: noise is known to 1/sqrt(2 n) = 1.5 %, bias to 2e-3 / sqrt(n).
    assert float(found[1]) == pytest.approx(2e-3, rel=0.06)
    assert float(found[4]) == pytest.approx(5e-4, abs=2e-4)
    assert found[2] == "mm,"
    assert "microstrain" in rows["strain xx", "C1P1, S00 to S01"]
    assert not [about for _, about in rows if "S02" in about and "to" in about]
    told = json.loads(document.read_text("utf-8"))
    assert {(one["name"], one["about"]): one["value"] for one in told} == rows


def test_a_square_of_pixels_is_told_as_one(tmp_path: Path) -> None:
    given = noisy(0.0, 2e-3)
    given["strain"] = replace(given["strain"], square_px=7, gauge_length=3.5)
    ((_, table), _) = run_on_results(tmp_path, conditions.KIND, still(), Subject("plate"), instead=given)
    rows = rows_of(table)
    assert rows["strain window", "C1P1"] == "square of 7 x 7 px (3.5 mm) over every pixel"
    assert rows["strain formulation", "C1P1"].startswith("small, lines fitted to displacement along rows")


def test_the_spatial_resolution_is_told_in_the_image_and_on_the_surface(tmp_path: Path) -> None:
    given = noisy(0.0, 2e-3)
    known = {"resolution_px": 50.84, "resolution": np.full(SIZE, 254.2, np.float32)}
    strained = {"resolution_px": 180.0, "resolution": np.full(SIZE, np.nan, np.float32)}
    given = {
        "merged_C1": replace(given["merged_C1"], **known),
        "strain": replace(given["strain"], **strained),
    }
    ((_, table), _) = run_on_results(tmp_path, conditions.KIND, still(), Subject("plate"), instead=given)
    rows = rows_of(table)
    assert rows["spatial resolution", "C1"].startswith("50.84 px (254.2 mm), median; the period of a wave of")
    assert rows["spatial resolution", "C1P1"] == "not recorded"  # no pixel has a strain


def test_a_pair_without_the_reference_is_subtracted(tmp_path: Path) -> None:
    loaded = still((0.0, 1000.0, 1000.0))
    # Both states have the same field: nothing is left.
    ((_, table), _) = run_on_results(
        tmp_path, conditions.KIND, loaded, Subject("plate"), instead=noisy(1.0, 2e-3)
    )
    assert rows_of(table)["displacement Z", "C1, S01 to S02"].startswith("noise 0 mm, bias 0 mm")


def test_what_nobody_recorded_is_said_to_be_missing(tmp_path: Path) -> None:
    ((_, table), _) = run_on_results(tmp_path, conditions.KIND, still((0.0, 5.0)), Subject("plate"))
    rows = rows_of(table)
    for name in ("camera", "frame rate", "patterning technique"):
        assert rows[name, "C1P1"] == "not recorded"
    assert rows["exposure", "C1P1"].startswith("not recorded as a time")
    assert rows["image size", "C1P1"] == "60 x 45 px, grey levels to 4095"
    assert rows["subset size", "plate/S01/C1P1"] == "not recorded"  # the parameters of this file are others
    assert rows["displacement and strain", ""].startswith("not recorded: no two states")
    assert "principal distance 1000 x 1000 px" in rows["lens", "C1P1"]


def test_the_parameters_of_matching_are_put_in_words() -> None:
    parameters = {
        "subset_radius_px": 10,
        "spacing_px": 4,
        "edge_spacing_px": 2,
        "shape_order": 1,
        "interpolation": "quintic",
        "smoothing_px": 0.6,
        "method": "gauss-newton",
        "regions": "none",
    }
    found = conditions._answers(parameters)
    assert found["subset size"] == "21 px square"
    assert found["step size"] == "4 px, 2 px at edges"
    assert found["shape function"] == "affine"
    assert found["image pre-filter"] == "Gaussian of 0.6 px standard deviation"
    assert conditions._answers(parameters | {"smoothing_px": 0.0})["image pre-filter"] == "none"


@pytest.mark.parametrize(
    ("view", "told"),
    [
        ("C1C2", "as recorded, without fringes"),
        ("C1", "as recorded, without fringes"),
        ("C1P1", "fringe-average"),
    ],
)
def test_where_nothing_showed_fringes_no_mean_of_them_was_matched(view: str, told: str) -> None:
    texture = CorrelateParameters().model_dump(mode="json")["texture"]
    about = Subject("plate", "S01", view)
    now, given = datetime.now(UTC), {"texture": texture}
    made = Provenance("correlate", 1, about, "f" * 32, 1, now, given, (), "0.1", "host", "operator")
    assert conditions._answers(conditions._as_matched(made))["image that is matched"] == told


def test_the_outline_before_a_dark_background_is_no_feature(rng: np.random.Generator) -> None:
    size = (160, 200)
    speckle = gaussian_filter(rng.normal(size=size), 1.5)
    row, column = np.indices(size)
    specimen = row > 20 + 0.5 * np.abs(column - 100)
    seen = np.where(specimen, 200.0 + 30.0 * speckle / speckle.std(), 6.0).astype(np.uint16)
    recorded = records_for(Need(RECORDINGS, Subject("plate", "S00", "C1P1")), SIZE)["measurement"]
    words = conditions._feature_size(replace(recorded, texture=seen, gain=0.01, read_noise=1.0), specimen)
    # The autocorrelation of what a Gaussian of 1.5 px has smoothed is one of 1.5 sqrt(2) px, 5.0 px wide,
    # which some 600 speckles tell to a twentieth. With the background in the same box it is 34 px.
    assert float(words.split()[0]) == pytest.approx(5.0, abs=0.5)


def test_no_parameter_of_matching_is_unknown() -> None:
    answers = conditions._answers(CorrelateParameters().model_dump(mode="json"))
    assert "not recorded" not in " ".join(answers.values())
    assert set(get_args(Interpolant)) == set(conditions._INTERPOLANTS)
    assert set(get_args(Method)) == set(conditions._CRITERIA)


def test_where_the_camera_stands_is_from_calibration_and_surface(tmp_path: Path) -> None:
    # C1P2 sees the surface, and the calibration of these results knows C1 alone.
    seen = replace(still(), views=("C1P2",))
    ((_, table), _) = run_on_results(tmp_path, conditions.KIND, seen, Subject("plate"), size=SIZE)
    rows = rows_of(table)
    points = np.stack(grid(SIZE))
    points[:, : SIZE[0] // 5, : SIZE[1] // 4] = np.nan  # what has no value there
    middle = np.nanmedian(points.reshape(3, -1), axis=1)
    distance = float(rows["stand-off distance", "C1P2"].split()[0])
    assert distance == pytest.approx(np.linalg.norm(middle - [0.0, 0.0, -500.0]), rel=1e-3)
    assert rows["stereo angle", "C1P2"] == "not recorded"
    # Pixels are 5 mm apart along X and Y, and a little more where the surface slopes along X.
    per_px = float(rows["image scale", "C1P2"].split("(")[1].split()[0])
    assert 5.0 <= per_px < 5.5


def test_the_report_has_the_same_by_itself(tmp_path: Path) -> None:
    ((_, page),) = run_on_results(tmp_path, report.KIND, still(), Subject("plate"), instead=noisy(0.0, 2e-3))
    text = page.read_text(encoding="utf-8")
    assert "What to report" in text
    assert "C1, S00 to S01" in text


LOADS = (0.0, 5.0, 5.0, 9.0)


@pytest.mark.parametrize(
    ("changed", "pairs"),
    [
        ({}, [("S01", "S02")]),
        ({"load_n": 5.0 + 0.9e-3 * 9.0}, [("S01", "S02")]),
        ({"load_n": 5.0 + 1.1e-3 * 9.0}, []),
        ({"load_n": None}, []),
        ({"displacement_mm": 1.0}, [("S01", "S02")]),
        ({"channels": {"cycles": 1e5}}, []),
        ({"deformation": (HalvesApart(0.1),)}, []),
    ],
)
def test_which_states_are_still(changed: dict[str, Any], pairs: list[tuple[str, str]]) -> None:
    base = still(LOADS)
    states = list(base.states)
    states[2] = replace(states[2], **changed)
    given = replace(base, states=tuple(states))
    assert [(a.label, b.label) for a, b in still_pairs(given, given)] == pairs


def test_few_points_have_no_noise_floor() -> None:
    values = np.full(200, np.nan)
    values[:99] = 1.0
    assert noise_floor(values, np.ones(200)) is None
    values[99] = 1.0
    found = noise_floor(values, np.full(200, 2.0))
    assert found is not None
    assert (found.bias, found.noise, found.stated, found.points) == (1.0, 0.0, 2.0, 100)


def test_what_two_cameras_matched_between_them_is_told() -> None:
    given = StereoParameters(subset_radius_px=14, shape_order=1).model_dump(mode="json")
    about = Subject("plate", "S01", "C1C2")
    made = Provenance(
        "stereo", 1, about, "f" * 32, 1, datetime.now(UTC), given, (), "0.1", "host", "operator"
    )
    assert conditions._between_cameras(made) == {
        "subset size between cameras": "29 px square, less what lies beside the specimen",
        "step size between cameras": "5 px",
        "shape function between cameras": "affine",
        "image pre-filter between cameras": "Gaussian of 0.6 px standard deviation",
    }
