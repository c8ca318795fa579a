"""A stage of known geometry is led back to from the spheres it carries, with the error that is promised."""

from __future__ import annotations

from math import cos, degrees, pi, radians, sin

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.errors import CalibrationFailed, InvalidInput
from sms_jobs.metrology.calibration.stage.pan_tilt import (
    Stage,
    bar_geometry,
    centre_jacobian,
    label_special_poses,
    meeting_point,
    point_on_axis,
    predict_centres,
    prediction_covariance,
    principal_angle,
    special_poses,
    stage_from_special_poses,
    stage_rotation,
    turning_axis,
)
from sms_jobs.metrology.calibration.stage.pan_tilt_refinement import (
    refine_stage,
    search_margin_mm,
    sphere_regions,
)
from sms_jobs.metrology.geometry.camera import Pose, pixel_grid, ray_directions
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.transforms import rotation_matrix

Floats = NDArray[np.float64]

STALK, OFFSET, LENGTH = 60.0, 85.0, 200.0
EXACT = 1e-9  # mm: coordinates of some 500 mm carry 1e-13 mm of rounding, and few operations enlarge it
TABLE_3 = [
    (radians(pan), radians(tilt))
    for tilt in (-45.0, -22.5, 0.0, 22.5, 45.0)
    for pan in (315, 337.5, 0, 22.5, 45)
]
"""The angles of thesis Table 3."""


def a_stage(stalk: float = STALK, along: float = 1.0) -> Stage:
    bar = np.array([[stalk, 0.0, -along * OFFSET], [stalk, 0.0, along * (LENGTH - OFFSET)]])
    rotation = rotation_matrix(np.array([0.4, -1.1, 0.7]))
    return Stage(rotation, np.array([30.0, -250.0, 480.0]), bar, None, 0.0, pi / 2)


def special(stage: Stage, pan: float, tilt: float) -> tuple[Floats, Floats, Floats]:
    return predict_centres(stage, 0, 0), predict_centres(stage, pan, 0), predict_centres(stage, 0, tilt)


def seen_in(stage: Stage, angles: list[tuple[float, float]]) -> Floats:
    return np.array([predict_centres(stage, *pose) for pose in angles])


def isotropic(sigma: float, poses: int) -> Floats:
    return np.broadcast_to(sigma**2 * np.eye(3), (poses, 2, 3, 3)).copy()


def test_the_stage_turns_by_the_tilt_and_then_by_the_pan() -> None:
    pan, tilt = 0.7, -1.2
    about_x = np.array([[1, 0, 0], [0, cos(pan), -sin(pan)], [0, sin(pan), cos(pan)]])
    about_y = np.array([[cos(tilt), 0, sin(tilt)], [0, 1, 0], [-sin(tilt), 0, cos(tilt)]])
    # Three products of sines: a few roundings.
    assert stage_rotation(pan, tilt) == pytest.approx(about_x @ about_y, abs=1e-15)


def test_centres_turn_on_circles_about_the_pan_axis() -> None:
    stage = a_stage()
    for pan in (-2.0, 0.3, 1.4):
        inside = (predict_centres(stage, pan, 0.0) - stage.origin) @ stage.rotation
        assert inside[:, 0] == pytest.approx([STALK, STALK], abs=EXACT)
        assert np.hypot(inside[:, 1], inside[:, 2]) == pytest.approx([OFFSET, LENGTH - OFFSET], abs=EXACT)


@pytest.mark.parametrize(("angle", "same"), [(315, -45), (-315, 45), (180, 180), (-180, 180), (720, 0)])
def test_angles_are_the_same_after_a_turn(angle: float, same: float) -> None:
    assert principal_angle(radians(angle)) == pytest.approx(
        radians(same), abs=1e-14
    )  # of 4 pi: few roundings


@pytest.mark.parametrize("pan", [315.0, 22.5, -100.0, 160.0])
@pytest.mark.parametrize("tilt", [-22.5, 330.0, 100.0])
@pytest.mark.parametrize(("stalk", "along"), [(STALK, 1.0), (-STALK, 1.0), (STALK, -1.0), (0.0, -1.0)])
def test_special_poses_lead_back_to_the_stage(pan: float, tilt: float, stalk: float, along: float) -> None:
    true = a_stage(stalk, along)
    pan, tilt = radians(pan), radians(tilt)
    found, geometry = stage_from_special_poses(*special(true, pan, tilt), pan, tilt)
    assert found.rotation == pytest.approx(true.rotation, abs=1e-12)
    assert found.origin == pytest.approx(true.origin, abs=EXACT)
    # Without stalk its length is the root of a difference of squares that nearly cancel: root of rounding.
    assert geometry.stalk == pytest.approx(stalk, abs=EXACT if stalk else 1e-4)
    assert geometry.lengths == pytest.approx([LENGTH] * 3, abs=EXACT)
    assert geometry.offset == pytest.approx(OFFSET, abs=EXACT)
    assert found.axes_gap_mm < EXACT
    assert found.axes_angle_rad == pytest.approx(pi / 2, abs=1e-12)
    if stalk:
        for angles in TABLE_3:
            assert predict_centres(found, *angles) == pytest.approx(predict_centres(true, *angles), abs=EXACT)


