"""Reconstruction of a simulated tuple: close to the truth, with the errors that it states."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import pi

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.kind import DatasetOutput, Inputs
from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS
from sms_jobs.records.calibration import CalibrationUncertainty
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.fields import PhaseMaps, Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import CameraResponse, Simulation
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import InMemory, run_kind, unheard
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import Shape, exact_shape

SUBJECT = Subject("plate", "S00", "C1P1")


@dataclass(frozen=True)
class Tuple:
    """A simulated tuple and what is true of it."""

    calibration: Calibration
    measurement: Measurement
    shape: Shape

    def reconstruct(
        self,
        parameters: ReconstructParameters | None = None,
        measurement: Measurement | None = None,
        threads: int = 1,
        progress: Callable[..., None] = lambda fraction, message="": None,
    ) -> tuple[Surface, PhaseMaps, DatasetOutput]:
        records = {"measurement": measurement or self.measurement, "calibration": self.calibration}
        output = run_kind(KIND, SUBJECT, records, threads, parameters or ReconstructParameters(), progress)
        assert list(output.records) == ["surface", "phase", "factor"]
        return output.records["surface"], output.records["phase"], output


def simulate(
    change: Callable[[Campaign], Campaign] = lambda campaign: campaign,
    sequence: FringeSequence | None = None,
) -> Tuple:
    calibration, campaign = small_plate("plate")
    campaign = change(campaign)
    assert campaign.scene is not None
    simulation = Simulation(campaign.scene, "C1", "P1", (), state="S00")
    sequence = sequence or campaign.sequence
    seen = render(simulation, sequence)
    measurement = Measurement(
        recorded_at=calibration.valid_from,
        sequence=sequence,
        full_scale=seen.full_scale,
        gain=seen.gain,
        read_noise=seen.read_noise,
        texture=seen.texture,
        frames=ArrayStack(seen.frames.rows(0, seen.frames.shape[1])),
    )
    return Tuple(calibration, measurement, exact_shape(simulation))


def unmarked(campaign: Campaign) -> Campaign:
    assert campaign.scene is not None
    return replace(campaign, scene=replace(campaign.scene, speckle=None))


def error_in_sigmas(cloud: Surface, shape: Shape) -> NDArray[np.float64]:
    """Return the distance from the truth in units of its predicted standard deviation.

    Of pixels that are valid and at least 3 px inside the plate: those on its border see past an edge.
    """
    sigma = np.sqrt(cloud.covariance[[0, 3, 5]].sum(axis=0))
    return error_mm(cloud, shape) / sigma[well_inside(cloud, shape)]


def error_mm(cloud: Surface, shape: Shape) -> NDArray[np.float64]:
    """Return the distance from the truth of the same pixels, in mm."""
    return np.asarray(np.linalg.norm(cloud.position - shape.xyz, axis=0)[well_inside(cloud, shape)])


def well_inside(cloud: Surface, shape: Shape) -> NDArray[np.bool_]:
    return np.asarray((cloud.reason == Reason.VALID) & ndimage.binary_erosion(shape.lit, iterations=3))


@pytest.fixture(scope="module")
def plain() -> Tuple:
    return simulate(unmarked)


@pytest.fixture(scope="module")
def speckled() -> Tuple:
    return simulate()


def test_an_unmarked_surface_scatters_as_predicted(plain: Tuple) -> None:
    cloud, _, output = plain.reconstruct()
    z = error_in_sigmas(cloud, plain.shape)
    # The rms of 10,000 pixels scatters by 0.7 %, their median by 1.2 %; four times that.
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.03)
    assert np.median(z) / 0.6745 == pytest.approx(1.0, abs=0.05)
    valid = cloud.reason == Reason.VALID
    lit = cloud.reason & (Reason.LOW_MODULATION | Reason.OUT_OF_VOLUME) == 0
    assert output.statistics["valid_fraction_of_image"] == pytest.approx(valid.mean())
    assert output.statistics["valid_fraction"] == pytest.approx(valid.sum() / lit.sum())
    # The plate fills a part of the image, of which little is lost.
    assert output.statistics["valid_fraction_of_image"] < 0.8 < output.statistics["valid_fraction"]


def test_good_pixels_are_kept_and_dark_ones_are_not(plain: Tuple, speckled: Tuple) -> None:
    for scene in (plain, speckled):
        cloud, _, _ = scene.reconstruct()
        valid = cloud.reason == Reason.VALID
        good = scene.shape.seen & scene.shape.lit
        # Two pixels of the border are given up: the one that is partly beside the plate, and the one within.
        inside = ndimage.binary_erosion(good, np.ones((3, 3)), iterations=2)
        # 0.1 % of good pixels fail each of two phase error tests; the scatter of 10,000 pixels is 0.04 %.
        assert valid[inside].mean() > 0.997
        assert not valid[~good].any()


def black_on_white(campaign: Campaign) -> Campaign:
    """Give the plate speckles of black paint, 17 times as dark as its ground."""
    assert campaign.scene is not None
    assert campaign.scene.speckle is not None
    return replace(
        campaign, scene=replace(campaign.scene, speckle=replace(campaign.scene.speckle, dark=0.05))
    )


def test_black_speckles_on_white_are_measured() -> None:
    painted = simulate(black_on_white)
    cloud, _, output = painted.reconstruct()
    inside = ndimage.binary_erosion(painted.shape.seen & painted.shape.lit, np.ones((3, 3)), iterations=2)
    # At the rims of speckles, a pixel wide, most of the light comes from beside; all else is kept. It was 0.3
    # while these rims were taken for edges of the surface.
    assert (cloud.reason == Reason.VALID)[inside].mean() > 0.9
    z = error_in_sigmas(cloud, painted.shape)
    # As with weaker speckles, below: what the correction leaves is stated to a quarter.
    assert np.median(z) / 0.6745 == pytest.approx(1.0, abs=0.25)
    assert 0.75 < np.sqrt(np.mean(z**2)) < 1.1
    assert output.statistics["blur_px"] == pytest.approx(np.sqrt(0.25 + 1.0 / 12.0), abs=0.03)


def test_the_textures_error_is_corrected_and_the_rest_is_stated(speckled: Tuple) -> None:
    corrected, _, output = speckled.reconstruct()
    raw, _, _ = speckled.reconstruct(ReconstructParameters(blur_px=0.0, calibration_sigma_px=0.25))
    z = error_in_sigmas(corrected, speckled.shape)
    # What the correction leaves is not Gaussian: its size is stated to a quarter.
    assert np.median(z) / 0.6745 == pytest.approx(1.0, abs=0.25)
    # In millimetres: uncorrected, it looks in part like light of a surface beside, and enters the deviation.
    assert np.median(error_mm(raw, speckled.shape)) > 3.0 * np.median(error_mm(corrected, speckled.shape))
    # The rig's lens blurs by 0.5 px, its pixels are squares of variance 1/12.
    assert output.statistics["blur_px"] == pytest.approx(np.sqrt(0.25 + 1.0 / 12.0), abs=0.03)


def test_an_invalid_pixel_is_nan_and_says_why(speckled: Tuple) -> None:
    cloud, _, _ = speckled.reconstruct()
    valid = cloud.reason == Reason.VALID
    assert valid.any()
    assert not valid.all()
    for values in (*cloud.position, *cloud.covariance, cloud.ray_gap):
        np.testing.assert_array_equal(np.isfinite(values), valid)
    dark = ~ndimage.binary_dilation(speckled.shape.seen, iterations=3)  # beyond the blurred border
    said = (cloud.reason[dark] & (Reason.LOW_MODULATION | Reason.AMBIGUOUS_UNWRAPPING)) != 0
    assert said.all()


def test_points_outside_the_volume_are_marked(plain: Tuple) -> None:
    low, high = plain.calibration.volume.low, plain.calibration.volume.high
    box = replace(plain.calibration.volume, high=(0.0, high[1], high[2]), low=low)
    halved = replace(plain, calibration=replace(plain.calibration, volume=box))
    cloud, _, _ = halved.reconstruct()
    right = plain.shape.lit & (plain.shape.xyz[0] > 1.0)
    assert (cloud.reason[right] & Reason.OUT_OF_VOLUME != 0).all()
    assert np.nanmax(cloud.position[0]) <= 0.0


def test_a_wrong_calibration_opens_the_ray_gap(plain: Tuple) -> None:
    wrong = replace(plain, calibration=with_projector_moved(plain.calibration, 4.0))
    cloud, _, output = wrong.reconstruct()
    lit = plain.shape.lit
    assert (cloud.reason[lit] & Reason.LARGE_RAY_GAP != 0).mean() > 0.99
    # They are lit, and lost all the same.
    assert output.statistics["valid_fraction"] < 0.01


def with_projector_moved(calibration: Calibration, shift_px: float) -> Calibration:
    """Return a calibration by which the projector's image lies so much lower: the rays miss each other."""
    lens = calibration.rig.sensor("P1").intrinsics
    moved = replace(lens, cy=lens.cy + shift_px)
    sensors = (replace(s, intrinsics=moved) if s.name == "P1" else s for s in calibration.rig.sensors)
    return replace(calibration, rig=replace(calibration.rig, sensors=tuple(sensors)))


