"""From points in the archive to a deviation with verdicts, a picture and a mesh; and the mesh of a state."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread
from pydantic import ValidationError
from support.bent_plate import CAMERA, PLACEMENT, PROJECTOR, measured, plate_surface, seen_plate

from sms_jobs.archive import Archive, MemoryStore, Provenance
from sms_jobs.errors import MeasurementFailed
from sms_jobs.formats.deviation_figures import band_edges, draw_deviation
from sms_jobs.formats.exporters import exporter_named
from sms_jobs.formats.exporters.sources import source_for
from sms_jobs.kinds.documents import DocumentOutput
from sms_jobs.kinds.kind import MEASUREMENT, REFERENCE_SURFACES, DatasetOutput, Inputs, Need
from sms_jobs.kinds.shape import deviate, mesh
from sms_jobs.metrology.geometry.transforms import inverse, rotation_vector
from sms_jobs.metrology.surfaces.deviation import Verdict
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.fields import Mesh, Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject
from sms_jobs.records.surfaces import (
    DeviationField,
    ReferenceSurface,
    SurfaceRegistration,
)

WHEN = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
CAMPAIGN = Campaign("plate", Specimen("plate"), "rig", (LoadState("S00"),), ("C1P1", "C1P2"))
STATE = Subject("plate", "S00")
SIGMA_MM = 0.05
DEPTH_MM, AT = 1.5, (60.0, 40.0)
TRUTH = inverse(PLACEMENT)
GIVEN = {
    "start": "given",
    "rotation_rad": tuple(rotation_vector(TRUTH.matrix())),
    "translation_mm": TRUTH.translation,
}
Run = Callable[..., list[Any]]


def cloud(seed: int) -> Surface:
    """Return what a view measures of the plate with a dent, and a hole of three pixels in it."""
    plate = seen_plate()
    dented = plate.dented(DEPTH_MM, 25.0, AT)
    points = measured(plate, dented, SIGMA_MM, np.random.default_rng(seed))
    known = np.isfinite(dented).all(axis=0)
    xyz, covariance = np.full(dented.shape, np.nan), np.full((6, *known.shape), np.nan, np.float32)
    xyz[:, known], covariance[:, known] = points.xyz.T, points.covariance
    reason = np.where(known, 0, Reason.LOW_MODULATION).astype(np.uint32)
    for field in (xyz, covariance):
        field[:, 30, 40:43] = np.nan
    reason[30, 40:43] = Reason.LOW_MODULATION
    return Surface(
        f"{CAMERA.name}{PROJECTOR.name}", "mm", xyz, reason, covariance, np.zeros(known.shape, np.float32)
    )


def records_for(need: Need) -> dict[str, Any]:
    if need.source == "reconstruct":
        return {"surface": cloud(len(need.role) + ord((need.subject.view or "0")[-1]))}
    if need.source == MEASUREMENT:
        size = seen_plate().xyz.shape[1:]
        texture = np.full(size, 1000, np.uint16)
        return {
            "measurement": Measurement(
                WHEN, FringeSequence(), 4000, 0.1, 2.0, texture, ArrayStack(texture[None])
            )
        }
    assert need.source == REFERENCE_SURFACES
    vertices, faces = plate_surface()
    return {
        "reference": ReferenceSurface("plate.stl", "0" * 64, "mm", False, vertices, faces.astype(np.int32))
    }


@pytest.fixture
def run() -> Run:
    """Run a kind on files of an archive."""
    archive = Archive(MemoryStore())

    def run_kind(kind: Any, **given: Any) -> list[Any]:
        with ExitStack() as stack:
            datasets = {}
            for place, need in enumerate(kind.checked_needs(CAMPAIGN, STATE, kind.parameters(**given))):
                job = f"{place:032x}"
                made = Provenance(
                    need.source, 1, need.subject, job, 1, WHEN, {}, (), "0.1", "host", "operator"
                )
                datasets[need.role] = stack.enter_context(
                    archive.open(archive.seal_dataset(records_for(need), made))
                )
            inputs = Inputs(STATE, kind.context(CAMPAIGN, STATE), datasets)
            told: list[float] = []
            outputs = list(kind.run(inputs, kind.parameters(**given), lambda part, _="": told.append(part)))
            assert told == sorted(told)
        made = Provenance(kind.name, 1, STATE, "f" * 32, 1, WHEN, {}, (), "0.1", "host", "operator")
        # What it makes can be sealed and read again.
        sealed = archive.seal_dataset(outputs[0].records, made)
        with archive.open(sealed) as dataset:
            for name in dataset.names:
                dataset.read(name, dataset.record_class(name))
        return outputs

    return run_kind


def test_a_dent_is_found_with_a_verdict(run: Run, tmp_path: Path) -> None:
    data, picture = run(deviate.KIND, **GIVEN, lower_mm=-0.4, upper_mm=0.4)
    assert isinstance(data, DatasetOutput)
    assert isinstance(picture, DocumentOutput)
    assert list(data.records) == ["deviation_C1", "registration", "mesh"]
    field, found, joined = (data.records[name] for name in data.records)
    assert isinstance(field, DeviationField)
    assert isinstance(found, SurfaceRegistration)
    assert isinstance(joined, Mesh)
    place = seen_plate().place
    square = (place[0] - AT[0]) ** 2 + (place[1] - AT[1]) ** 2
    bottom = square < 10.0**2
    # Two views are merged: sigma is 0.05 / sqrt(2) along the view. 5 of it, 9 um of chords, 20 um of pull.
    expected = -DEPTH_MM * np.exp(-0.5 * square / 25.0**2)
    assert np.nanmax(np.abs(field.deviation - expected)) < 5.0 * SIGMA_MM / np.sqrt(2.0) + 0.03
    assert (field.verdict[bottom] == Verdict.OUTSIDE).all()
    assert (field.verdict[30, 40:43] == Verdict.NOT_MEASURED).all()
    np.testing.assert_array_equal(np.isfinite(field.deviation), field.reason == Reason.VALID)
    # Outside is where the dent is deeper than 0.4 mm and two sigma, of 0.05 mm / sqrt(2): some 100 pixels, of
    # which those at the rim of that may fall on either side.
    beyond = expected[np.isfinite(field.deviation)] < -0.4 - 2.0 * SIGMA_MM / np.sqrt(2.0)
    assert data.statistics["outside_fraction"] == pytest.approx(np.mean(beyond), rel=0.15)
    assert data.statistics["deviation_minimum_mm"] == pytest.approx(-DEPTH_MM, abs=0.2)
    assert data.statistics["registration_converged"] == 1.0
    assert found.filename == "plate.stl"
    assert joined.value_names == ("deviation", "sigma of deviation", "deviation over sigma", "verdict")
    ratio = joined.values[0] / joined.values[1]
    np.testing.assert_allclose(joined.values[2], ratio, rtol=1e-12)
    # In the frame of the reference surface, the plate's rim is in the plane z = 0.
    assert np.abs(joined.vertices[:, 0]).max() < 211.0
    picture.write(tmp_path / "deviation.png")
    assert imread(tmp_path / "deviation.png").shape[1] == 900
    exporter = exporter_named("ply")
    exporter.write(source_for(exporter, joined, ["deviation"]), tmp_path / "deviation.ply")
    assert b"property double scalar_deviation\n" in (tmp_path / "deviation.ply").read_bytes()


def test_a_given_motion_is_kept(run: Run) -> None:
    data, _ = run(deviate.KIND, **GIVEN, iterations=0)
    kept = data.records["registration"]
    assert kept.iterations == 0
    np.testing.assert_allclose(kept.translation_mm, TRUTH.translation, rtol=1e-15)
    # Rotation to a vector and back.
    np.testing.assert_allclose(kept.rotation, TRUTH.matrix(), atol=1e-14)


def test_a_symmetric_part_needs_a_start(run: Run) -> None:
    with pytest.raises(MeasurementFailed, match="give a start"):
        run(deviate.KIND)


def test_parameters_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(ValidationError, match=r"lower_mm 0.2 must be below upper_mm 0.1"):
        deviate.DeviateParameters(lower_mm=0.2)
    with pytest.raises(ValidationError, match="start 'given' only"):
        deviate.DeviateParameters(iterations=0)


def test_the_mesh_of_a_state_leaves_holes_open_unless_it_is_told(run: Run) -> None:
    (data,) = run(mesh.KIND)
    joined = data.records["mesh"]
    assert joined.value_names == ("sigma of position", "texture", "filled")
    assert not joined.values[2].any()
    assert data.statistics["filled_holes_C1"] == 0.0
    np.testing.assert_allclose(joined.values[1], 0.25)


def test_filled_holes_are_marked(run: Run) -> None:
    (data,) = run(mesh.KIND, fill_holes_px=3)
    joined = data.records["mesh"]
    marked = joined.values[2] == 1.0
    assert np.count_nonzero(marked) == 3
    # What was made up has no uncertainty, and everything else has.
    np.testing.assert_array_equal(np.isnan(joined.values[0]), marked)
    assert data.statistics["filled_holes_C1"] == 1.0


def test_colours_meet_at_the_limits_of_the_tolerance() -> None:
    edges = band_edges(-0.1, 0.3)
    assert {-0.1, 0.3} <= set(np.round(edges, 12))
    assert np.all(np.diff(edges) > 0.0)
    nothing = np.full((8, 9), np.nan)
    field = DeviationField(
        "C1",
        ("C1P1",),
        -0.1,
        0.3,
        2.0,
        nothing,
        nothing.astype(np.float32),
        np.zeros((8, 9), np.uint8),
        np.full((3, 8, 9), np.nan),
        np.full((6, 8, 9), np.nan, np.float32),
        np.ones((8, 9), np.uint32),
    )
    assert draw_deviation(field)[:4] == b"\x89PNG"
    flat = replace(field, deviation=np.zeros((8, 9)), verdict=np.ones((8, 9), np.uint8))
    assert draw_deviation(flat) == draw_deviation(flat)