@pytest.mark.parametrize("angle", [0.5, -0.5, 2.0, -2.0])
def test_an_axis_and_its_points_lie_on_the_true_axis(angle: float) -> None:
    stage = a_stage()
    home, panned, tilted = special(stage, angle, angle)
    for turned, axis in ((panned, 0), (tilted, 1)):
        direction = turning_axis(home, turned, angle)
        assert direction == pytest.approx(stage.rotation[:, axis], abs=1e-12)
        for sphere in (0, 1):
            off = point_on_axis(home[sphere], turned[sphere], direction, angle) - stage.origin
            assert np.linalg.norm(np.cross(off, direction)) < EXACT


def test_a_sphere_on_the_axis_stays_there() -> None:
    place = np.array([1.0, 2.0, 3.0])
    assert point_on_axis(place, place, np.array([0.0, 0.0, 1.0]), 0.5) == pytest.approx(place)


def test_two_lines_are_nearest_at_the_middle_of_their_gap(rng: np.random.Generator) -> None:
    middle, gap = meeting_point(np.array([5.0, 0, 1]), np.eye(3)[0], np.array([0, -7.0, -1]), np.eye(3)[1])
    assert middle == pytest.approx([0.0, 0.0, 0.0], abs=1e-14)
    assert gap == pytest.approx(2.0)


def test_bar_dimensions_are_those_of_the_bar() -> None:
    home, panned, tilted = special(a_stage(), 0.4, -0.9)
    found = bar_geometry(home, panned, tilted, -0.9)
    assert (found.length, found.offset, found.stalk) == pytest.approx((LENGTH, OFFSET, STALK), abs=EXACT)


@pytest.mark.parametrize("angles", TABLE_3)
def test_the_bar_turns_by_the_angle_of_pan_and_tilt(angles: tuple[float, float]) -> None:
    stage = a_stage()
    home, turned = (np.diff(predict_centres(stage, *a), axis=0)[0] for a in ((0.0, 0.0), angles))
    # Thesis Eq. (2.24): cos kappa = cos pan cos tilt; a few roundings of a cosine.
    assert home @ turned / LENGTH**2 == pytest.approx(cos(angles[0]) * cos(angles[1]), abs=1e-13)


@pytest.mark.parametrize("swap", range(4))
@pytest.mark.parametrize(("pan", "tilt"), [(-45, 45), (22.5, -22.5), (90, 45), (100, -70)])
def test_special_poses_are_numbered_as_at_home(
    swap: int, pan: float, tilt: float, rng: np.random.Generator
) -> None:
    pan, tilt = radians(pan), radians(tilt)
    home, panned, tilted = (
        pose + 0.1 * rng.standard_normal((2, 3)) for pose in special(a_stage(), pan, tilt)
    )
    p, t = label_special_poses(
        home, panned[::-1] if swap & 1 else panned, tilted[::-1] if swap & 2 else tilted, pan, tilt
    )
    assert np.array_equal(p, panned)
    assert np.array_equal(t, tilted)


def test_special_poses_that_cannot_be_numbered_are_refused(rng: np.random.Generator) -> None:
    bar = np.array([[0.0, 0.0, -100.0], [0.0, 0.0, 100.0]])
    stage = Stage(np.eye(3), np.zeros(3), bar, None, 0.0, pi / 2)
    poses = [pose + 0.1 * rng.standard_normal((2, 3)) for pose in special(stage, pi / 2, pi / 2)]
    with pytest.raises(CalibrationFailed, match="cannot be distinguished"):
        label_special_poses(*poses, pi / 2, pi / 2)


@pytest.mark.parametrize(("pan", "tilt"), [(5.0, 45.0), (45.0, -3.0), (180.0, 45.0), (45.0, 175.0)])
def test_angles_that_show_no_axis_are_refused(pan: float, tilt: float) -> None:
    pan, tilt = radians(pan), radians(tilt)
    with pytest.raises(InvalidInput, match="shows its axis badly"):
        stage_from_special_poses(*special(a_stage(), pan, tilt), pan, tilt)


