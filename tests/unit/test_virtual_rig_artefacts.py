"""Boards and the ball bar before the virtual rig: printed where they belong, seen from the right side."""

from __future__ import annotations

from dataclasses import replace
from math import pi, radians

import numpy as np
import pytest
from scipy import ndimage
from support.true_boards import true_board

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.camera import pixel_grid, project, ray_directions
from sms_jobs.metrology.phase.patterns import phase_gradient
from sms_jobs.records.artefacts import BallBar, Chessboard, CircleBoard
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import (
    CameraResponse,
    Deformation,
    PanTilt,
    Plane,
    Rigid,
    Scene,
    Simulation,
    Surface,
)
from sms_jobs.records.sensors import Rig
from sms_jobs.virtual_rig.artefact_truth import placed_points, true_bar
from sms_jobs.virtual_rig.artefacts import axes_of, bar_centres, board_normals, board_points
from sms_jobs.virtual_rig.campaigns import CAMERA_LENS, PROJECTOR_LENS, aimed
from sms_jobs.virtual_rig.ink import BRIGHT, DARK, disc_share, edge_share
from sms_jobs.virtual_rig.light import SUBSAMPLES, trace
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.sessions import facing_rig
from sms_jobs.virtual_rig.truth import exact_shape
from sms_jobs.virtual_rig.windows import image_windows

CAMERA = aimed("C1", 160, 160, CAMERA_LENS, (-300.0, 150.0, 800.0), 0.03)
PROJECTOR = aimed("P1", 256, 192, PROJECTOR_LENS, (350.0, -50.0, 800.0))
RIG = Rig("rig", (CAMERA, PROJECTOR))
BOARD = CircleBoard(5, 4, 30.0, 18.0, ((1, 1), (3, 1), (1, 3)), "ring", 24.0, 12.0)
CHESSBOARD = Chessboard(5, 4, 30.0)
BAR = BallBar(150.0, 0.01, 20.0, 0.005, stalk_mm=15.0, slide_mm=4.0)
UPRIGHT = facing_rig(BOARD)
TILTED = Rigid((0.3, -0.2, 0.5), (5.0, -4.0, 20.0))
TRIPOD = Rigid((pi / 2.0, 0.0, 0.0), (0.0, -10.0, 0.0))
ABOUT_X = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def simulation(surface: Surface, *deformation: Deformation) -> Simulation:
    clean = CameraResponse(bits=16, full_well=1e12, read_noise=0.0, ambient=0.0)
    return Simulation(Scene(RIG, surface, camera=clean), "C1", "P1", deformation)


def board_coordinates(sim: Simulation, pixels: np.ndarray) -> np.ndarray:
    """Return where rays meet the plane z = 0 of the board's frame, (..., 2), by plain geometry."""
    corner, x_end, y_end = placed_points(sim.scene, sim.deformation, np.eye(4, 3, k=-1)[:3])
    frame = np.stack([x_end - corner, y_end - corner], axis=-1)
    normal = np.cross(frame[:, 0], frame[:, 1])
    rays = ray_directions(CAMERA.intrinsics, CAMERA.pose, pixels)
    centre = CAMERA.pose.centre()
    points = centre + rays * (((corner - centre) @ normal) / (rays @ normal))[..., None]
    return (points - corner) @ frame


def turned(pan: float, tilt: float) -> np.ndarray:
    """Return the turn by the tilt about y, then by the pan about x, (3, 3)."""
    about_x = np.array([[1, 0, 0], [0, np.cos(pan), -np.sin(pan)], [0, np.sin(pan), np.cos(pan)]])
    about_y = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])
    return np.asarray(about_x @ about_y)


def test_pan_and_tilt_turn_about_the_stages_axes() -> None:
    scene, points = simulation(BAR).scene, np.array([[3.0, -4.0, 5.0], [0.0, 0.0, 100.0]])
    for pan, tilt in ((0.4, -0.7), (0.4, 0.0), (0.0, -0.7)):
        moved = placed_points(scene, (PanTilt(pan, tilt), TRIPOD), points)
        expected = points @ turned(pan, tilt).T @ ABOUT_X.T + TRIPOD.translation_mm
        # A few roundings of numbers up to 100.
        np.testing.assert_allclose(moved, expected, atol=1e-13)
    # Thesis Eq. (2.4): the bar at home crossed with the bar panned points along the pan axis.
    home, panned = (placed_points(scene, (PanTilt(pan),), points[1:])[0] for pan in (0.0, 0.4))
    np.testing.assert_allclose(np.cross(home, panned), [1e4 * np.sin(0.4), 0.0, 0.0], atol=1e-10)


