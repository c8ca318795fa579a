"""The diagnose kind on simulated tuples: gamma, and the ripple that reconstruction then shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.errors import MeasurementFailed
from sms_jobs.kinds.calibration import diagnose
from sms_jobs.kinds.kind import DatasetOutput
from sms_jobs.kinds.shape import reconstruct
from sms_jobs.records.diagnosis import ResponseDiagnosis
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import ProjectorResponse, Simulation, Speckle
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import InMemory, run_kind
from sms_jobs.virtual_rig.campaigns import START, small_plate
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import exact_shape

SUBJECT = Subject("plate", "S00", "C1P1")
DENSITIES = (32, 31, 30, 28, 24, 16)


def recorded(
    projector: ProjectorResponse, sequence: FringeSequence, speckle: Speckle | None = None
) -> tuple[dict[str, object], Simulation]:
    calibration, campaign = small_plate("plate")
    assert campaign.scene is not None
    simulation = Simulation(replace(campaign.scene, speckle=speckle, projector=projector), "C1", "P1", ())
    seen = render(simulation, sequence)
    measurement = Measurement(
        START, sequence, seen.full_scale, seen.gain, seen.read_noise, seen.texture, seen.frames, simulation
    )
    return {"measurement": measurement, "calibration": calibration}, simulation


def diagnosed(records: dict[str, object], **parameters: object) -> tuple[ResponseDiagnosis, DatasetOutput]:
    wanted = diagnose.DiagnoseParameters(**parameters)  # type: ignore[arg-type]
    output = run_kind(diagnose.KIND, SUBJECT, records, 1, wanted)
    return output.records["response"], output


@pytest.mark.parametrize("gamma", [1.0, 1.7])
def test_gamma_is_found_on_a_speckled_plate(gamma: float) -> None:
    sequence = FringeSequence(tuple(range(16)))
    found, output = diagnosed(recorded(ProjectorResponse(gamma), sequence, Speckle(7.0))[0])
    # Edges of speckles distort the waveform by some per cent of what noise does to a single pixel.
    np.testing.assert_allclose(found.gamma, gamma, atol=0.02)
    assert found.densities == tuple(range(1, 16))
    assert output.statistics["gamma"] == pytest.approx(float(found.gamma.mean()))


def test_the_predicted_ripple_is_that_of_the_shape() -> None:
    records, simulation = recorded(ProjectorResponse(1.8), FringeSequence(DENSITIES, 3))
    found, output = diagnosed(records)
    rough = reconstruct.ReconstructParameters(
        blur_px=0.0, maximum_phase_error_rad=0.5, calibration_sigma_px=1.25
    )
    cloud = run_kind(reconstruct.KIND, SUBJECT, records, 1, rough).records["surface"]
    assert isinstance(cloud, Surface)
    row, column = found.y.astype(int), found.x.astype(int)
    shape = exact_shape(simulation)
    # A pixel that the plate covers in part has another error of its own.
    inside = ndimage.binary_erosion(shape.seen & shape.lit, iterations=3)
    error = (cloud.position - shape.xyz)[:, row, column]
    valid = (inside & (cloud.reason == Reason.VALID))[row, column]
    assert valid.mean() > 0.8
    moved, error = found.ripple[:, valid], error[:, valid]
    share = float(np.sum(moved * error) / np.sum(moved * moved))
    # 2000 pixels whose ripple exceeds the noise give its share to 2 %; blur takes some per cent of it.
    assert share == pytest.approx(1.0, abs=0.1)
    # Without it, what is left is the noise that the covariance states, and the few per cent of blur.
    left = float(np.mean(np.sum((error - moved) ** 2, axis=0)))
    fine = reconstruct.ReconstructParameters(blur_px=0.0, response="measured")
    straight = run_kind(reconstruct.KIND, SUBJECT, records, 1, fine).records["surface"]
    assert isinstance(straight, Surface)
    variances = [np.asarray(one.covariance)[[0, 3, 5]].sum(axis=0) for one in (straight, cloud)]
    stated = [variance[row, column][valid] for variance in variances]
    noise = float(stated[0].mean())
    ripple = float(np.mean(np.sum(moved**2, axis=0)))
    assert noise < left < 1.2 * noise + 0.1**2 * ripple
    assert ripple > 50.0 * noise
    # A ripple that is left in is stated; 500 pixels tell it to 3e-4 of its 0.2 rad, and blur takes its share.
    assert float(stated[1].mean()) == pytest.approx(noise + ripple, rel=0.1)
    length = np.sqrt(np.sum(np.square(found.ripple), axis=0))
    assert output.statistics["ripple_rms_mm"] == pytest.approx(float(np.sqrt(np.mean(length**2))))


def test_rows_and_pixels_are_limited() -> None:
    records, _ = recorded(ProjectorResponse(1.3), FringeSequence(DENSITIES))
    found, _ = diagnosed(records, rows=10, most_pixels=1000)
    assert len(np.unique(found.y)) <= 10
    assert 100 < len(found.x) <= 1000


def test_a_dark_recording_is_refused() -> None:
    records, _ = recorded(ProjectorResponse(), FringeSequence(DENSITIES))
    with pytest.raises(MeasurementFailed, match="have clear fringes"):
        diagnosed(records, minimum_modulation_to_noise=1e4)


def test_records_in_memory_have_names() -> None:
    dataset = InMemory(SUBJECT, {"a": 1, "b": "two"})
    assert dataset.names == ("a", "b")
    assert dataset.read("b", str) == "two"
