"""Two cameras that see the fringes of a projector that nobody calibrated: points, and their sigma."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.kinds.calibration_factors import moved_since
from sms_jobs.kinds.kind import CALIBRATION, DatasetOutput, Inputs
from sms_jobs.kinds.products import CALIBRATION_FACTOR
from sms_jobs.kinds.shape import stereo_fringes
from sms_jobs.kinds.shape.sparse_surface import sparse_stereo_fringes_surface
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS
from sms_jobs.metrology.geometry.transforms import PACKED
from sms_jobs.records.calibration import CalibrationFactor, CalibrationUncertainty
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import PlateWithHoleAndStep
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import Role
from sms_jobs.testing.in_memory import InMemory
from sms_jobs.testing.shelf import Shelf
from sms_jobs.virtual_rig.stereo_campaigns import curved, shared_fringes_campaign, shared_fringes_rig
from sms_jobs.virtual_rig.truth import exact_shape

COLUMNS, ROWS = 224, 176
FIELD_MM = 500.0 / 2.8
STEPPED = PlateWithHoleAndStep(120.0, 96.0, (-32.0, 10.0), 13.0, (30.0, -10.0), (36.0, 40.0), 30.0)
"""Its step of 30 mm hides some of the plate from the one camera or the other, which are 20 degrees apart."""
SUBJECT = Subject("trio", "S00", "C1C2P1")


@dataclass(frozen=True)
class Recorded:
    """Frames of both cameras, the exact calibration of all sensors, and the truth."""

    frames: tuple[Measurement, Measurement]
    calibration: Calibration
    xyz: Floats
    seen: Mask
    lit: Mask
    together: Mask
    """Which pixels of C1 see a point that the projector lights, and C2 sees, too."""


@cache
def recorded(surface: str, speckle_px: float = 0.0) -> Recorded:
    calibration, campaign = shared_fringes_campaign(
        "trio",
        rig=shared_fringes_rig(COLUMNS, ROWS),
        surface=STEPPED if surface == "stepped" else curved(0.8 * FIELD_MM),
        speckle_px=speckle_px,
        sequence=FringeSequence((32, 31, 28, 16)),
    )
    shelf = Shelf(replace(campaign, views=(str(SUBJECT.view),)), 1)
    shelf.record(Subject("trio", "S00"))
    frames = tuple(shelf.records["measurement", own]["measurement"] for own in SUBJECT.recordings)
    simulation = frames[0].simulation
    alone, both = exact_shape(simulation, ("P1",)), exact_shape(simulation, ("C2", "P1"))
    return Recorded(
        (frames[0], frames[1]), calibration, alone.xyz, alone.seen, alone.lit, both.seen & both.lit
    )


def inputs_of(
    about: Recorded,
    calibration: Calibration | None = None,
    uncertainty: CalibrationUncertainty | None = None,
    frames: tuple[Measurement, Measurement] | None = None,
) -> Inputs:
    known: dict[str, Any] = {"calibration": calibration or about.calibration}
    if uncertainty is not None:
        known["uncertainty"] = uncertainty
    datasets = {
        f"measurement {own}": InMemory(own, {"measurement": one})
        for own, one in zip(SUBJECT.recordings, frames or about.frames, strict=True)
    } | {CALIBRATION: InMemory(SUBJECT, known)}
    return Inputs(SUBJECT, None, datasets)


def output_of(
    about: Recorded,
    calibration: Calibration | None = None,
    uncertainty: CalibrationUncertainty | None = None,
    frames: tuple[Measurement, Measurement] | None = None,
    **parameters: Any,
) -> DatasetOutput:
    inputs = inputs_of(about, calibration, uncertainty, frames)
    chosen = stereo_fringes.StereoFringesParameters(**parameters)
    (output,) = stereo_fringes.run(inputs, chosen, unheard)
    assert isinstance(output, DatasetOutput)
    return output


def unheard(fraction: float, message: str = "") -> None:
    """Take what is said of the progress."""


@cache
def surface_of(surface: str, speckle_px: float = 0.0) -> Surface:
    return output_of(recorded(surface, speckle_px)).records["surface"]  # type: ignore[no-any-return]


def over_sigma(surface: Surface, xyz: Floats) -> Floats:
    """Return how far valid points are off, in units of what they state, along the camera's ray."""
    assert surface.covariance is not None
    valid = surface.reason == Reason.VALID
    trace = sum(surface.covariance[k] for k, (i, j) in enumerate(PACKED) if i == j)
    return np.asarray(np.linalg.norm((surface.position - xyz)[:, valid], axis=0) / np.sqrt(trace[valid]))