def test_the_markers_place_the_axes_of_a_board() -> None:
    places, points = board_points(BOARD)
    at = {tuple(place): point for place, point in zip(places.tolist(), points.tolist(), strict=True)}
    assert at[1, 1] == [0.0, 0.0, 0.0]
    assert at[3, 1] == [60.0, 0.0, 0.0]
    assert at[1, 3] == [0.0, 60.0, 0.0]
    # x right and y down: z = x cross y points into the board.
    assert np.all(board_normals(BOARD) == [0.0, 0.0, -1.0])
    upwards = replace(BOARD, markers=((3, 3), (1, 3), (3, 1)))
    assert (axes_of(upwards).x_right, axes_of(upwards).y_down) == (-1.0, -1.0)
    mirrored = replace(BOARD, markers=((1, 3), (3, 3), (1, 1)))
    assert np.all(board_normals(mirrored) == [0.0, 0.0, 1.0])
    assert board_points(CHESSBOARD)[1][-1].tolist() == [120.0, 90.0, 0.0]
    with pytest.raises(InvalidInput, match="define no axes"):
        board_points(replace(BOARD, markers=((1, 1), (3, 2), (1, 3))))


@pytest.mark.parametrize(
    "markers", [((1, 1), (3, 1), (1, 3)), ((1, 3), (3, 3), (1, 1)), ((3, 1), (1, 1), (3, 3))]
)
def test_columns_run_to_the_right_and_rows_down_in_the_image(
    markers: tuple[tuple[int, int], tuple[int, int], tuple[int, int]],
) -> None:
    board = replace(BOARD, markers=markers)
    # Whichever way z runs, the front is turned to the sensors at +Z, columns along X.
    axes = axes_of(board)
    turn = np.diag([axes.x_right, -axes.y_down, -axes.x_right * axes.y_down])
    angle = {(1, 1): (pi, 0.0, 0.0), (1, -1): (0.0, 0.0, 0.0), (-1, 1): (0.0, 0.0, pi)}
    sim = simulation(board, Rigid(angle[int(axes.x_right), int(axes.y_down)]))
    np.testing.assert_allclose(placed_points(sim.scene, sim.deformation, np.eye(3)), turn, atol=1e-15)
    truth = true_board(sim)
    grid = truth.camera_px.reshape(board.rows, board.columns, 2)
    assert (np.diff(grid[..., 0], axis=1) > 10.0).all()
    assert (np.diff(grid[..., 1], axis=0) > 10.0).all()
    # In the picture too: rings, which are bright in the middle, at the markers and nowhere else.
    ambient = trace(sim).ambient
    middle = np.rint((truth.camera_px + 0.5) * SUBSAMPLES - 0.5).astype(int)
    tone = ambient[middle[:, 1], middle[:, 0]]
    ringed = {tuple(place) for place in truth.place[tone > 0.5].tolist()}
    assert ringed == set(markers)


@pytest.mark.parametrize("deformation", [(UPRIGHT,), (UPRIGHT, TILTED)], ids=["upright", "tilted"])
def test_dots_are_printed_where_they_belong(deformation: tuple[Deformation, ...]) -> None:
    sim = simulation(BOARD, *deformation)
    truth = true_board(sim)
    assert truth.seen.all()
    ink = (BRIGHT - trace(sim).ambient.astype(np.float64)) / (BRIGHT - DARK)
    rows, columns = np.indices(ink.shape)
    pixels = (np.stack([columns, rows], axis=-1) + 0.5) / SUBSAMPLES - 0.5
    on_board = board_coordinates(sim, pixels)
    errors, areas = [], []
    for place, point in zip(truth.place.tolist(), truth.point, strict=True):
        # The image of a disc is not about the image of its centre: integrate it, by polar rings.
        outer, inner = (12.0, 6.0) if tuple(place) in BOARD.markers else (9.0, 0.0)
        expected, area = disc_image(sim, point, outer)
        if inner:
            centre, hole = disc_image(sim, point, inner)
            expected, area = (expected * area - centre * hole) / (area - hole), area - hole
        near = np.linalg.norm(on_board - point[:2], axis=-1) < 14.9
        weight = np.where(near, ink, 0.0)
        centroid = (pixels * weight[..., None]).sum(axis=(0, 1)) / weight.sum()
        errors.append(centroid - expected)
        areas.append(weight.sum() / SUBSAMPLES**2 / area - 1.0)
    # A dot's edge crosses about 60 sub-samples; each puts its ink in its middle instead of at the ink's own
    # centroid, up to a quarter of 0.5 px away, with random sign: 0.07 px x sqrt(60) x 0.3 / 400 = 4e-4 px.
    assert np.abs(errors).max() < 0.001
    assert np.abs(np.mean(errors, axis=0)).max() < 3e-4
    # The midpoint rule errs by 1e-3 in each of 60 of 400 sub-samples, at random: 2e-5.
    assert np.abs(areas).max() < 1e-4


