"""Shape, displacement and strain of a bent cylinder from the images of two cameras and of three."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import get_args

import numpy as np
import pytest
from scipy import ndimage
from support.stereo_states import (
    NOISE,
    bent,
    calibration,
    displaced,
    exposed,
    known,
    measured,
    recorded,
    scores,
    surface_of,
    two_states,
)
from support.two_cameras import Height, at_rest, cameras, curved, flat, seen_by

from sms_jobs.errors import InvalidInput, MeasurementFailed
from sms_jobs.kinds.deformation import correlate, strain
from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters, Following
from sms_jobs.kinds.kind import DatasetOutput, Inputs
from sms_jobs.kinds.surface_ports import noise_covariance, position_covariance
from sms_jobs.metrology.geometry.camera import project
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sensors import Rig
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import InMemory, unheard
from sms_jobs.virtual_rig.campaigns import small_plate


@pytest.mark.parametrize("view", ["C1C2", "C1C2C3"])
def test_points_lie_where_they_are_and_scatter_as_they_say(view: str) -> None:
    output, exact = measured(at_rest, view)
    surface = output.records["surface"]
    found = scores(surface.position - exact, position_covariance(surface), surface.reason)
    # A fifth is what is promised; some 300 subsets side by side, each with one error, scatter by 4 %.
    assert np.sqrt(found.mean()) == pytest.approx(1.0, abs=0.2)
    assert found.max() < 36.0
    assert output.statistics["valid_fraction"] > 0.8
    assert surface.subset_radius_px == 12
    assert all(
        np.isnan(one[..., surface.reason != 0]).all() for one in (surface.position, surface.covariance)
    )


def test_a_third_camera_makes_points_better() -> None:
    two, three = (measured(at_rest, view)[0].statistics["median_sigma_mm"] for view in ("C1C2", "C1C2C3"))
    # Its base is twice as long.
    assert three < 0.7 * two


@cache
def moved(view: str, height: Height = curved, following: Following = "each-state") -> DatasetOutput:
    """Return the displacement of a view of two or three cameras from rest to what is bent."""
    return displaced(view, two_states(view, height), following)


@pytest.mark.parametrize("following", get_args(Following))
@pytest.mark.parametrize("view", ["C1C2", "C1C2C3"])
def test_each_component_of_displacement_scatters_as_it_says(view: str, following: Following) -> None:
    """Taken for independent, match and shapes would have X stated 1.7 and 1.8 times too large."""
    field = moved(view, following=following).records["displacement"]
    camera = cameras(count=len(Subject("test", "S01", view).recordings))[0]
    valid = field.reason == Reason.VALID
    error = field.displacement - np.stack(bent(*seen_by(camera, curved).material))
    square = error[:, valid] ** 2 / field.covariance[[0, 3, 5]][:, valid]
    # A fifth is what is promised; some 300 subsets side by side, each with one error, scatter by 4 %.
    np.testing.assert_allclose(np.sqrt(square.mean(axis=1)), 1.0, atol=0.2)


@pytest.mark.parametrize("following", ["own-reference", "shared-reference"])
def test_what_a_partner_shows_instead_is_not_followed(following: Following) -> None:
    """Dust lies before the second camera's later image alone, once both shapes have been measured."""
    datasets, subject = two_states("C1C2"), Subject("test", "S01", "C1C2")
    role = f"partner {subject.recordings[1]}"
    levels = datasets[role].read("measurement", Measurement).texture.copy()
    dust = np.s_[120:150, 180:210]
    levels[dust] = levels[50:80, 60:90]
    datasets[role] = InMemory(subject.recordings[1], {"measurement": recorded(levels)})
    field = displaced("C1C2", datasets, following).records["displacement"]
    clean = moved("C1C2", following=following).records["displacement"]
    lost = (field.reason != 0) & (clean.reason == 0)
    # Its rim may be taken for the specimen where windows of 7 px see little of it.
    assert lost.sum() > 0.6 * 30**2
    assert (field.reason[lost] & (Reason.IMAGES_DISAGREE | Reason.NO_MATCH | Reason.LARGE_RAY_GAP)).all()
    exact = np.stack(bent(*seen_by(cameras()[0], curved).material))
    assert scores(field.displacement - exact, field.covariance, field.reason).max() < 36.0
    assert np.isnan(field.displacement[:, field.reason != 0]).all()