@pytest.mark.parametrize(("surface", "speckle_px"), [("curved", 0.0), ("curved", 4.0), ("stepped", 4.0)])
def test_points_are_off_by_what_they_state_and_none_by_far_more(surface: str, speckle_px: float) -> None:
    # Noise of the other camera is stated as of single pixels, and the parabola's mean has five ninths of its
    # variance: without texture the ratio is sqrt((1 + 5 / 9) / 2) = 0.88, for equal parts of both cameras.
    # Of 15,000 normal values the largest is 4.2 in the mean; 6 is beyond any of them.
    about = recorded(surface, speckle_px)
    ratio = over_sigma(surface_of(surface, speckle_px), about.xyz)
    assert 0.8 < float(np.sqrt(np.mean(ratio**2))) < 1.1
    assert float(ratio.max()) < 6.0
    kept = (surface_of(surface, speckle_px).reason == Reason.VALID)[about.together].mean()
    # Rims of three pixels are given up: a tenth of 110 x 115 px, and as much again along step and hole.
    assert kept > (0.85 if surface == "curved" else 0.75)


def test_what_the_step_hides_from_the_other_camera_has_no_value_and_says_so() -> None:
    about, surface = recorded("stepped", 4.0), surface_of("stepped", 4.0)
    hidden = about.seen & about.lit & ~about.together
    # What both see of the plate's own outline is left out: a pixel inside what is hidden is no rim.
    inside = (
        hidden
        & np.roll(hidden, 1, 0)
        & np.roll(hidden, -1, 0)
        & np.roll(hidden, 1, 1)
        & np.roll(hidden, -1, 1)
    )
    assert inside.sum() > 100
    assert not (surface.reason[hidden] == Reason.VALID).any()
    told = surface.reason[inside] & (Reason.NO_MATCH | Reason.LOW_MODULATION | Reason.HIGH_PHASE_ERROR)
    assert (told != 0).mean() > 0.95
    assert np.isnan(surface.position[:, hidden]).all()


def test_nothing_is_asked_of_the_projectors_calibration() -> None:
    about = recorded("curved", 4.0)
    cameras = tuple(s for s in about.calibration.rig.sensors if s.role is Role.CAMERA)
    projector = about.calibration.rig.sensor("P1")
    elsewhere = replace(projector, pose=replace(projector.pose, translation=(300.0, 10.0, 900.0)))
    for sensors in (cameras, (*cameras, elsewhere)):
        calibration = replace(about.calibration, rig=replace(about.calibration.rig, sensors=sensors))
        surface = output_of(about, calibration).records["surface"]
        np.testing.assert_array_equal(surface.position, surface_of("curved", 4.0).position)
        np.testing.assert_array_equal(surface.covariance, surface_of("curved", 4.0).covariance)


def test_the_calibrations_part_is_what_a_wrong_calibration_moves() -> None:
    about, off_px = recorded("curved"), 0.05
    sensors = [s for s in about.calibration.rig.sensors if s.role is Role.CAMERA]
    place = PER_SENSOR + SENSOR_PARAMETERS.index("cx")
    covariance = np.zeros((2 * PER_SENSOR, 2 * PER_SENSOR))
    covariance[place, place] = off_px**2
    known = CalibrationUncertainty(("C1", "C2"), SENSOR_PARAMETERS, covariance)
    output = output_of(about, None, known, blur_px=0.0)  # whose corrections would differ, by their noise
    inner = sensors[1].intrinsics
    moved = replace(sensors[1], intrinsics=replace(inner, cx=inner.cx + off_px))
    rig = replace(about.calibration.rig, sensors=(sensors[0], moved))
    other: Surface = output_of(about, replace(about.calibration, rig=rig), blur_px=0.0).records["surface"]
    stated: Surface = output.records["surface"]
    both = (stated.reason == Reason.VALID) & (other.reason == Reason.VALID)
    assert stated.sigma_calibration is not None
    shift = np.linalg.norm((other.position - stated.position)[:, both], axis=0)
    sigma = np.linalg.norm(stated.sigma_calibration[:, both], axis=0)
    # One parameter moves all points by exactly its deviation; between blocks sigma is interpolated.
    np.testing.assert_allclose(shift, sigma, rtol=0.02)
    factor: CalibrationFactor = output.records[CALIBRATION_FACTOR.stored_as]
    assert [sensor.name for sensor in factor.sensors] == ["C1", "C2"]
    # The uncertain parameter moves places along the rays' images: none of it is a gap.
    assert output.statistics["epipolar_stated_px"] < 0.1 * off_px


def other_size(about: Recorded) -> dict[str, Any]:
    sensors = tuple(
        replace(s, columns=s.columns + 2) if s.name == "C2" else s for s in about.calibration.rig.sensors
    )
    return {"calibration": replace(about.calibration, rig=replace(about.calibration.rig, sensors=sensors))}


def without_c2(about: Recorded) -> dict[str, Any]:
    sensors = tuple(s for s in about.calibration.rig.sensors if s.name != "C2")
    return {"calibration": replace(about.calibration, rig=replace(about.calibration.rig, sensors=sensors))}


