"""One camera and no projector: displacement and strain in the image, from textures alone."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

from sms_jobs.bench.in_memory import InMemory
from sms_jobs.bench.speckle_pairs import Floats, speckle_pair
from sms_jobs.errors import InvalidInput
from sms_jobs.kinds import correlate_images, gauges, strain_images
from sms_jobs.kinds.correlate_images import CorrelateImagesParameters
from sms_jobs.kinds.gauges import GaugesParameters
from sms_jobs.kinds.kind import DatasetOutput, Inputs, Kind, Parameters
from sms_jobs.kinds.strain_images import StrainImagesParameters
from sms_jobs.records.campaign import Subject
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.planar import PlanarDisplacement, PlanarStrain
from sms_jobs.records.reasons import Reason

SIZE, NOISE = 160, 8.0
ALONG, ACROSS, SHEAR = 4e-3, -1.2e-3, 1e-3
SUBJECT = Subject("coupon", "S01", "C1")


def stretch(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Return the displacement in px; y is down, so that a positive du/dy is a negative shear."""
    return 1.3 + ALONG * x - SHEAR * y, 0.4 + ACROSS * y


def texture_only(image: Floats) -> Measurement:
    """Return a measurement whose only frame is its texture: nothing was projected."""
    texture = np.clip(np.rint(image), 0, 4095).astype(np.uint16)
    return Measurement(
        recorded_at=datetime(2026, 1, 5, tzinfo=UTC),
        sequence=FringeSequence(),
        full_scale=4095,
        gain=0.0,
        read_noise=NOISE,
        texture=texture,
        frames=ArrayStack(texture[None]),
        simulation=None,
    )


def ran(kind: Kind[Any], parameters: Parameters, **records: dict[str, Any]) -> DatasetOutput:
    datasets = {role: InMemory(SUBJECT, found) for role, found in records.items()}
    (output,) = kind.run(Inputs(SUBJECT, "S00", datasets), parameters, lambda fraction, message="": None)
    assert isinstance(output, DatasetOutput)
    return output


@pytest.fixture(scope="module")
def images() -> dict[str, dict[str, Any]]:
    rng = np.random.default_rng(4)
    pair = (image + rng.normal(0.0, NOISE, image.shape) for image in speckle_pair(SIZE, stretch, 6))
    return {
        role: {"measurement": texture_only(i)}
        for role, i in zip(("reference", "measurement"), pair, strict=True)
    }


@pytest.fixture(scope="module")
def moved(images: dict[str, dict[str, Any]]) -> PlanarDisplacement:
    parameters = CorrelateImagesParameters(mm_per_px=0.05, search_range_x_px=6, search_range_y_px=6)
    found = ran(correlate_images.KIND, parameters, **images).records["displacement"]
    assert isinstance(found, PlanarDisplacement)
    return found


def test_displacement_is_the_true_one_within_its_sigma(moved: PlanarDisplacement) -> None:
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
    valid = moved.reason == Reason.VALID
    error = (moved.displacement - np.stack(stretch(x, y)))[:, valid]
    # All but a rim, whose subsets leave the image.
    assert valid.mean() > 0.85
    ratio = np.sqrt(np.mean((error / moved.sigma[:, valid]) ** 2))
    # Some 60 subsets side by side: 9 %, besides the required 20 %; extrapolated rims are noisier than stated.
    assert 0.7 < ratio < 1.5
    assert moved.displacement_mm is not None
    np.testing.assert_allclose(moved.displacement_mm, 0.05 * moved.displacement, equal_nan=True)
    assert moved.camera == "C1"


def test_strain_is_taken_from_what_is_stored_over_any_gauge(moved: PlanarDisplacement) -> None:
    gradient = np.array([[ALONG, SHEAR], [0.0, ACROSS]])
    green = 0.5 * (gradient + gradient.T + gradient.T @ gradient)
    truth = np.array([green[0, 0], green[1, 1], green[0, 1]])
    spread = []
    for length_mm in (2.0, 4.0):
        parameters = StrainImagesParameters(gauge_length_mm=length_mm)
        found = ran(strain_images.KIND, parameters, displacement={"displacement": moved}).records["strain"]
        assert isinstance(found, PlanarStrain)
        assert found.gauge_length_px == pytest.approx(length_mm / 0.05)
        valid = found.reason == Reason.VALID
        error = found.strain[:, valid] - truth[:, None]
        ratio = np.sqrt(np.mean((error / found.sigma[:, valid]) ** 2))
        # Few gauges fit side by side into the image: 16 of 40 px, 4 of 80 px; a factor of two either way.
        assert 0.4 < ratio < 2.0
        spread.append(float(np.sqrt(np.mean(error**2))))
    assert spread[1] < 0.6 * spread[0]


def test_a_region_of_interest_bounds_what_is_matched(images: dict[str, dict[str, Any]]) -> None:
    parameters = CorrelateImagesParameters(
        region_of_interest="rectangle 40 50 110 120", search_range_x_px=6, search_range_y_px=6
    )
    found = ran(correlate_images.KIND, parameters, **images).records["displacement"]
    valid = found.reason == Reason.VALID
    assert valid[50:120, 40:110].mean() > 0.95
    outside = np.ones_like(valid)
    outside[49:122, 39:112] = False
    assert not valid[outside].any()
    assert found.displacement_mm is None
    with pytest.raises(InvalidInput, match="has no scale"):
        ran(
            strain_images.KIND,
            StrainImagesParameters(gauge_length_mm=2.0),
            displacement={"displacement": found},
        )