@pytest.mark.parametrize(
    ("shift_px", "told"),
    [
        (0.0, "triangulated"),
        (0.08, "triangulated"),  # what a calibration may be off by that states nothing
        (0.15, "by 0.15 px (rms), and the calibration does not say how well it is known: points may be off"),
        (0.25, "of the rays miss each other: a sensor has moved"),
    ],
)
def test_rays_that_miss_each_other_are_told(plain: Tuple, shift_px: float, told: str) -> None:
    said: list[str] = []
    other = replace(plain, calibration=with_projector_moved(plain.calibration, shift_px))
    _, _, output = other.reconstruct(progress=lambda fraction, message="": said.append(message))
    assert told in said[-1]
    assert ("miss each other" in said[-1]) == (shift_px > 0.1)
    # Across the images of rays, which are tilted by 13 degrees; also where most points are lost by it.
    across = 0.974 * shift_px
    assert (f"by {across:.2g} px (rms), and" in said[-1]) == (shift_px > 0.1)
    (missed,) = output.records["factor"].missed
    assert missed.off_px == pytest.approx(across, abs=0.002)


def test_rays_that_contradict_a_calibration_make_its_part_larger(plain: Tuple) -> None:
    """By a plane through all that is missed, though the noise of points, 0.007 px, hides it from each."""
    names = tuple(sensor.name for sensor in plain.calibration.rig.sensors)
    stated_px, found, said = 0.005, [], []
    sigma = np.zeros((len(names), PER_SENSOR))
    sigma[names.index("P1"), SENSOR_PARAMETERS.index("cy")] = stated_px
    known = CalibrationUncertainty(names, SENSOR_PARAMETERS, np.diag(sigma.ravel() ** 2))
    parameters = ReconstructParameters(calibration_sigma_px=0.1)  # all points are kept
    for shift_px in (0.0, 0.02, 0.034):
        moved = with_projector_moved(plain.calibration, shift_px)
        datasets = {
            "measurement": InMemory(SUBJECT, {"measurement": plain.measurement}),
            "calibration": InMemory(SUBJECT, {"calibration": moved, "uncertainty": known}),
        }
        (output,) = KIND.run(
            Inputs(SUBJECT, None, datasets), parameters, lambda _, words="": said.append(words)
        )
        assert isinstance(output, DatasetOutput)
        found.append(output.records["surface"].sigma_calibration)
        factor = output.records["factor"]
        assert factor.stated_px[0] == pytest.approx(stated_px, rel=0.1)
        assert factor.times == pytest.approx(6.8 if shift_px > 0.03 else 1.0, rel=0.05)
        assert ("its part of all deviations is taken to be 6.8 times" in said[-1]) == (shift_px > 0.03)
        assert output.statistics["epipolar_stated_px"] == pytest.approx(stated_px, rel=0.1)
    np.testing.assert_allclose(np.nanmedian(found[2]) / np.nanmedian(found[0]), 6.8, rtol=0.05)
    np.testing.assert_allclose(np.nanmedian(found[1]) / np.nanmedian(found[0]), 1.0, rtol=1e-2)