def other_orientation(about: Recorded) -> dict[str, Any]:
    first, second = about.frames
    turned = tuple(reversed(second.sequence.orientations_rad))
    return {"frames": (first, replace(second, sequence=replace(second.sequence, orientations_rad=turned)))}


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (other_size, "the frames of trio/S00/C2P1 are 224 x 176 px but C2 is calibrated for 226 x 176 px"),
        (without_c2, "rig virtual-shared-fringes has no sensor C2; it has C1, P1"),
        (other_orientation, "saw fringes of different orientations: record or import both with one sequence"),
    ],
)
def test_what_cannot_be_measured_is_refused(wrong: Callable[[Recorded], dict[str, Any]], words: str) -> None:
    about = recorded("curved")
    with pytest.raises(InvalidInput, match=words):
        output_of(about, **wrong(about))


def test_fringes_of_one_orientation_are_refused() -> None:
    about = recorded("curved")
    single = FringeSequence(about.frames[0].sequence.densities, orientations_rad=(0.0,))
    frames = tuple(replace(one, sequence=single) for one in about.frames)
    with pytest.raises(
        InvalidInput, match="has fringes of one orientation, by which nothing tells a wrong point"
    ):
        output_of(about, frames=(frames[0], frames[1]))


def turned(about: Recorded, names: tuple[str, str], by_px: float = 0.0) -> Calibration:
    """Return a calibration whose cameras have those of `names`, the second with images moved down."""
    sensors = [
        replace(about.calibration.rig.sensor(own), name=f"C{k}") for k, own in enumerate(names, start=1)
    ]
    inner = sensors[1].intrinsics
    sensors[1] = replace(sensors[1], intrinsics=replace(inner, cy=inner.cy + by_px))
    return replace(about.calibration, rig=replace(about.calibration.rig, sensors=tuple(sensors)))


def test_swapped_cameras_and_another_calibration_are_refused() -> None:
    about = recorded("curved")
    with pytest.raises(MeasurementFailed, match="with the two swapped: import the frames or the calibration"):
        output_of(about, turned(about, ("C2", "C1")))
    with pytest.raises(MeasurementFailed, match=r"3 px \(median\) beside the images of their rays"):
        output_of(about, turned(about, ("C1", "C2"), 3.0))
    # By less than is refused, but by far more than noise and an unstated calibration explain: no values.
    output = output_of(about, turned(about, ("C1", "C2"), 0.5))
    surface: Surface = output.records["surface"]
    assert output.statistics["valid_fraction"] < 0.01
    assert (surface.reason[about.together] & Reason.LARGE_RAY_GAP != 0).mean() > 0.9


def test_a_camera_that_moves_is_told_by_what_rays_miss() -> None:
    """The second camera is said to look 0.05 px lower than it does, known to 0.02 px: as if it had moved."""
    about, moved_px, stated_px = recorded("curved"), 0.05, 0.02
    place = PER_SENSOR + SENSOR_PARAMETERS.index("cy")
    covariance = np.zeros((2 * PER_SENSOR, 2 * PER_SENSOR))
    covariance[place, place] = stated_px**2
    known = CalibrationUncertainty(("C1", "C2"), SENSOR_PARAMETERS, covariance)
    before, now = (
        output_of(about, turned(about, ("C1", "C2"), by), known).records[CALIBRATION_FACTOR.stored_as]
        for by in (0.0, moved_px)
    )
    # Six deviations explain either by itself.
    assert (before.times, now.times) == (1.0, 1.0)
    assert abs(before.missed[0].plane[0]) < 0.01
    assert abs(now.missed[0].plane[0]) == pytest.approx(moved_px, rel=0.15)
    assert now.stated_px[0] == pytest.approx(stated_px, rel=0.02)
    same = replace(now, calibration=before.calibration)
    assert moved_since(before, same).turned_px == pytest.approx(moved_px, rel=0.15)
    assert moved_since(before, now) is now  # of two calibrations nothing is common


def test_a_camera_that_sees_no_fringes_is_told() -> None:
    about = recorded("curved")
    first, second = about.frames
    dark = replace(second, frames=ArrayStack(np.zeros(second.frames.shape, np.uint16)))
    with pytest.raises(MeasurementFailed, match="C1 and C2 see no point of the fringes together"):
        output_of(about, frames=(first, dark))


def test_a_quick_look_has_every_nth_point_of_the_same_surface() -> None:
    about, whole = recorded("curved", 4.0), surface_of("curved", 4.0)
    sparse = sparse_stereo_fringes_surface(inputs_of(about), 4, unheard)
    np.testing.assert_array_equal(sparse.position, whole.position[:, 2::4, 2::4])
    np.testing.assert_array_equal(sparse.reason, whole.reason[2::4, 2::4])