def test_images_of_two_sizes_are_refused(images: dict[str, dict[str, Any]]) -> None:
    smaller = texture_only(images["measurement"]["measurement"].texture[:-4].astype(np.float64))
    with pytest.raises(InvalidInput, match="record both with one camera"):
        ran(
            correlate_images.KIND,
            CorrelateImagesParameters(),
            reference=images["reference"],
            measurement={"measurement": smaller},
        )


def test_nothing_is_said_of_a_hole_and_each_pixel_says_why(images: dict[str, dict[str, Any]]) -> None:
    """The background shows through a hole of radius 25 px and stays where it is."""
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
    distance = np.hypot(x - 80.0, y - 80.0) - 25.0
    rng = np.random.default_rng(5)
    pair = {}
    for role, given in images.items():
        levels = given["measurement"].texture.astype(np.float64)
        dark = 100.0 + rng.normal(0.0, NOISE, levels.shape)
        pair[role] = {"measurement": texture_only(np.where(distance < 0.0, dark, levels))}
    parameters = CorrelateImagesParameters(search_range_x_px=6, search_range_y_px=6)
    output = ran(correlate_images.KIND, parameters, **pair)
    found, matches = output.records["displacement"], output.records["matches"]
    # The outline is known to about half a window of 9 px, and pixels within a spacing of 4 px of it are kept.
    assert (found.reason[distance < -5.0] == Reason.NO_TEXTURE).all()
    ring = (distance > 5.0) & (distance < 15.0)
    assert (found.reason[ring] == Reason.VALID).all()
    error = (found.displacement - np.stack(stretch(x, y)))[:, ring]
    # Not pulled towards the background, which did not move while the specimen did by more than a pixel.
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert output.statistics["matched_fraction"] == pytest.approx(np.mean(matches.reason == Reason.VALID))
    plain = ran(correlate_images.KIND, parameters.model_copy(update={"outline": "none"}), **pair)
    assert plain.statistics["matched_fraction"] < output.statistics["matched_fraction"]


def test_images_without_texture_give_reasons_and_no_exception() -> None:
    rng = np.random.default_rng(6)
    grey = [texture_only(1000.0 + rng.normal(0.0, NOISE, (SIZE, SIZE))) for _ in range(2)]
    given = {"reference": {"measurement": grey[0]}, "measurement": {"measurement": grey[1]}}
    output = ran(correlate_images.KIND, CorrelateImagesParameters(), **given)
    assert (output.records["displacement"].reason == Reason.NO_TEXTURE).all()
    strained = ran(strain_images.KIND, StrainImagesParameters(), displacement=output.records)
    assert strained.statistics == {"valid_fraction": 0.0, "valid_fraction_of_image": 0.0}


def test_a_region_of_interest_beside_the_image_is_refused(images: dict[str, dict[str, Any]]) -> None:
    parameters = CorrelateImagesParameters(region_of_interest="rectangle 400 400 500 500")
    with pytest.raises(InvalidInput, match="leaves no pixel of coupon/S01/C1"):
        ran(correlate_images.KIND, parameters, **images)


def test_gauges_in_the_image_read_its_strain(moved: PlanarDisplacement) -> None:
    """A gauge in px, the same in mm, one across and one beside the image."""
    texts = (
        "px x=80px y=90px length=60px",
        "mm x=4 y=4.5 length=3",
        "across x=80px y=90px length=60px angle=90",
        "slanted x=80px y=90px length=60px angle=45",
        "beside x=400px y=90px length=60px",
    )
    given = {"displacement": moved}
    output = ran(gauges.KIND, GaugesParameters(gauge=texts), displacement=given)
    found = output.records["gauges"]
    assert isinstance(found, GaugeReadings)
    gradient = np.array([[ALONG, SHEAR], [0.0, ACROSS]])
    green = 0.5 * (gradient + gradient.T + gradient.T @ gradient)
    directions = [np.array([np.cos(a), np.sin(a)]) for a in (0.0, 0.0, np.pi / 2, np.pi / 4)]
    truth = np.array([d @ green @ d for d in directions])
    # One gauge of 30 x 60 px each: five stated deviations, which neglect what subsets share, are rare.
    assert (np.abs(found.strain[:4] - truth) < 5.0 * found.sigma[:4]).all()
    assert (found.sigma[:4] < 2e-3).all()
    assert found.strain[0] == pytest.approx(found.strain[1], abs=1e-12)
    assert np.isnan(found.strain[4])
    assert found.place_px is not None
    np.testing.assert_allclose(found.place_px[0], [80.0, 90.0], atol=1.0)
    np.testing.assert_allclose(found.place[0], [4.0, -4.5, 0.0], atol=0.05)


def test_a_gauge_in_mm_needs_a_scale(moved: PlanarDisplacement) -> None:
    bare = {"displacement": replace(moved, mm_per_px=None)}
    with pytest.raises(InvalidInput, match="no scale, so a place in mm of gauge G"):
        ran(gauges.KIND, GaugesParameters(gauge=("G x=4 y=4 length=3",)), displacement=bare)
    found = ran(gauges.KIND, GaugesParameters(gauge=("G x=80px y=80px length=60px",)), displacement=bare)
    assert np.isnan(found.records["gauges"].place).all()
    with pytest.raises(ValueError, match="lengths in mm and in px"):
        GaugesParameters(gauge=("G x=80px y=80 length=60px",))