def test_of_what_is_not_lit_no_sensor_is_said_to_have_moved(plain: Tuple, rng: np.random.Generator) -> None:
    shape = plain.measurement.frames.shape
    dark = ArrayStack(rng.integers(10, 14, shape).astype(np.uint16))
    said: list[str] = []
    surface, _, _ = plain.reconstruct(
        measurement=replace(plain.measurement, frames=dark),
        progress=lambda fraction, message="": said.append(message),
    )
    assert (surface.reason & Reason.LARGE_RAY_GAP != 0).any()
    assert "miss each other" not in said[-1]


@pytest.mark.parametrize(("sigma_px", "kept"), [(0.0, 0.0), (2.0, 0.8)])
def test_gaps_are_judged_by_what_a_calibration_says_of_itself(
    plain: Tuple, sigma_px: float, kept: float
) -> None:
    rig = plain.calibration.rig
    sigma = np.zeros((len(rig.sensors), PER_SENSOR))
    sigma[[s.name == "P1" for s in rig.sensors], SENSOR_PARAMETERS.index("cy")] = sigma_px
    uncertainty = CalibrationUncertainty(
        tuple(s.name for s in rig.sensors), SENSOR_PARAMETERS, np.diag(sigma.ravel() ** 2)
    )
    # Across the plane of both rays; the rays miss each other by nearly as much.
    calibration = with_projector_moved(plain.calibration, 4.0)
    datasets = {
        "measurement": InMemory(SUBJECT, {"measurement": plain.measurement}),
        "calibration": InMemory(SUBJECT, {"calibration": calibration, "uncertainty": uncertainty}),
    }
    (output,) = KIND.run(Inputs(SUBJECT, None, datasets), ReconstructParameters(blur_px=0.0), unheard)
    assert isinstance(output, DatasetOutput)
    found = output.statistics["valid_fraction"]
    assert found >= kept if kept else found == 0.0