def disc_image(sim: Simulation, centre: np.ndarray, radius: float) -> tuple[np.ndarray, float]:
    """Return centroid and area of a disc's image, in px: its outline, by Green's theorem."""
    t = np.linspace(0.0, 2.0 * pi, 20_000, endpoint=False)
    outline = centre + radius * np.stack([np.cos(t), np.sin(t), 0.0 * t], axis=-1)
    x, y = project(CAMERA.intrinsics, CAMERA.pose, placed_points(sim.scene, sim.deformation, outline)).T
    cross = x * np.roll(y, -1) - np.roll(x, -1) * y
    area = cross.sum() / 2.0
    sums = [((c + np.roll(c, -1)) * cross).sum() / 6.0 for c in (x, y)]
    return np.array(sums) / area, abs(area)


@pytest.mark.parametrize("board", [BOARD, replace(BOARD, ink="bright", marker="larger-dot"), CHESSBOARD])
def test_ink_is_averaged_over_a_sub_sample_as_by_many_rays(board: CircleBoard | Chessboard) -> None:
    sim = simulation(board, facing_rig(BOARD), TILTED)
    ambient = trace(sim).ambient
    window = np.s_[150:174, 146:170]
    rows, columns = np.mgrid[window]
    fine = (np.arange(24) + 0.5) / 24 - 0.5
    steps = np.stack(np.meshgrid(fine, fine), axis=-1)
    pixels = (np.stack([columns, rows], axis=-1)[:, :, None, None] + steps + 0.5) / SUBSAMPLES - 0.5
    x, y = np.moveaxis(board_coordinates(sim, pixels), -1, 0) / board.pitch_mm
    if isinstance(board, Chessboard):
        inside = (x > -1) & (x < board.columns) & (y > -1) & (y < board.rows)
        inked = inside & ((np.floor(x) + np.floor(y)) % 2 == 0)
        tones = BRIGHT, DARK
    else:
        (column, row), *_ = board.markers
        column, row = np.rint(x) + column, np.rint(y) + row
        marked = np.zeros(x.shape, bool)
        for place in board.markers:
            marked |= (column == place[0]) & (row == place[1])
        distance = np.hypot(x - np.rint(x), y - np.rint(y)) * board.pitch_mm
        hole = board.marker_hole_mm / 2.0 if board.marker == "ring" else 0.0
        inked = np.where(marked, (distance < 12.0) & (distance >= hole), distance < 9.0)
        inked &= (column >= 0) & (column < board.columns) & (row >= 0) & (row < board.rows)
        tones = (BRIGHT, DARK) if board.ink == "dark" else (DARK, BRIGHT)
    expected = np.where(inked, tones[1], tones[0]).mean(axis=(2, 3))
    error = ambient[window] - expected
    # 24 x 24 rays err by half a row of them along an edge, 0.75 x 0.5 / 24 = 0.016 at most, and by a tenth
    # of that rms, since most edges cross the rows and most sub-samples have none. Corners of squares are
    # found from 16 x 16 rays.
    assert np.abs(error).max() < 0.02
    assert np.sqrt(np.mean(error**2)) < 0.002
    assert expected.std() > 0.2


def test_shares_are_those_of_many_points(rng: np.random.Generator) -> None:
    u, v = np.meshgrid(*[(np.arange(400) + 0.5) / 400 - 0.5] * 2)
    for _ in range(40):
        ax, ay, bx, by = rng.uniform(-1.0, 1.0, 4)
        a, b = rng.uniform(-4.0, 4.0, 2)
        radius = rng.uniform(0.3, 4.0)
        covered = (a + ax * u + ay * v) ** 2 + (b + bx * u + by * v) ** 2 < radius**2
        # Eight lines: an edge that bends within the footprint errs by (1/8)^2 / 24 of its slope's jump; a
        # disc smaller than the footprint, whose chords end between two lines, by up to a percent.
        assert disc_share(a, b, ax, ay, bx, by, radius) == pytest.approx(covered.mean(), abs=0.012)
        x = rng.uniform(-1.0, 1.0)
        # Points on a straight edge: 1 / 400 at most.
        assert edge_share(x, ax, ay) == pytest.approx((x + ax * u + ay * v < 0.0).mean(), abs=3e-3)


