"""Haze before a camera, and a camera that moves: what rays miss each other by is in the deviations."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from support.stereo_states import (
    bent,
    calibration,
    displaced,
    exposed,
    scores,
    surface_of,
    two_states,
    with_noise,
)
from support.two_cameras import Floats, Motion, at_rest, cameras, curved, seen_by

from sms_jobs.kinds.calibration_factors import OF_BOTH, moved_since
from sms_jobs.kinds.kind import DatasetOutput, Progress
from sms_jobs.kinds.shape.partner_places import PartnerPlaces, with_shaken_rays
from sms_jobs.kinds.shape.ray_images import told_by_rays
from sms_jobs.kinds.surface_ports import noise_covariance, position_covariance
from sms_jobs.metrology.calibration.missed_rays import MissedRays
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS
from sms_jobs.records.calibration import CalibrationFactor, CalibrationUncertainty
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Rig
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import InMemory, unheard

STATED_PX = 0.02
LATER = Subject("test", "S01", "C1C2")


def distorted(levels: Floats, x: Floats, y: Floats) -> Floats:
    """Return an image whose pixels show what lies so many px beside them."""
    at = np.indices(levels.shape) + np.stack([y, x])
    return np.asarray(ndimage.map_coordinates(levels, at, order=5, mode="nearest"))


def pair(which: int, motion: Motion, x: Floats, y: Floats) -> list[Measurement]:
    """Return the images of both cameras, one of them distorted."""
    images = [exposed(k, 2, curved, motion, 0)[0] for k in range(2)]
    levels = seen_by(cameras()[which], curved, motion).levels
    images[which] = with_noise(distorted(levels, x, y), np.random.default_rng(9))
    return images


def stated() -> CalibrationUncertainty:
    """Return what a calibration says that knows where the second camera looks to 0.02 px along x and y."""
    covariance = np.zeros((2 * PER_SENSOR, 2 * PER_SENSOR))
    for name in ("cx", "cy"):
        place = PER_SENSOR + SENSOR_PARAMETERS.index(name)
        covariance[place, place] = STATED_PX**2
    return CalibrationUncertainty(("C1", "C2"), SENSOR_PARAMETERS, covariance)


def later_by(
    images: list[Measurement], known: CalibrationUncertainty | None, progress: Progress = unheard
) -> tuple[DatasetOutput, str]:
    """Return the displacement from rest to bent images, and what was said at the end of their shape."""
    said: list[str] = []
    datasets = two_states("C1C2")
    if known is not None:
        at_start = [exposed(k, 2, curved, at_rest, 0)[0] for k in range(2)]
        before = surface_of(replace(LATER, state="S00"), at_start, calibration(), known)
        datasets["reference"] = InMemory(LATER, before.records)
    after = surface_of(LATER, images, calibration(), known, lambda _, words="": said.append(words))
    datasets["deformed"] = InMemory(LATER, after.records)
    datasets["measurement"] = InMemory(LATER, {"measurement": images[0]})
    return displaced("C1C2", datasets, "each-state", progress), said[-1]


def displacement_scores(output: DatasetOutput) -> Floats:
    """Return squared errors of displacements over what is stated in all of each component, (3, n)."""
    field = output.records["displacement"]
    valid = field.reason == Reason.VALID
    error = field.displacement - np.stack(bent(*seen_by(cameras()[0], curved).material))
    variance = field.covariance[[0, 3, 5]].astype(np.float64)
    if field.sigma_calibration is not None:
        variance = variance + field.sigma_calibration.astype(np.float64) ** 2
    return np.asarray(error[:, valid] ** 2 / variance[:, valid])


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize(("high_px", "long_px"), [(0.5, 75.0), (0.1, 126.0)])
def test_haze_before_either_camera_is_in_the_deviations(high_px: float, long_px: float, which: int) -> None:
    """Where nobody counted the higher waves points were off by some 30 deviations."""
    y, x = (2.0 * np.pi * axis / long_px for axis in np.indices((300, 400)))
    images = pair(which, at_rest, high_px * np.sin(y), high_px * np.cos(x))
    surface = surface_of(replace(LATER, state="S00"), images, calibration()).records["surface"]
    exact = exposed(0, 2, curved, at_rest, 0)[1]
    found = scores(surface.position - exact, position_covariance(surface), surface.reason)
    # As much along the rays, where it is not seen; of single matches alone 1.1 and 1.6.
    assert 0.6 < np.sqrt(found.mean()) < 1.1
    assert found.max() < 36.0
    assert len(found) > 60_000


@pytest.mark.parametrize("which", [0, 1])
def test_haze_at_a_later_state_is_in_the_displacement(which: int) -> None:
    y, x = np.indices((300, 400)).astype(np.float64)
    images = pair(which, bent, 0.5 * np.sin(y / 12.0), 0.5 * np.cos(x / 12.0))
    output, _ = later_by(images, None)
    found = displacement_scores(output)
    assert np.sqrt(found.mean(axis=1)).max() < 2.5
    assert found.max() < 36.0


@pytest.mark.parametrize("moved_px", [0.04, 0.3])
def test_a_camera_that_moves_is_in_the_displacement(moved_px: float) -> None:
    """Along and across rays alike: the former nobody sees."""
    shift, said = np.full((300, 400), moved_px), []
    images = pair(1, bent, shift, shift)
    output, told = later_by(images, stated(), lambda _, words="": said.append(words))
    if moved_px > 0.1:
        assert "the calibration's part of the displacement's deviation is larger for it" in said[-1]
    found = displacement_scores(output)
    assert 0.2 < np.sqrt(found.mean(axis=1)).max() < 1.5
    assert found.max() < 36.0
    before, now = (output.records[factor.stored_as] for factor in OF_BOTH)
    assert before.times == 1.0
    # What is seen in one state alone counts by 1.4826 of its median: more than has changed, and all of it.
    seen_alone = moved_px > 0.1
    assert now.times == pytest.approx(1.6 * moved_px / STATED_PX if seen_alone else 1.0, rel=0.3)
    # The images of rays are tilted by 7 degrees at most.
    assert now.turned_px == pytest.approx(0.0 if seen_alone else moved_px, rel=0.15)
    assert ("far less" in told) == (moved_px > 0.1)
    if moved_px > 0.1:  # 1.4826 of the median of what is 0.3 px nearly everywhere
        assert re.search(r"its part of all deviations is taken to be 2[2-6] times what it states", told)


def test_cameras_that_stay_add_nothing_to_the_displacement() -> None:
    still = np.zeros((300, 400))
    output, told = later_by(pair(1, bent, still, still), stated())
    field = output.records["displacement"]
    noise = np.sqrt(field.covariance[5][field.reason == Reason.VALID])
    # Both states' errors by the calibration are one, and the surface has moved by half a millimetre of 600.
    assert np.nanmedian(field.sigma_calibration[2]) < 0.05 * np.median(noise)
    assert output.records[OF_BOTH[1].stored_as].turned_px < 0.1 * STATED_PX
    assert "far less" not in told


def test_a_reference_that_missed_as_much_is_no_camera_that_moves() -> None:
    """The calibration is off from the start: its part is large at both states, and cancels between them."""
    exact = calibration()
    first, second = exact.rig.sensors
    lens = replace(second.intrinsics, cy=second.intrinsics.cy - 0.5)
    off = replace(exact, rig=Rig("two", (first, replace(second, intrinsics=lens))))
    datasets, parts = two_states("C1C2"), []
    for role, motion, state in (("reference", at_rest, "S00"), ("deformed", bent, "S01")):
        images = [exposed(k, 2, curved, motion, 0)[0] for k in range(2)]
        output = surface_of(replace(LATER, state=state), images, off, stated())
        parts.append(float(np.nanmedian(output.records["surface"].sigma_calibration[2])))
        datasets[role] = InMemory(LATER, output.records)
    field = displaced("C1C2", datasets, "each-state").records["displacement"]
    assert min(parts) > 20.0 * STATED_PX
    assert np.nanmedian(field.sigma_calibration[2]) < 0.05 * min(parts)


def test_rays_that_miss_far_are_told_where_nothing_is_stated_of_the_calibration() -> None:
    shift = np.full((300, 400), 0.3)
    _, told = later_by(pair(1, bent, shift, shift), None)
    assert re.match(
        r"note: the matches miss the images of their rays by 0\.[45]\d? px \(rms\), and the ", told
    )
    assert "no deviation includes that; calibrate the cameras as they stand" in told


def test_points_are_uncertain_across_the_rays_of_a_camera_before_which_air_shakes() -> None:
    """By the width of what shakes at their distance, and not along the rays; noise stays what it was."""
    camera = cameras()[0]
    clean: Surface = surface_of(
        replace(LATER, state="S00"), [exposed(k, 2, curved, at_rest, 0)[0] for k in range(2)], calibration()
    ).records["surface"]
    shape, shaken = clean.reason.shape, 0.04
    here, there = (
        PartnerPlaces(
            np.zeros((2, *shape)), np.ones((2, *shape)), np.ones((2, *shape)), np.zeros(shape, bool),
            (0.0, 0.0), np.full(shape, by),
        )
        for by in (shaken, 4.0 * shaken)
    )  # fmt: skip
    found = with_shaken_rays(clean, camera, [there, here])  # what both partners show is the least
    valid = clean.reason == Reason.VALID
    added = (position_covariance(found) - position_covariance(clean))[:, valid]
    ray = clean.position[:, valid] - camera.pose.centre()[:, None]
    depth = camera.pose.matrix()[2] @ ray
    wide = shaken * depth**2 / (camera.intrinsics.fx * camera.intrinsics.fy)
    np.testing.assert_allclose(added[[0, 3, 5]].sum(axis=0), 2.0 * wide, rtol=1e-3)
    xx, xy, xz, yy, yz, zz = added
    x, y, z = ray / np.linalg.norm(ray, axis=0)
    along = x * x * xx + y * y * yy + z * z * zz + 2.0 * (x * y * xy + x * z * xz + y * z * yz)
    np.testing.assert_allclose(along / wide, 0.0, atol=1e-3)
    own, other = (noise_covariance(one)[[0, 3, 5]][:, valid].sum(axis=0) for one in (clean, found))
    np.testing.assert_allclose(other, own, rtol=1e-3)
    still = replace(here, shaken=np.zeros(shape))
    assert with_shaken_rays(clean, camera, [here, still]) is clean


def factor(times: float, middle_px: float, sigma: float = 1e-3) -> CalibrationFactor:
    """Return how well two cameras are known whose rays miss each other by so much everywhere."""
    missed = MissedRays((200.0, 150.0), (100.0, 80.0), (middle_px, 0.0, 0.0), sigma, 0.01)
    root = times * np.eye(2 * PER_SENSOR)
    sensors = calibration().rig.sensors
    return CalibrationFactor(
        "C1C2", "known", sensors, (), SENSOR_PARAMETERS, root, (missed,), (STATED_PX,), times
    )


@pytest.mark.parametrize(
    ("before", "now", "turned_px"),
    [
        (factor(1.0, 0.0), factor(1.0, 0.1), 0.1),
        (factor(1.0, 0.0), factor(1.0, -0.1), 0.1),
        (factor(1.0, 0.0, 0.06), factor(1.0, 0.1, 0.06), 0.0),  # by noise
        (factor(1.0, 0.0), factor(4.0, 0.1), 0.08),  # of which 0.06 px is seen in the later state alone
        (factor(1.0, 0.0), factor(10.0, 0.1), 0.0),
        (factor(8.0, 0.2), factor(8.0, 0.2), 0.0),  # as wrong as it was
        (factor(8.0, 0.2), factor(8.0, -0.2), 0.4),
    ],
)
def test_what_has_changed_since_the_reference_counts(
    before: CalibrationFactor, now: CalibrationFactor, turned_px: float
) -> None:
    found = moved_since(before, now)
    assert found == replace(now, turned_px=found.turned_px)
    assert found.turned_px == pytest.approx(turned_px)
    assert moved_since(replace(before, calibration="another"), now) is now
    silent = moved_since(*(replace(one, root=one.root[:, :0], times=1.0) for one in (before, now)))
    assert silent.turned_px == pytest.approx(before.missed[0].change_px(now.missed[0]), abs=1e-12)


def test_a_partner_of_which_nothing_is_known_leaves_the_change_of_all_unknown() -> None:
    """Planes are told apart by their places alone."""
    two = factor(1.0, 0.0)
    root = 1e-6 * np.eye(3 * PER_SENSOR)
    three = replace(two, sensors=(*two.sensors, two.sensors[1]), root=root)
    surface = Surface("C1C2C2", "mm", np.zeros((3, 4, 5)), np.zeros((4, 5), np.uint32))
    (own,) = two.missed
    assert told_by_rays(three, surface, 0.0, 0.01, [own, own]).missed == (own, own)
    for missed in ([own, None], [None, own]):
        found = told_by_rays(three, surface, 0.0, 0.01, missed)
        assert found.missed == ()
        assert len(found.stated_px) == 2