@pytest.mark.parametrize("view", ["C1", "C1P1", "C1C2P1"])
def test_only_several_cameras_alone_are_followed(view: str) -> None:
    _, campaign = small_plate("plate")
    with pytest.raises(InvalidInput, match="several cameras without a projector, as C1C2; leave it out"):
        correlate.KIND.checked_needs(
            campaign, Subject("plate", "S01", view), CorrelateParameters(following="own-reference")
        )


def test_what_is_followed_needs_what_both_cameras_saw() -> None:
    _, campaign = small_plate("plate")
    needs = {
        following: {
            need.role
            for need in correlate.KIND.checked_needs(
                campaign, Subject("plate", "S01", "C1C2"), CorrelateParameters(following=following)
            )
        }
        for following in get_args(Following)
    }
    assert needs["own-reference"] - needs["each-state"] == {
        "calibration_at_rest",
        "reference_partner plate/S00/C2",
        "partner plate/S01/C2",
    }
    assert needs["own-reference"] == needs["shared-reference"]
    with pytest.raises(InvalidInput, match="following = own-reference goes with"):
        CorrelateParameters.checked("correlate", {"following": "own-reference", "subsets": "adaptive"})


def test_what_stands_still_changes_by_its_noise() -> None:
    """Images without noise would leave over as much in each recording, and the same."""
    first, again = (measured(at_rest, seed=seed)[0].records["surface"] for seed in (0, 1))
    both = (first.reason == Reason.VALID) & (again.reason == Reason.VALID)
    change = (again.position - first.position)[2, both]
    variance = sum(noise_covariance(one)[5, both].astype(np.float64) for one in (first, again))
    assert np.sqrt(np.mean(change**2 / variance)) == pytest.approx(1.0, abs=0.2)
    for surface in (first, again):
        part = surface.noise_part[surface.reason == Reason.VALID]
        assert (part > 0.0).all()
        assert part.max() == pytest.approx(1.0, abs=1e-6)
        assert (np.isnan(surface.noise_part) == np.isnan(surface.position[0])).all()


def test_displacement_and_strain_of_a_curved_surface() -> None:
    before, subject, output = measured(at_rest)[0], Subject("test", "S01", "C1C2"), moved("C1C2")
    field = output.records["displacement"]
    exact = np.stack(bent(*seen_by(cameras()[0], curved).material))
    found = scores(field.displacement - exact, field.covariance, field.reason)
    assert 0.8 < np.sqrt(found.mean()) < 1.2
    assert found.max() < 36.0
    datasets = {
        "displacement": InMemory(subject, output.records),
        "reference": InMemory(subject, before.records),
    }
    (strained,) = strain.run(Inputs(subject, (1.0, 0.0, 0.0), datasets), strain.StrainParameters(), unheard)
    assert isinstance(strained, DatasetOutput)
    shape = strained.records["strain"]
    valid = shape.reason == Reason.VALID
    # Along y the cylinder's axis the surface is stretched by -5e-4, and bent along its waves not at all.
    _, y = seen_by(cameras()[0], curved).material
    slope = -2.0 / 15.0 * np.sin(y / 15.0)
    along = (0.5 * (1.0 - 5e-4) ** 2 - 0.5) / (1.0 + slope**2)
    score = np.sqrt(np.mean(((shape.strain[1] - along) / shape.sigma[1])[valid] ** 2))
    assert 0.6 < score < 1.2


def test_swapped_cameras_are_refused() -> None:
    subject = Subject("test", "S00", "C1C2")
    images = [exposed(k, 2, curved, at_rest, 0)[0] for k in range(2)]
    # By matches, and where the usual search, of 3 px, finds none to judge them by.
    for width in (20.0, 0.5):
        with pytest.raises(
            MeasurementFailed,
            match=r"beside the images of their rays.*With C1 and C2 swapped it is 0\.\d+ px",
        ) as caught:
            surface_of(subject, images, calibration(order=(1, 0)), epipolar_width_px=width)
        assert "in the other order" in str(caught.value)