def test_nothing_is_printed_on_the_back_of_a_board() -> None:
    sim = simulation(BOARD, Rigid((0.1, 0.2, 0.0), (-30.0, 0.0, 0.0)))
    assert not true_board(sim).seen.any()
    ambient = trace(sim).ambient
    assert set(np.unique(ambient).tolist()) == {0.0, np.float32(BRIGHT)}
    assert (ambient > 0.0).mean() > 0.3


@pytest.mark.parametrize("angles", [(0.0, 0.0), (0.6, -0.5), (-0.7, 0.7)])
def test_rays_meet_the_spheres_of_the_bar(angles: tuple[float, float]) -> None:
    sim = simulation(BAR, PanTilt(*angles), TRIPOD)
    shape, truth = exact_shape(sim), true_bar(sim)
    placed = bar_centres(BAR) @ turned(*angles).T @ ABOUT_X.T + TRIPOD.translation_mm
    np.testing.assert_allclose(truth.centre, placed, atol=1e-12)
    assert np.linalg.norm(truth.centre[1] - truth.centre[0]) == pytest.approx(150.0, rel=1e-14)
    rows, columns = shape.region.shape
    rays = ray_directions(CAMERA.intrinsics, CAMERA.pose, pixel_grid(rows, columns))
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    to_centre = truth.centre - CAMERA.pose.centre()
    miss = np.stack([np.linalg.norm(np.cross(rays, c), axis=-1) for c in to_centre])
    near = np.argsort(np.linalg.norm(to_centre, axis=1))
    expected = np.zeros((rows, columns), int)
    for index in near[::-1]:  # the nearer one over the farther
        expected[miss[index] < BAR.radius_mm] = index + 1
    np.testing.assert_array_equal(shape.region, expected)
    for number, centre in enumerate(truth.centre, start=1):
        points = shape.xyz[:, shape.region == number].T
        # The far half of a sphere is never seen; rounding is about 1e-13 x 1000 mm, more at the limb.
        np.testing.assert_allclose(np.linalg.norm(points - centre, axis=1), BAR.radius_mm, atol=1e-8)
        facing = ((points - centre) * (CAMERA.pose.centre() - points)).sum(axis=1)
        assert facing.min() > -1e-6
    # Light falls on the hemisphere that faces the projector, but for the other sphere's shadow.
    normals = np.where(shape.seen, shape.normal, 0.0)
    towards = PROJECTOR.pose.centre()[:, None, None] - np.where(shape.seen, shape.xyz, 0.0)
    facing = (normals * towards).sum(axis=0) > 0.0
    assert not (shape.lit & ~facing).any()
    assert shape.lit[shape.seen & facing].mean() > 0.9


def test_spheres_hide_and_shade_each_other() -> None:
    # The bar along the camera's view, then along the projector's.
    for sensor in (CAMERA, PROJECTOR):
        axis = sensor.pose.centre() / np.linalg.norm(sensor.pose.centre())
        turn = np.cross([0.0, 0.0, 1.0], axis)
        angle = np.arccos(axis[2])
        x, y, z = turn / np.linalg.norm(turn) * angle
        short = BallBar(60.0, 0.01, 20.0, 0.005)
        sim = simulation(short, Rigid((float(x), float(y), float(z))))
        shape, truth = exact_shape(sim), true_bar(sim)
        assert truth.seen_px.tolist() == [
            int((shape.lit & (shape.region == number)).sum()) for number in (1, 2)
        ]
        if sensor is CAMERA:
            assert truth.seen_px[0] == 0
            assert not (shape.region == 1).any()
        else:
            assert (shape.region == 1).sum() > 100
            assert truth.seen_px[0] == 0
        assert truth.seen_px[1] > 100


