"""What datasets and maps say of the calibration's part of sigma."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from sms_jobs.app.holdings.reading import StoredRecord
from sms_jobs.app.specimens.specimen_axes import in_specimen_frame
from sms_jobs.archive import Provenance
from sms_jobs.formats.drawing.quantities import shown_of
from sms_jobs.lab.datasets import dataset_of
from sms_jobs.records.fields import DisplacementField, StrainField
from sms_jobs.records.shown.files import FileView
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate

SIZE = (4, 5)
WHEN = datetime(2026, 1, 2, tzinfo=UTC)


def field(part: np.ndarray | None) -> StrainField:
    strain, sigma = np.zeros((3, *SIZE)), np.ones((3, *SIZE), np.float32)
    reason = np.zeros(SIZE, np.uint32)
    return StrainField("small", "mm", 20.0, strain, sigma, strain[:2], strain[0], reason, part)


def stored(record: StrainField | DisplacementField) -> StoredRecord:
    file = FileView(1, "strain", "a/S01/C1P1", "a", "b", 1, "c", "d", WHEN, None, None)
    made = Provenance("strain", 6, Subject("a", "S01", "C1P1"), "e", 1, WHEN, {}, (), "0", "here", "anna")
    return StoredRecord(file, "strain", record, made)


def test_a_dataset_has_the_calibrations_part_as_a_variable() -> None:
    part = np.full((3, *SIZE), 2e-6, np.float32)
    found = dataset_of(stored(field(part)))
    assert found.sigma_calibration.dims == found.sigma.dims
    assert found.strain.attrs["ancillary_variables"] == "sigma sigma_calibration reason"
    assert "calibration alone" in found.sigma_calibration.attrs["long_name"]
    np.testing.assert_array_equal(found.sigma_calibration, part)


def test_a_dataset_without_it_says_that_it_is_not_known() -> None:
    found = dataset_of(stored(field(None)))
    assert "sigma_calibration" not in found.variables
    assert "not zero" in found.attrs["sigma_calibration"]


def test_a_dataset_along_the_specimens_axes_names_them() -> None:
    campaign = small_plate("a")[1]
    along = campaign.placement.matrix()[:, 0]
    moved = np.broadcast_to(along[:, None, None], (3, *SIZE)).copy()
    part = np.full((3, *SIZE), 1e-3, np.float32)
    covariance, reason = np.ones((6, *SIZE), np.float32), np.zeros(SIZE, np.uint32)
    record = DisplacementField("C1P1", "S00", "mm", moved, covariance, moved[:2].copy(), reason)
    turned = in_specimen_frame(replace(record, sigma_calibration=part), campaign)
    found = dataset_of(stored(turned))
    assert list(found.displacement_component.values) == ["x", "y", "z"]
    assert "xx" in found.covariance_component
    # A millimetre along the specimen: some roundings of 1.
    np.testing.assert_allclose(found.displacement.sel(displacement_component="x"), 1.0, atol=1e-14)
    np.testing.assert_allclose(found.displacement.sel(displacement_component="z"), 0.0, atol=1e-14)
    assert "along the specimen's axes" in found.attrs["sigma_calibration"]


def test_a_map_shows_it_in_the_unit_of_strain() -> None:
    image = {"unit": "1", "axes": ["component", "row", "column"], "shape": [3, *SIZE]}
    described = {
        name: {**image, "components": ["xx", "yy", "xy"]}
        for name in ("strain", "sigma", "bias", "sigma_calibration")
    }
    shown = {one.name: one for one in shown_of("strain", described)}
    assert shown["sigma from the calibration xx"].unit == "µε"
    assert shown["sigma from the calibration xx"].scale == shown["strain xx"].scale
    assert shown["bias xx"].unit == "µε"
    assert shown["bias xx"].scale == shown["strain xx"].scale
    assert "sigma xx" not in shown