def test_cameras_that_moved_are_refused() -> None:
    """The second camera is said to look 5 px higher than it does."""
    subject = Subject("test", "S00", "C1C2")
    images = [exposed(k, 2, curved, at_rest, 0)[0] for k in range(2)]
    shifted = recorded(np.roll(images[1].texture, 5, axis=0))
    with pytest.raises(MeasurementFailed, match=r"[45](\.\d)? px \(median\) beside the images of their rays"):
        surface_of(subject, [images[0], shifted], calibration(), epipolar_width_px=10.0)
    with pytest.raises(MeasurementFailed, match=r"[45](\.\d)? px \(median\) beside the images of their rays"):
        surface_of(subject, [images[0], shifted], calibration())


def test_cameras_that_are_said_to_be_at_one_place_are_refused() -> None:
    subject = Subject("test", "S00", "C1C2")
    image = exposed(0, 2, curved, at_rest, 0)[0]
    exact = calibration()
    first, second = exact.rig.sensors
    both = replace(exact, rig=Rig("two", (first, replace(first, name=second.name))))
    with pytest.raises(MeasurementFailed, match="rays meet nowhere: by the calibration the cameras are 0 mm"):
        surface_of(subject, [image, image], both)


def test_textures_are_looked_for_where_the_calibration_knows_their_lines_to_be() -> None:
    """The second camera is said to look 0.8 px higher than it does: known to 0.5 px, that is no wonder."""
    subject = Subject("test", "S00", "C1C2")
    images = [exposed(k, 2, curved, at_rest, 0)[0] for k in range(2)]
    exact = calibration()
    first, second = exact.rig.sensors
    lens = replace(second.intrinsics, cy=second.intrinsics.cy - 0.8)
    off = replace(exact, rig=Rig("two", (first, replace(second, intrinsics=lens))))
    told: dict[float, str] = {}
    said: list[str] = []

    def heard(fraction: float, words: str = "") -> None:
        said.append(words)

    for sigma in (0.5, 0.02):
        output = surface_of(subject, images, off, known(sigma), heard)
        # Between cameras side by side lines run along x, so that cy is the distance from them.
        assert output.statistics["epipolar_stated_px"] == pytest.approx(sigma, rel=0.02)
        # What is left of 0.8 px by the rms of noise, 0.03 px, and by the lines' tilt.
        assert output.statistics["epipolar_rms_px"] == pytest.approx(1.4826 * 0.8, rel=0.1)
        told[sigma] = said[-1]
    assert "the calibration states 0.5 px" in told[0.5]
    assert "moved" not in told[0.5]
    assert told[0.02].startswith("note: the matches miss the images of their rays by 1.2 px (rms)")
    assert "states 0.02 px, far less: the cameras may have moved since, or be swapped" in told[0.02]
    surface_of(subject, images, exact, progress=heard)
    assert said[-1].endswith("the calibration does not say how well it is known")


@pytest.mark.parametrize("radius_px", [2.0, 3.0])
def test_what_the_partner_alone_shows_has_no_point_where_it_would_be_wrong(radius_px: float) -> None:
    """Dust before the partner, a fiftieth or a twentieth of a subset: no match alone leaves over too much."""
    subject, random = Subject("test", "S00", "C1C2"), np.random.default_rng(6)
    clean = [seen_by(camera, flat) for camera in cameras()]
    second, noise = cameras()[1], 60.0
    dusty = clean[1].levels.copy()
    row, column = np.mgrid[:300, :400]
    disc = np.hypot(column - 200, row - 150) <= radius_px
    dusty[disc] = np.roll(clean[1].levels, 60, axis=1)[disc]
    images = [
        replace(
            recorded(np.rint(one + random.normal(0.0, noise, one.shape)).astype(np.uint16)), read_noise=noise
        )
        for one in (clean[0].levels, dusty)
    ]
    surface = surface_of(subject, images, calibration()).records["surface"]
    place = project(second.intrinsics, second.pose, np.moveaxis(clean[0].points, 0, -1))
    off = np.hypot(place[..., 0] - 200.0, place[..., 1] - 150.0)
    there = off < 12 + radius_px
    assert (surface.reason[there] & Reason.IMAGES_DISAGREE).any()
    # Six deviations are what is promised of every valid value; some 80,000 reach 4.5.
    assert (
        scores(surface.position - clean[0].points, position_covariance(surface), surface.reason).max() < 36.0
    )
    # Elsewhere hardly anything is lost: one in a thousand by chance, with its window of some 50 pixels.
    away = (off > 40.0) & np.isin(surface.reason, (Reason.VALID, Reason.IMAGES_DISAGREE))
    assert (surface.reason[away] == Reason.VALID).mean() > 0.997