def test_a_dark_measurement_has_no_points_but_reasons(plain: Tuple) -> None:
    frames = np.full(plain.measurement.frames.shape, 40, np.uint16)
    cloud, _, output = plain.reconstruct(measurement=replace(plain.measurement, frames=ArrayStack(frames)))
    assert (cloud.reason != Reason.VALID).all()
    assert np.isnan(cloud.position).all()
    assert output.statistics["valid_fraction"] == 0.0
    assert output.statistics["lost_to_low_modulation"] == 1.0
    assert all(np.isfinite(list(output.statistics.values())))


def test_saturated_pixels_say_so(plain: Tuple) -> None:
    frames = np.full(plain.measurement.frames.shape, plain.measurement.full_scale, np.uint16)
    cloud, phase, _ = plain.reconstruct(measurement=replace(plain.measurement, frames=ArrayStack(frames)))
    assert (cloud.reason & Reason.SATURATED != 0).all()
    assert np.isnan(phase.omega).all()


def test_glare_costs_densities_and_not_pixels() -> None:
    def overexposed(campaign: Campaign) -> Campaign:
        scene = unmarked(campaign).scene
        assert scene is not None
        return replace(campaign, scene=replace(scene, camera=CameraResponse(exposure=1.1)))

    bright = simulate(overexposed, FringeSequence((32, 31, 30, 28, 24, 16)))
    cut = np.any(bright.measurement.frames.rows(0, 128) >= bright.measurement.full_scale, axis=0)
    cloud, _, _ = bright.reconstruct()
    touched = cut & bright.shape.lit
    assert touched.sum() > 1000
    kept = touched & (cloud.reason == Reason.VALID)
    assert kept.sum() > 0.3 * touched.sum()
    cloud.reason[~kept] |= np.uint32(Reason.SATURATED)  # judge the touched pixels alone
    z = error_in_sigmas(cloud, bright.shape)
    # 3 % for 3000 pixels; a frame just below full scale is one whose noise was low, which adds a bias.
    assert np.median(z) / 0.6745 == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize(
    "sequence",
    [
        FringeSequence((1, 2, 4, 8, 16), steps=3),
        FringeSequence((1, 16), steps=5, orientations_rad=(pi / 4, -pi / 4)),
        FringeSequence((16, 15, 14, 12, 8), orientations_rad=(0.0,)),
    ],
    ids=str,
)
def test_any_sequence_gives_the_shape(sequence: FringeSequence) -> None:
    scene = simulate(unmarked, sequence)
    cloud, _, _ = scene.reconstruct()
    z = error_in_sigmas(cloud, scene.shape)
    assert z.size > 0.85 * scene.shape.lit.sum()  # all but the border
    assert np.median(z) / 0.6745 == pytest.approx(1.0, abs=0.05)  # as above


def test_threads_change_nothing(speckled: Tuple) -> None:
    one, two = speckled.reconstruct(), speckled.reconstruct(threads=2)
    np.testing.assert_array_equal(one[0].position, two[0].position)
    np.testing.assert_array_equal(one[0].covariance, two[0].covariance)
    np.testing.assert_array_equal(one[0].reason, two[0].reason)
    assert one[2].statistics == two[2].statistics


def test_progress_rises_to_one(speckled: Tuple) -> None:
    told: list[float] = []
    speckled.reconstruct(progress=lambda fraction, message="": told.append(fraction))
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert len(told) > 3


def test_frames_of_another_camera_are_refused(plain: Tuple) -> None:
    cut = ArrayStack(plain.measurement.frames.rows(0, 100))
    with pytest.raises(InvalidInput, match="128 x 100 px"):
        plain.reconstruct(measurement=replace(plain.measurement, frames=cut))
