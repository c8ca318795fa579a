"""One camera and no projector: displacement and strain in the image, from textures alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

import numpy as np
import pytest

from sms_jobs.bench.correlated.speckle_pairs import speckle_pair
from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.deformation import correlate, gauges, strain
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters
from sms_jobs.kinds.deformation.gauges import GaugesParameters
from sms_jobs.kinds.deformation.strain import StrainParameters
from sms_jobs.kinds.kind import DatasetOutput, Inputs, Kind
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.shape import plane
from sms_jobs.kinds.shape.plane import PlaneParameters
from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.geometry.planes import covariance_in_space
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.fields import DisplacementField, StrainField, Surface
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import InMemory

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


CAMPAIGN = Campaign(
    "coupon", Specimen("coupon"), "camera", tuple(LoadState(f"S{k:02d}") for k in range(4)), ("C1",)
)
NARROW = CorrelateParameters(search_range_x_px=6, search_range_y_px=6)
REST = Subject("coupon", "S00", "C1")


@dataclass
class Test:
    """A test of a flat specimen with one camera: its images by state, and the results so far."""

    __test__ = False
    images: dict[str, Measurement]
    results: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)

    def ran(self, kind: Kind[Any], parameters: Parameters, subject: Subject = SUBJECT) -> DatasetOutput:
        """Run a kind as the planner would have it, on what was computed before it."""
        datasets = {}
        for need in kind.checked_needs(CAMPAIGN, subject, parameters):
            state = need.subject.state or ""
            held = {"measurement": self.images[state]}
            datasets[need.role] = InMemory(
                need.subject, held if need.source == "measurement" else self.results[need.source, state]
            )
        inputs = Inputs(subject, kind.context(CAMPAIGN, subject), datasets)
        (output,) = kind.run(inputs, parameters, lambda fraction, message="": None)
        assert isinstance(output, DatasetOutput)
        kind.checked(output)
        self.results[kind.name, subject.state or ""] = output.records
        return output

    def moved(
        self,
        parameters: CorrelateParameters = NARROW,
        on: PlaneParameters | None = None,
        subject: Subject = SUBJECT,
    ) -> DatasetOutput:
        """Correlate a state, on the plane of its reference."""
        self.ran(plane.KIND, on or PlaneParameters(), REST)
        return self.ran(correlate.KIND, parameters, subject)


def noisy(images: Iterable[Floats], seed: int) -> dict[str, Measurement]:
    rng = np.random.default_rng(seed)
    return {
        f"S{k:02d}": texture_only(image + rng.normal(0.0, NOISE, image.shape))
        for k, image in enumerate(images)
    }


@pytest.fixture(scope="module")
def images() -> dict[str, Measurement]:
    return noisy(speckle_pair(SIZE, stretch, 6), 4)


@pytest.fixture(scope="module")
def scaled(images: dict[str, Measurement]) -> Test:
    """The specimen with pixels of 0.05 mm, its displacement measured."""
    test = Test(images)
    test.moved(on=PlaneParameters(mm_per_px=0.05))
    return test


def displacement_of(test: Test, state: str = "S01") -> DisplacementField:
    found = test.results["correlate", state]["displacement"]
    assert isinstance(found, DisplacementField)
    return found


def test_displacement_is_the_true_one_within_its_sigma(scaled: Test) -> None:
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
    moved = displacement_of(scaled)
    valid = moved.reason == Reason.VALID
    error = (moved.image_displacement - np.stack(stretch(x, y)))[:, valid]
    sigma = np.sqrt(covariance_in_space(moved.covariance)[[0, 3]][:, valid]) / 0.05
    # All but a rim, whose subsets leave the image.
    assert valid.mean() > 0.85
    ratio = np.sqrt(np.mean((error / sigma) ** 2))
    # Some 60 subsets side by side: 9 %, besides the required 20 %; extrapolated rims are noisier than stated.
    assert 0.7 < ratio < 1.5
    assert (moved.view, moved.unit, len(moved.displacement)) == ("C1", "mm", 2)
    # y points up.
    upwards = moved.image_displacement * np.array([1.0, -1.0])[:, None, None]
    np.testing.assert_allclose(moved.displacement, 0.05 * upwards, equal_nan=True)


def test_what_a_plane_cannot_give_is_absent(scaled: Test) -> None:
    surface = scaled.results["plane", "S00"]["surface"]
    assert isinstance(surface, Surface)
    assert surface.covariance is None
    assert surface.ray_gap is None
    assert surface.position.shape == (2, SIZE, SIZE)
    np.testing.assert_allclose(surface.position[:, 30, 40], [2.0, -1.5])
    assert (surface.unit, surface.mm_per_px, surface.has_depth) == ("mm", 0.05, False)


def test_strain_is_taken_from_what_is_stored_over_any_gauge(scaled: Test) -> None:
    gradient = np.array([[ALONG, SHEAR], [0.0, ACROSS]])
    green = 0.5 * (gradient + gradient.T + gradient.T @ gradient)
    truth = np.array([green[0, 0], green[1, 1], green[0, 1]])
    spread = []
    for length_mm in (2.0, 4.0):
        found = scaled.ran(strain.KIND, StrainParameters(gauge_length_mm=length_mm)).records["strain"]
        assert isinstance(found, StrainField)
        assert (found.gauge_length, found.unit) == (length_mm, "mm")
        valid = found.reason == Reason.VALID
        error = found.strain[:, valid] - truth[:, None]
        ratio = np.sqrt(np.mean((error / found.sigma[:, valid]) ** 2))
        # Few gauges fit side by side into the image: 16 of 40 px, 4 of 80 px; a factor of two either way.
        assert 0.4 < ratio < 2.0
        spread.append(float(np.sqrt(np.mean(error**2))))
    assert spread[1] < 0.6 * spread[0]


def test_strain_is_taken_over_squares_of_pixels_too(scaled: Test) -> None:
    gradient = np.array([[ALONG, SHEAR], [0.0, ACROSS]])
    green = 0.5 * (gradient + gradient.T + gradient.T @ gradient)
    found = scaled.ran(strain.KIND, StrainParameters(method="square", square_px=31)).records["strain"]
    assert isinstance(found, StrainField)
    assert (found.unit, found.square_px) == ("mm", 31)
    assert found.gauge_length == pytest.approx(31 * 0.05)
    valid = found.reason == Reason.VALID
    error = found.strain[:, valid] - np.array([green[0, 0], green[1, 1], green[0, 1]])[:, None]
    # As of discs: y points up here, so that a shear of the wrong sign would be off by six deviations.
    assert 0.4 < np.sqrt(np.mean((error / found.sigma[:, valid]) ** 2)) < 2.0


def test_the_spatial_resolution_is_stated_and_found_by(scaled: Test) -> None:
    moved = displacement_of(scaled)
    valid = moved.reason == Reason.VALID
    assert moved.resolution_px is not None
    np.testing.assert_array_equal(np.isfinite(moved.resolution), valid)
    np.testing.assert_allclose(moved.resolution[valid], 0.05 * moved.resolution_px, rtol=1e-6)
    each = [scaled.ran(strain.KIND, StrainParameters(gauge_length_mm=length)) for length in (2.0, 4.0)]
    short, long = (output.records["strain"] for output in each)
    for one, output in zip((short, long), each, strict=True):
        assert np.isfinite(one.resolution[one.reason == Reason.VALID]).all()
        assert np.isnan(one.resolution[one.reason != Reason.VALID]).all()
        assert output.statistics["median_resolution_px"] == one.resolution_px
        assert output.statistics["median_resolution_mm"] == pytest.approx(0.05 * one.resolution_px)
    # A gauge alone leaves nine tenths of a period of 2.8 gauge lengths; displacement only adds to that.
    assert moved.resolution_px < 2.8 * 40.0 < short.resolution_px < long.resolution_px


def test_the_scale_changes_lengths_and_no_strain(scaled: Test, images: dict[str, Measurement]) -> None:
    bare = Test(images)
    bare.moved()
    # No pixel lies on the rim of a disc, where rounding decides whether it counts.
    wide = StrainParameters(gauge_length_px=41.3)
    in_px, in_mm = (test.ran(strain.KIND, wide).records["strain"] for test in (bare, scaled))
    assert (in_px.gauge_length, in_px.unit) == (41.3, "px")
    assert in_mm.gauge_length == pytest.approx(2.065)
    np.testing.assert_allclose(in_px.strain, in_mm.strain, rtol=0.0, atol=1e-9, equal_nan=True)
    usual = bare.ran(strain.KIND, StrainParameters()).records["strain"]
    assert usual.gauge_length == 60.0
    with pytest.raises(InvalidInput, match=r"has no scale.*gauge-length-px"):
        bare.ran(strain.KIND, StrainParameters(gauge_length_mm=2.0))
    both = StrainParameters(gauge_length_mm=2.0, gauge_length_px=50.0)
    assert bare.ran(strain.KIND, both).records["strain"].gauge_length == 50.0


def test_a_region_of_interest_bounds_what_is_matched(images: dict[str, Measurement]) -> None:
    test = Test(images)
    test.moved(NARROW.model_copy(update={"region_of_interest": "rectangle 40 50 110 120"}))
    found = displacement_of(test)
    valid = found.reason == Reason.VALID
    assert valid[50:120, 40:110].mean() > 0.95
    outside = np.ones_like(valid)
    outside[49:122, 39:112] = False
    assert not valid[outside].any()
    assert found.unit == "px"


def test_images_of_two_sizes_are_refused(images: dict[str, Measurement]) -> None:
    smaller = texture_only(images["S01"].texture[:-4].astype(np.float64))
    with pytest.raises(InvalidInput, match="record both with one camera"):
        Test(images | {"S01": smaller}).moved()


def test_nothing_is_said_of_a_hole_and_each_pixel_says_why(images: dict[str, Measurement]) -> None:
    """The background shows through a hole of radius 25 px and stays where it is."""
    y, x = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
    distance = np.hypot(x - 80.0, y - 80.0) - 25.0
    rng = np.random.default_rng(5)
    pierced = {}
    for state, given in images.items():
        levels = given.texture.astype(np.float64)
        dark = 100.0 + rng.normal(0.0, NOISE, levels.shape)
        pierced[state] = texture_only(np.where(distance < 0.0, dark, levels))
    output = Test(pierced).moved()
    found, matches = output.records["displacement"], output.records["matches"]
    # The outline is known to about half a window of 9 px, and pixels within a spacing of 4 px of it are kept.
    assert (found.reason[distance < -5.0] == Reason.NO_TEXTURE).all()
    ring = (distance > 5.0) & (distance < 15.0)
    assert (found.reason[ring] == Reason.VALID).all()
    error = (found.image_displacement - np.stack(stretch(x, y)))[:, ring]
    # Not pulled towards the background, which did not move while the specimen did by more than a pixel.
    assert np.sqrt(np.mean(error**2)) < 0.05
    assert output.statistics["matched_fraction"] == pytest.approx(np.mean(matches.reason == Reason.VALID))
    whole = Test(pierced).moved(on=PlaneParameters(outline="none"))
    assert whole.statistics["matched_fraction"] < output.statistics["matched_fraction"]


def test_images_without_texture_give_reasons_and_no_exception() -> None:
    test = Test(noisy([np.full((SIZE, SIZE), 1000.0)] * 2, 6))
    output = test.moved(CorrelateParameters())
    assert (output.records["displacement"].reason == Reason.NO_TEXTURE).all()
    strained = test.ran(strain.KIND, StrainParameters())
    assert strained.statistics == {"valid_fraction": 0.0, "valid_fraction_of_image": 0.0}


def test_a_region_of_interest_beside_the_image_is_refused(images: dict[str, Measurement]) -> None:
    with pytest.raises(InvalidInput, match="leaves no pixel of coupon/S01/C1"):
        Test(images).moved(CorrelateParameters(region_of_interest="rectangle 400 400 500 500"))


@pytest.mark.parametrize("reference", ["previous", "auto"])
def test_a_specimen_that_goes_far_is_followed_from_state_to_state(reference: Any) -> None:
    """Three steps of 24 px under a window: no search range covers them at once."""
    step, far = 24, 3 * 24
    whole, _ = speckle_pair(SIZE + far, lambda x, y: (0.0 * x, 0.0 * y), 8)
    test = Test(noisy((whole[:SIZE, far - k * step :][:, :SIZE] for k in range(4)), 9))
    parameters = CorrelateParameters(reference=reference, search_range_x_px=26, search_range_y_px=6)
    for state in ("S01", "S02", "S03"):
        output = test.moved(parameters, subject=Subject("coupon", state, "C1"))
    found, matches = displacement_of(test, "S03"), output.records["matches"]
    valid = found.reason == Reason.VALID
    # All but what has left the image.
    assert valid[:, : SIZE - far - 20].mean() > 0.85
    # Each step is known to about 0.01 px; three add up.
    assert np.abs(found.image_displacement[0][valid] - far).max() < 0.3
    assert np.sqrt(np.mean((found.image_displacement[0][valid] - far) ** 2)) < 0.05
    assert matches.steps is not None


def test_gauges_in_the_image_read_its_strain(scaled: Test) -> None:
    """A gauge in px, the same in mm, one across and one beside the image."""
    texts = (
        "px x=80px y=90px length=60px",
        "mm x=4 y=4.5 length=3",
        "across x=80px y=90px length=60px angle=90",
        "slanted x=80px y=90px length=60px angle=45",
        "beside x=400px y=90px length=60px",
    )
    found = scaled.ran(gauges.KIND, GaugesParameters(gauge=texts)).records["gauges"]
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


def test_a_gauge_in_mm_needs_a_scale(images: dict[str, Measurement]) -> None:
    bare = Test(images)
    bare.moved()
    with pytest.raises(InvalidInput, match="no scale, so a place in mm of gauge G"):
        bare.ran(gauges.KIND, GaugesParameters(gauge=("G x=4 y=4 length=3",)))
    found = bare.ran(gauges.KIND, GaugesParameters(gauge=("G x=80px y=80px length=60px",)))
    assert np.isnan(found.records["gauges"].place).all()
    with pytest.raises(ValueError, match="lengths in mm and in px"):
        GaugesParameters(gauge=("G x=80px y=80 length=60px",))
