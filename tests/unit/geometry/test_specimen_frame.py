"""A frame through points is right-handed and where they say, and as uncertain as they are."""

from __future__ import annotations

import numpy as np
import pytest

from sms_jobs.app.specimens.frame_choice import Choice
from sms_jobs.app.specimens.frame_finding import Finder
from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.specimen_frame import (
    fit_plane,
    frame_jacobian,
    frame_on_plane,
    frame_through,
    local_place,
    plane_factor,
    tiles_of,
)
from sms_jobs.metrology.geometry.transforms import rotation_matrix, rotation_vector, transform
from sms_jobs.records.fields import Surface

ROUNDING = 1e-12  # some roundings of numbers near 1, times lengths of 100 mm where positions are compared
TURNED = Pose.from_arrays(rotation_matrix(np.array([0.2, -0.3, 0.4])), np.array([30.0, -20.0, 500.0]))
PITCH_MM = 0.5


def corners(*points: tuple[float, float, float]) -> np.ndarray:
    return transform(TURNED, np.array(points))


def test_the_frame_is_that_of_its_points() -> None:
    origin, x, plane = corners((0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (-15.0, 40.0, 0.0))
    found = frame_through(origin, x, plane)
    np.testing.assert_allclose(found.matrix(), TURNED.matrix(), atol=ROUNDING)
    np.testing.assert_allclose(found.translation, TURNED.translation, atol=100 * ROUNDING)


def test_z_points_outwards_whatever_side_the_third_point_lies_on() -> None:
    outward = TURNED.matrix()[:, 2] + [0.1, 0.2, -0.1]
    for y in (40.0, -40.0):
        origin, x, plane = corners((0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (10.0, y, 0.0))
        np.testing.assert_allclose(
            frame_through(origin, x, plane, outward).matrix(), TURNED.matrix(), atol=ROUNDING
        )
    # Without a side it is the third point that says where y is.
    np.testing.assert_allclose(frame_through(origin, x, plane).matrix()[:, 2], -TURNED.matrix()[:, 2])


def test_points_of_one_line_tell_no_frame() -> None:
    origin, x, plane = corners((0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (50.0, 1.0, 0.0))
    with pytest.raises(InvalidInput, match="nearly on one line"):
        frame_through(origin, x, plane)
    with pytest.raises(InvalidInput, match="nearly on one line"):
        frame_through(origin, origin, plane)
    with pytest.raises(InvalidInput, match="one place of the plane"):
        frame_on_plane(origin, origin + TURNED.matrix()[:, 2], origin, TURNED.matrix()[:, 2])


def test_points_off_a_plane_are_taken_onto_it() -> None:
    normal = TURNED.matrix()[:, 2]
    origin, x, middle = corners((0.0, 0.0, 3.0), (80.0, 0.0, -2.0), (-7.0, 9.0, 0.0))
    found = frame_on_plane(origin, x, middle, 2.0 * normal)
    np.testing.assert_allclose(found.matrix(), TURNED.matrix(), atol=ROUNDING)
    np.testing.assert_allclose(found.translation, TURNED.translation, atol=100 * ROUNDING)


def test_the_deviations_of_a_frame_are_its_scatter(rng: np.random.Generator) -> None:
    values = corners((0.0, 0.0, 0.0), (80.0, 0.0, 0.0), (20.0, 50.0, 0.0)).ravel()
    root = 0.02 * rng.normal(size=(9, 9))

    def make(numbers: np.ndarray) -> Pose:
        return frame_through(*numbers.reshape(3, 3), TURNED.matrix()[:, 2])

    stated = np.sqrt(np.sum((frame_jacobian(make, values, 80.0) @ root) ** 2, axis=1))
    off = []
    for drawn in rng.normal(size=(2000, 9)):
        found = make(values + root @ drawn)
        turn = rotation_vector(TURNED.matrix().T @ found.matrix())
        off.append([*turn, *(TURNED.matrix().T @ (np.array(found.translation) - TURNED.translation))])
    # A standard deviation of 2000 draws is known to 1.6 %; four of those.
    np.testing.assert_allclose(np.std(off, axis=0) / stated, 1.0, atol=0.065)


def surface(rng: np.random.Generator, noise_mm: float, size: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Return the xy plane of the frame as a camera sees it, x to the right and y down its image."""
    row, column = np.mgrid[:size, :size].astype(float)
    flat = np.stack([PITCH_MM * column, -PITCH_MM * row, np.zeros_like(row)], axis=-1)
    position = np.moveaxis(transform(TURNED, flat), -1, 0)
    covariance = np.zeros((6, size, size))
    covariance[[0, 3, 5]] = noise_mm**2
    return position + noise_mm * rng.normal(size=position.shape), covariance


def test_a_place_between_pixels_is_found_with_its_deviation(rng: np.random.Generator) -> None:
    pixel = (30.3, 24.6)
    (true,) = corners((PITCH_MM * pixel[0], -PITCH_MM * pixel[1], 0.0))
    score = []
    for _ in range(300):
        position, covariance = surface(rng, 0.02)
        found = local_place(position, covariance, np.ones((60, 60), bool), pixel)
        off = found.place - true
        score.append(off @ np.linalg.solve(found.covariance, off))
    # The mean of 300 chi-squares of 3 is 3 with a deviation of sqrt(6 / 300) = 0.14; four of those.
    assert np.mean(score) == pytest.approx(3.0, abs=0.57)
    # Some 80 pixels are averaged: a ninth of one pixel's deviation.
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(0.02 / np.sqrt(80), rel=0.05)
    np.testing.assert_allclose(found.outward(), TURNED.matrix()[:, 2], atol=0.01)
    together = local_place(position, covariance, np.ones((60, 60), bool), pixel, together=True)
    # Errors that go together are not made less by a mean.
    assert np.sqrt(together.covariance[0, 0]) >= 0.02 * (1.0 - 1e-9)


def test_a_place_without_a_surface_is_refused(rng: np.random.Generator) -> None:
    position, covariance = surface(rng, 0.001)
    valid = np.ones((60, 60), bool)
    valid[:, 30:] = False
    for pixel, words in (((70.0, 5.0), "not in the image"), ((35.0, 30.0), "have a position")):
        with pytest.raises(InvalidInput, match=words):
            local_place(position, covariance, valid, pixel)
    with pytest.raises(InvalidInput, match="not in the image"):
        local_place(position, covariance, valid, (-3.0, 5.0))
    stepped = position.copy()
    stepped[2, :, 15:] += 2.0
    with pytest.raises(InvalidInput, match="off a plane"):
        local_place(stepped, covariance, valid, (15.0, 30.0))


def test_a_plane_is_that_of_its_region_and_knows_how_flat_it_is(rng: np.random.Generator) -> None:
    rows, columns = (each.ravel() for each in np.mgrid[:60, :60])
    tiles, outward = tiles_of(rows, columns), TURNED.matrix()[:, 2]
    assert len(np.unique(tiles)) == 16
    place = corners((PITCH_MM * 29.5, -PITCH_MM * 29.5, 0.0))[0]
    off, stated = [], []
    for _ in range(200):
        points = surface(rng, 0.02)[0].reshape(3, -1).T
        points[::50] += 3.0 * outward
        found = fit_plane(points, tiles, outward)
        assert not found.used[::50].any()
        off.append([*(found.across.T @ outward), (place - found.middle) @ found.normal])
        stated.append(np.diag(found.covariance))
    # A jackknife of 16 tiles has a variance to 36 %; the mean of 200 to 3 %, the scatter of 200 to 10 %.
    np.testing.assert_allclose(np.mean(np.square(off), axis=0) / np.mean(stated, axis=0), 1.0, atol=0.45)
    assert found.rms == pytest.approx(0.02, rel=0.1)
    with pytest.raises(InvalidInput, match="99 pixels"):
        fit_plane(points[:99], tiles[:99], outward)
    with pytest.raises(InvalidInput, match="is a line"):
        fit_plane(np.outer(np.arange(200.0), [1.0, 0.0, 0.0]), np.zeros(200, np.int64), outward)


def test_the_middle_of_a_region_is_as_well_known_as_the_mean_of_its_points(rng: np.random.Generator) -> None:
    choice = Choice(x=(40.0, 30.0), region="rectangle 10 10 49 49", view="C1P1")
    off, stated = [], []
    for _ in range(200):
        position, covariance = surface(rng, 0.02)
        seen = Surface("C1P1", "mm", position, np.zeros((60, 60), np.uint32), covariance.astype(np.float32))
        found = Finder(seen, None, None, choice).frame("")
        place = corners((PITCH_MM * 29.5, -PITCH_MM * 29.5, 0.0))[0]
        off.append(found.placement.matrix().T @ (np.array(found.placement.translation) - place))
        assert found.deviation is not None
        stated.append(found.deviation.origin_mm)
    # The scatter of 200 is known to 5 %; four of those. The height is a jackknife's, compared above.
    scatter = np.sqrt(np.mean(np.square(off), axis=0))[:2]
    np.testing.assert_allclose(scatter / np.mean(stated, axis=0)[:2], 1.0, atol=0.2)
    assert scatter[0] == pytest.approx(0.02 / 40.0, rel=0.2)


def test_pixels_of_one_line_tell_no_frame_of_a_surface_that_bends(rng: np.random.Generator) -> None:
    position, covariance = surface(rng, 0.0)
    column = np.arange(60.0)
    bend = -((column - 30.0) ** 2) / 100.0
    position = position + TURNED.matrix()[:, 2][:, None, None] * bend
    seen = Surface(
        "C1P1", "mm", position, np.zeros((60, 60), np.uint32), covariance.astype(np.float32) + 1e-4
    )
    for aside, told in ((30.0, True), (45.0, False)):
        choice = Choice(x=(50.0, 30.0), origin=(10.0, 30.0), plane=(30.0, aside), view="C1P1")
        finder = Finder(seen, None, None, choice)
        if told:
            with pytest.raises(InvalidInput, match="nearly on one line"):
                finder.frame("")
        else:
            assert finder.frame("").placement.matrix()[:, 2] @ TURNED.matrix()[:, 2] > 0.5


def test_a_plane_moves_with_its_points(rng: np.random.Generator) -> None:
    rows, columns = (each.ravel() for each in np.mgrid[:30, :30])
    tiles, outward = tiles_of(rows, columns), TURNED.matrix()[:, 2]
    points = surface(rng, 0.0, 30)[0].reshape(3, -1).T
    before = fit_plane(points, tiles, outward)
    # What a calibration makes of points is smooth in their place.
    bend = rng.normal(size=(3, 3, 2))
    factor = np.einsum("ni,ijr->njr", 1e-3 * (points - before.middle), bend) + rng.normal(size=(3, 2))
    found = plane_factor(before, points, factor)
    step = 1e-4
    for column in range(2):
        after = fit_plane(points + step * factor[:, :, column], tiles, outward)
        height = (after.middle - before.middle) @ after.normal / (before.normal @ after.normal)
        # Second order in the step: 1e-4 of what is found.
        np.testing.assert_allclose(
            [*(after.normal @ before.across) / step, height / step], found[:, column], atol=1e-3
        )