def test_one_camera_of_three_that_moved_is_not_hidden_by_the_others() -> None:
    subject = Subject("test", "S00", "C1C2C3")
    images = [exposed(k, 3, curved, at_rest, 0)[0] for k in range(3)]
    # The wider angle sees less of what the first camera sees: most of the matches are of the other two.
    images[2] = recorded(np.roll(images[2].texture, 5, axis=0))
    with pytest.raises(MeasurementFailed, match=r"[45](\.\d)? px \(median\) beside the images of their rays"):
        surface_of(subject, images, calibration(3), epipolar_width_px=10.0)


def test_one_camera_of_three_that_turned_along_the_images_of_its_rays_is_refused() -> None:
    """With the first alone its rays meet: what only these two see would be off by a hundred deviations."""
    subject = Subject("test", "S00", "C1C2C3")
    images = [exposed(k, 3, curved, at_rest, 0)[0] for k in range(3)]
    first, _, third = cameras(count=3)
    towards = first.pose.centre() / np.linalg.norm(first.pose.centre())
    start, end = project(third.intrinsics, third.pose, np.array([-5.0 * towards, 5.0 * towards]))
    along = (end - start) / np.linalg.norm(end - start)
    turned = ndimage.shift(images[2].texture.astype(np.float64), along[::-1], order=5, mode="nearest")
    images[2] = recorded(np.clip(np.rint(turned), 0, 4095).astype(np.uint16))
    with pytest.raises(MeasurementFailed, match=r"rays of C1 and C2 and C3 miss each other at .* has turned"):
        surface_of(subject, images, calibration(3))


def test_images_with_nothing_in_common_are_refused() -> None:
    subject = Subject("test", "S00", "C1C2")
    first = exposed(0, 2, curved, at_rest, 0)[0]
    other = np.random.default_rng(9).integers(1000, 3000, first.texture.shape).astype(np.uint16)
    with pytest.raises(
        MeasurementFailed,
        match=r"C1 and C2 see nothing together: .* within the measurement volume.*sms data advise",
    ):
        surface_of(subject, [first, recorded(other)], calibration())


def test_a_blank_image_and_an_image_of_another_size_are_refused() -> None:
    subject = Subject("test", "S00", "C1C2")
    first = exposed(0, 2, curved, at_rest, 0)[0]
    with pytest.raises(InvalidInput, match="the image of test/S00/C2 is blank: every pixel is 7"):
        surface_of(subject, [first, recorded(np.full_like(first.texture, 7))], calibration())
    with pytest.raises(InvalidInput, match="has 400 x 200 px but C2 is calibrated for 400 x 300 px"):
        surface_of(subject, [first, recorded(first.texture[:200])], calibration())


def test_a_saturated_image_is_refused() -> None:
    subject = Subject("test", "S00", "C1C2")
    first = exposed(0, 2, curved, at_rest, 0)[0]
    bright = first.texture.copy()
    bright[:, :240] = 4095
    with pytest.raises(InvalidInput, match="60% of the image of test/S00/C2 are saturated, at 4095 or above"):
        surface_of(subject, [first, recorded(bright)], calibration())


def test_a_plain_image_has_no_point_and_says_so() -> None:
    subject = Subject("test", "S00", "C1C2")
    random = np.random.default_rng(2)
    plain = [
        recorded(np.rint(2000 + random.normal(0.0, NOISE, (300, 400))).astype(np.uint16)) for _ in range(2)
    ]
    with pytest.raises(MeasurementFailed, match="the image of test/S00/C1 shows no texture"):
        surface_of(subject, plain, calibration())


def test_a_flat_plate_is_flat() -> None:
    output, exact = measured(at_rest, height=flat)
    surface = output.records["surface"]
    valid = surface.reason == Reason.VALID
    depth = (surface.position - exact)[2, valid]
    # Its mean is that of some 300 independent subsets of 8 um.
    assert abs(depth.mean()) < 4.0 * depth.std() / np.sqrt(300.0)