def test_a_bar_that_did_not_move_is_refused() -> None:
    home, _, tilted = special(a_stage(), 0.5, 0.5)
    with pytest.raises(CalibrationFailed, match="parallel"):
        stage_from_special_poses(home, home, tilted, 0.5, 0.5)
    with pytest.raises(CalibrationFailed, match="in place of 90"):
        stage_from_special_poses(home, tilted, tilted, 0.5, 0.5)


def test_special_poses_are_chosen_from_the_table() -> None:
    home, pan, tilt = special_poses(np.array(TABLE_3))
    assert degrees(principal_angle(TABLE_3[home][0])) == TABLE_3[home][1] == 0.0
    assert (round(degrees(TABLE_3[pan][0])), TABLE_3[pan][1]) == (315, 0.0)
    assert (TABLE_3[tilt][0], round(degrees(TABLE_3[tilt][1]))) == (0.0, -45)
    usable = np.ones(len(TABLE_3), dtype=bool)
    usable[pan] = False
    assert round(degrees(TABLE_3[special_poses(np.array(TABLE_3), usable)[1]][0])) == 45


@pytest.mark.parametrize(
    ("angles", "missing"),
    [
        ([(0.5, 0.0), (0.0, 0.5)], "home pose"),
        ([(0.0, 0.0), (0.0, 0.5), (0.5, 0.5), (0.1, 0.0)], "pan pose"),
        ([(0.0, 0.0), (0.5, 0.0), (0.0, pi)], "tilt pose"),
    ],
)
def test_a_missing_special_pose_is_named(angles: list[tuple[float, float]], missing: str) -> None:
    with pytest.raises(InvalidInput, match=f"there is no {missing}"):
        special_poses(np.array(angles))


def test_the_centre_jacobian_is_the_derivative() -> None:
    stage, step = a_stage(), 1e-5
    jacobian = centre_jacobian(stage, 0.6, -0.4)
    for k in range(12):
        ends = []
        for sign in (-1, 1):
            change = np.zeros(12)
            change[k] = sign * step
            moved = Stage(
                rotation_matrix(change[:3]) @ stage.rotation,
                stage.origin + change[3:6],
                stage.bar + change[6:].reshape(2, 3),
                None,
                0.0,
                0.0,
            )
            ends.append(predict_centres(moved, 0.6, -0.4))
        # Third derivatives of 130 mm / rad^3 leave 1e-8; rounding of 1e-13 mm over 2e-5 as much.
        assert jacobian[:, :, k] == pytest.approx((ends[1] - ends[0]) / (2 * step), abs=5e-8)


def test_refining_finds_the_exact_stage_from_a_rough_one(rng: np.random.Generator) -> None:
    true = a_stage()
    true = Stage(true.rotation, true.origin, true.bar + 3 * rng.standard_normal((2, 3)), None, 0.0, pi / 2)
    centres = seen_in(true, TABLE_3)
    home, pan, tilt = special_poses(np.array(TABLE_3))
    start, _ = stage_from_special_poses(
        centres[home], centres[pan], centres[tilt], TABLE_3[pan][0], TABLE_3[tilt][1]
    )
    # A bar that is not square to its stalk is more than the closed form knows.
    assert np.abs(seen_in(start, TABLE_3) - centres).max() > 0.5
    fit = refine_stage(start, np.array(TABLE_3), centres, isotropic(0.01, len(TABLE_3)))
    assert np.abs(seen_in(fit.stage, TABLE_3) - centres).max() < EXACT
    assert fit.used.all()
    assert fit.rms_mm < EXACT


def test_the_error_of_predictions_is_as_promised(rng: np.random.Generator) -> None:
    true, sigma = a_stage(), 0.05
    angles = [*TABLE_3[::3], (0.0, 0.0)]
    new = (0.6, -0.7)
    exact, draws = seen_in(true, angles), 300
    squared = chi_squares = 0.0
    for _ in range(draws):
        noisy = exact + sigma * rng.standard_normal(exact.shape)
        fit = refine_stage(true, np.array(angles), noisy, isotropic(sigma, len(angles)))
        off = predict_centres(fit.stage, *new) - predict_centres(true, *new)
        covariance = prediction_covariance(fit.stage, *new)
        squared += float(np.einsum("ki,kij,kj", off, np.linalg.inv(covariance), off)) / 6
        chi_squares += fit.reduced_chi_square
    # 6 correlated components: at least 3 independent degrees a draw, so that the mean of chi-square over its
    # degrees has a standard deviation of sqrt(2 / 900) = 0.047; three of them, and the enlargement of
    # covariances by chi-squares above 1, whose mean is 1 + 0.4 sqrt(2 / 48) = 1.08.
    assert 0.92 - 0.14 < squared / draws < 1.0 + 0.14
    # 60 - 12 degrees of freedom a draw: three times sqrt(2 / (300 * 48)) is 0.035.
    assert chi_squares / draws == pytest.approx(1.0, abs=0.04)