@pytest.mark.parametrize("angles", [(0.0, 0.0), (0.6, -0.5), (-0.78, 0.78)])
def test_windows_hold_all_that_is_seen_and_dark_pixels_keep_their_noise(angles: tuple[float, float]) -> None:
    sim = simulation(BAR, PanTilt(*angles), TRIPOD)
    sim = replace(sim, scene=replace(sim.scene, camera=CameraResponse()))
    windows = image_windows(sim.scene, sim.deformation, "C1")
    inside = np.zeros((160, 160), bool)
    for top, bottom, left, right in windows:
        inside[top + 1 : bottom - 1, left + 1 : right - 1] = True
    seen = exact_shape(sim).region > 0
    assert (inside | ~seen).all()
    assert inside.mean() < 0.35
    ambient = trace(sim).ambient[::SUBSAMPLES, ::SUBSAMPLES]
    assert (ambient[~inside] == 0.0).all()
    # Read noise of 10 electrons is 1.4 grey levels about zero, of which the half above zero is left.
    frame = render(sim, FringeSequence((8,))).frames.frame(0)
    dark = frame[~inside]
    expected = 10.0 * 4095 / 30_000
    # The mean of the positive half of a Gaussian is 0.4 sigma; whole levels add a little.
    assert dark.mean() == pytest.approx(0.4 * expected, rel=0.1)


def test_a_specimen_is_looked_for_in_the_whole_image() -> None:
    for surface in (BOARD, Plane(100.0, 100.0)):
        windows = image_windows(Scene(RIG, surface), (), "C1")
        assert windows.tolist() == [[0, 160, 0, 160]]


def test_truth_is_of_the_artefact_that_stands_there() -> None:
    with pytest.raises(InvalidInput, match="shows no board but a ball-bar"):
        true_board(simulation(BAR))
    with pytest.raises(InvalidInput, match="shows no ball bar but a circle-board"):
        true_bar(simulation(BOARD))
    tilted = simulation(CHESSBOARD, UPRIGHT, Rigid((0.0, radians(80.0), 0.0)))
    truth = true_board(tilted)
    # Turned by 80 degrees it shows the projector its front and the camera its back, or the reverse.
    assert not truth.seen.any()
    expected = project(PROJECTOR.intrinsics, PROJECTOR.pose, truth.world)
    np.testing.assert_array_equal(truth.projector_px, expected)


def test_phases_on_a_sphere_are_those_of_its_points_but_for_the_pixels_size() -> None:
    sim = simulation(replace(BAR, radius_mm=40.0), PanTilt(0.2, 0.1), TRIPOD)
    frames, shape = render(sim, FringeSequence((8,), orientations_rad=(0.0,))).frames, exact_shape(sim)
    level = [frames.frame(k).astype(float) for k in range(4)]
    phase = np.arctan2(level[3] - level[1], level[0] - level[2])
    true_px = project(PROJECTOR.intrinsics, PROJECTOR.pose, np.moveaxis(shape.xyz, 0, -1))
    omega = phase_gradient(true_px, PROJECTOR.columns, PROJECTOR.rows, 0.0)
    error = np.angle(np.exp(1j * (phase - 8 * omega))) / 8
    # Blur and sub-samples have the variance 1/4 + 1/16 px^2: light that changes across the pixel and a phase
    # that is curved shift the mean to first order by
    light = np.gradient(np.log(np.hypot(level[3] - level[1], level[0] - level[2]) + 1e-9))
    slope = np.gradient(omega)
    curved = np.gradient(slope[0], axis=0) + np.gradient(slope[1], axis=1)
    shift = 0.3125 * (slope[0] * light[0] + slope[1] * light[1] + 0.5 * curved)
    rays = ray_directions(CAMERA.intrinsics, CAMERA.pose, pixel_grid(160, 160))
    to_light = PROJECTOR.pose.centre()[:, None, None] - shape.xyz
    to_light /= np.linalg.norm(to_light, axis=0)
    facing = np.minimum(
        -(rays * np.moveaxis(shape.normal, 0, -1)).sum(axis=-1), (to_light * shape.normal).sum(axis=0)
    )
    good = (facing > 0.5) & shape.lit
    inner = np.zeros_like(good)
    for number in (1, 2):  # away from outlines and shadows
        inner |= ndimage.binary_erosion(good & (shape.region == number), iterations=4)
    assert inner.sum() > 1000
    # What is left is of the next order: the spot of 0.56 px over the 6 px in which light and slope change on
    # a sphere of 28 px, squared: 1 %; several times that at the end of what is looked at.
    size = np.sqrt(np.mean(shift[inner] ** 2))
    assert size > 3e-4
    assert np.sqrt(np.mean((error - shift)[inner] ** 2)) < 0.02 * size
    assert np.abs((error - shift)[inner]).max() < 0.06 * size