def test_swapped_and_strange_centres_are_refused_with_their_reason(rng: np.random.Generator) -> None:
    true, sigma = a_stage(), 0.05
    centres = seen_in(true, TABLE_3) + sigma * rng.standard_normal((len(TABLE_3), 2, 3))
    centres[3] = centres[3, ::-1]
    centres[7, 1] += [0.0, 30.0, 0.0]
    centres[9, 0] = np.nan
    covariances = isotropic(sigma, len(TABLE_3))
    home, pan, tilt = special_poses(np.array(TABLE_3))
    start, _ = stage_from_special_poses(
        centres[home], centres[pan], centres[tilt], TABLE_3[pan][0], TABLE_3[tilt][1]
    )
    fit = refine_stage(start, np.array(TABLE_3), centres, covariances)
    assert np.argwhere(fit.refused["numbered the other way round"]).tolist() == [[3, 0], [3, 1]]
    assert np.argwhere(fit.refused["far from where the stage brings it"]).tolist() == [[7, 1]]
    assert np.count_nonzero(~fit.used) == 4
    assert np.isnan(fit.misfit[9, 0])
    # 46 centres of 0.05 mm in each of three directions, to three standard deviations.
    assert fit.rms_mm == pytest.approx(0.05 * np.sqrt(3), rel=0.25)


@pytest.mark.parametrize("fixed", [0, 1])
def test_poses_that_leave_the_stage_open_are_refused(fixed: int) -> None:
    true = a_stage()
    angles = np.array([[0.1 * k, 0.1 * k] for k in range(8)])
    angles[:, fixed] = 0.3
    centres = seen_in(true, [(p, t) for p, t in angles])
    with pytest.raises(CalibrationFailed, match="open"):
        refine_stage(true, angles, centres, isotropic(0.05, 8))
    with pytest.raises(CalibrationFailed, match="12 parameters"):
        refine_stage(true, angles[:1], centres[:1], isotropic(0.05, 1))


def test_a_stage_without_covariance_promises_nothing() -> None:
    with pytest.raises(InvalidInput, match="no covariance"):
        prediction_covariance(a_stage(), 0.0, 0.0)


def test_a_region_holds_every_pixel_that_sees_the_sphere_and_little_else() -> None:
    camera = Intrinsics(420.0, 430.0, 199.5, 149.5, -0.1, 0.03, 1e-3, -5e-4)
    pose = Pose.looking_at(np.array([50.0, 30.0, -600.0]), np.zeros(3), np.array([0.0, -1.0, 0.1]))
    centres, radius, error = np.array([[-90.0, 60.0, 40.0], [100.0, -50.0, -30.0]]), 20.0, 6.0
    region = sphere_regions(camera, pose, (300, 400), centres, radius, error)
    directions = ray_directions(camera, pose, pixel_grid(300, 400))
    area = 0
    for centre in centres:
        for shift in (np.zeros(3), [error, 0, 0], [0, -error, 0], [0, 0, -error]):
            to = centre + shift - pose.centre()
            along = directions @ to
            seen = to @ to - along**2 < radius**2
            assert not (seen & ~region).any()
        along = directions @ (centre - pose.centre())
        area += np.count_nonzero(np.sum((centre - pose.centre()) ** 2) - along**2 < (radius + error) ** 2)
    # The circle is that of the farthest point of an outline that perspective stretches by 3 % here.
    assert area <= np.count_nonzero(region) < 1.1 * area


def test_a_sphere_out_of_sight_has_no_region() -> None:
    camera, shape = Intrinsics(400.0, 400.0, 49.5, 49.5), (100, 100)
    pose = Pose.looking_at(np.array([0.0, 0.0, -600.0]), np.zeros(3), np.array([0.0, -1.0, 0.0]))
    for centre in ([0.0, 0.0, -900.0], [500.0, 0.0, 0.0], [-500.0, -500.0, 0.0]):
        assert not sphere_regions(camera, pose, shape, np.array([centre]), 10.0, 5.0).any()
    assert sphere_regions(camera, pose, shape, np.array([[0.0, 0.0, -590.0]]), 10.0, 5.0).all()


def test_the_search_margin_is_four_standard_deviations_of_the_worst_direction() -> None:
    covariances = np.stack([np.diag([1.0, 4.0, 9.0]), np.diag([16.0, 1.0, 1.0])])
    assert search_margin_mm(covariances) == pytest.approx(16.0)
