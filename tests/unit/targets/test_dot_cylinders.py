"""Cylinders of dots: which dot is which from every side, and where it is although its image is bent."""

from __future__ import annotations

from dataclasses import replace
from math import cos, pi, radians, sin

import numpy as np
import pytest
from numpy.typing import NDArray
from support.true_boards import TrueBoard, true_board

from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.metrology.geometry.wrapped_sheets import in_space
from sms_jobs.metrology.targets.boards import find_board
from sms_jobs.metrology.targets.drawn_dots import fitted_centres, outline_points
from sms_jobs.metrology.targets.lattice import lattice_places
from sms_jobs.metrology.targets.patterns import BoardPoints, board_points, goes_around, radius_of
from sms_jobs.metrology.targets.perspective import centre_bias, ellipse_matrices, through_homography
from sms_jobs.metrology.targets.wrapped_view import WrappedView, fit_wrapped_view
from sms_jobs.records.artefacts import DotCylinder, Place
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import CameraResponse, Rigid, Scene, Simulation, Vector
from sms_jobs.records.sensors import Rig, Sensor
from sms_jobs.records.views import Role
from sms_jobs.virtual_rig.artefacts import board_points as true_points
from sms_jobs.virtual_rig.rendering import render

Floats = NDArray[np.float64]
PART = DotCylinder(28, 9, 8.0, 4.0, 80.0, ((12, 2), (15, 2), (12, 6)), "ring", 5.6, 2.4)
"""Columns 11.5 degrees apart, 323 degrees around."""
AROUND = replace(PART, columns=31, diameter_mm=31 * 8.0 / pi)


def seen(tube: DotCylinder, turn: Vector = (0.0, 0.0, 0.0), middle: float = 14.0) -> Simulation:
    """Return a camera of 480 px before a cylinder that shows a column in the middle, then turned."""
    pose = Pose.looking_at(np.array([0.0, 0.0, 420.0]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
    camera = Sensor("C1", Role.CAMERA, 480, 480, Intrinsics(1650.0, 1652.0, 243.0, 236.0, k1=-0.1), pose)
    assert tube.markers is not None
    column, row = tube.markers[0]
    upright = Rigid((pi, 0.0, 0.0), (0.0, ((tube.rows - 1) / 2.0 - row) * tube.pitch_mm, 0.0))
    angle = (column - middle) * 2.0 * tube.pitch_mm / tube.diameter_mm
    axis = Rigid((0.0, 0.0, 0.0), (0.0, 0.0, tube.diameter_mm / 2.0))
    scene = Scene(Rig("one", (camera,)), tube, camera=CameraResponse(exposure=0.75), seed=5)
    return Simulation(scene, "C1", None, (upright, axis, Rigid((0.0, angle, 0.0)), Rigid(turn)), "B01")


def found_in(simulation: Simulation, told: DotCylinder, exact: bool = False) -> BoardPoints:
    """Return what is found in the picture; if `exact`, in one without noise."""
    made = render(simulation, FringeSequence())
    return find_board(made.frames.expected(0) if exact else made.texture, told)


def compared(simulation: Simulation, found: BoardPoints) -> tuple[TrueBoard, Floats, Floats]:
    """Return the truth, errors of centres and of ellipses, (n, 2) in px, as the places say."""
    truth = true_board(simulation)
    number = {tuple(p): k for k, p in enumerate(truth.place.tolist())}
    at = [number[tuple(p)] for p in found.place.tolist()]
    assert truth.seen[at].all()
    return truth, found.centre_px - truth.camera_px[at], found.ellipse_px - truth.camera_px[at]


@pytest.mark.parametrize(
    ("tube", "turn", "middle"),
    [
        (PART, (0.0, 0.0, 0.0), 14.0),
        (PART, (0.5, 0.1, 2.4), 13.0),
        # Across the seam: columns 29, 30, 0, 1, ... of 31.
        (replace(AROUND, markers=((1, 2), (4, 2), (1, 6))), (0.3, 0.0, -0.4), 0.0),
    ],
)
def test_dots_are_numbered_and_placed_within_their_deviation(
    tube: DotCylinder, turn: Vector, middle: float
) -> None:
    simulation = seen(tube, turn, middle)
    found = found_in(simulation, tube)
    assert found.reason == ""
    assert found.markers_seen == 3
    _, off, _ = compared(simulation, found)
    # Seven columns are seen at less than 50 degrees, all of whose rows are in the picture.
    assert len(found.place) >= 50
    assert len({tuple(p) for p in found.place.tolist()}) == len(found.place)
    if middle == 0.0:
        assert {29, 30, 0, 1} <= set(found.place[:, 0].tolist())
    z = off / found.sigma_px[:, None]
    # 100 normal numbers and more: 1 / sqrt(200) = 7 %, four of those; covariances of ellipses are not round.
    assert float(np.sqrt(np.mean(z**2))) == pytest.approx(1.0, abs=0.35)
    assert np.abs(z).max() < 5.0


def test_centres_of_bent_ellipses_are_where_dots_are() -> None:
    simulation = seen(PART)
    _, off, ellipses = compared(simulation, found_in(simulation, PART, exact=True))
    # Sub-samples of the virtual rig make 0.001 px of flat boards too, at its blur of 0.5 px.
    assert np.abs(off).max() < 0.005
    assert float(np.sqrt(np.mean(off**2))) < 0.0015
    assert np.abs(ellipses).max() > 0.08


def test_a_mirror_image_and_wrong_rows_are_refused() -> None:
    picture = render(seen(PART), FringeSequence()).texture
    assert "not two that fit the board" in find_board(picture[:, ::-1], PART).reason
    # Of nine rows told as seven, two lie outside: more than a tenth.
    fewer = replace(PART, rows=7)
    assert "correct its columns, its rows" in find_board(picture, fewer).reason


def test_another_group_of_markers_tells_the_part_that_is_seen() -> None:
    own: tuple[Place, ...] = ((2, 2), (5, 2), (2, 6))
    groups = replace(PART, markers=(*own, (14, 2), (16, 2), (14, 5)))
    simulation = seen(groups, middle=14.0)
    found = found_in(simulation, groups)
    assert found.markers_seen == 3
    _, off, _ = compared(simulation, found)
    assert np.abs(off).max() < 0.05
    alike = replace(AROUND, markers=(*own, (14, 2), (17, 2), (14, 6)))
    assert "leaves more than one place" in found_in(seen(alike, middle=15.0), alike).reason


def test_the_sheet_is_where_the_virtual_rig_has_its_dots() -> None:
    for markers in (
        None,
        ((12, 2), (15, 2), (12, 6)),
        ((15, 2), (12, 2), (15, 6)),
        ((12, 6), (15, 6), (12, 2)),
        ((15, 6), (12, 6), (15, 2)),
    ):
        tube = replace(PART, markers=markers)
        place, points = true_points(tube)
        assert in_space(board_points(tube, place), radius_of(tube)) == pytest.approx(points, abs=1e-12)
    assert goes_around(AROUND)
    assert not goes_around(PART)


def exact_view(angle_deg: float = 0.0) -> WrappedView:
    """Return a camera 400 mm from a cylinder of 80 mm, whose sheet it faces at an angle around."""
    turn, radius = radians(angle_deg), 40.0
    rotation = np.array([[cos(turn), 0.0, sin(turn)], [0.0, 1.0, 0.0], [-sin(turn), 0.0, cos(turn)]])
    shift = np.array([0.0, -30.0, 440.0]) - rotation @ np.array([0.0, 0.0, radius])
    camera = np.array([[1600.0, 0.0, 400.0], [0.0, 1600.0, 400.0], [0.0, 0.0, 1.0]])
    matrix = camera @ np.column_stack([rotation, shift])
    return WrappedView(matrix, radius, np.zeros((0, 2)), np.zeros(2), 1.0)


def test_the_view_of_a_cylinder_is_found_from_exact_dots() -> None:
    view = exact_view(20.0)
    column, row = np.meshgrid(np.arange(-4, 5), np.arange(9))
    points = np.stack([8.0 * column.ravel(), 8.0 * row.ravel()], axis=-1).astype(np.float64)
    points = points[view.faces(points)]
    found = fit_wrapped_view(points, view.image(points), 40.0)
    assert found.image(points) == pytest.approx(view.image(points), abs=1e-6)
    step = 1e-4
    sides = step * np.eye(2)
    slopes = [(found.image(points + d) - found.image(points - d)) / (2.0 * step) for d in sides]
    assert np.moveaxis(found.jacobian(points), 2, 0) == pytest.approx(np.array(slopes), abs=1e-5)
    # The same places a turn on are the same dots.
    assert found.image(points + np.array([2.0 * pi * 40.0, 0.0])) == pytest.approx(
        found.image(points), abs=1e-6
    )
    two = points[np.isin(points[:, 0], np.unique(points[:, 0])[:2])]
    with pytest.raises(ValueError, match="three columns"):
        fit_wrapped_view(two, view.image(two), 40.0)


def test_the_far_side_of_a_cylinder_is_not_seen() -> None:
    view = exact_view()
    angle = np.radians([0.0, 40.0, 55.0, 80.0, 120.0, 180.0])
    around = np.stack([40.0 * angle, np.full(6, 30.0)], axis=-1)
    # Seen from 400 mm, incidence is larger by atan(R sin a / (440 - R cos a)): 3.8 degrees at 40.
    assert view.faces(around).tolist() == [True, True, False, False, False, False]


@pytest.mark.parametrize(("columns", "reach_deg"), [(31, 45.0), (62, 63.0)])
def test_the_lattice_is_walked_around_a_cylinder(columns: int, reach_deg: float) -> None:
    pitch = 2.0 * pi * 40.0 / columns
    view = exact_view()
    column, row = np.meshgrid(np.arange(-(columns // 4), columns // 4 + 1), np.arange(round(60.0 / pitch)))
    place = np.stack([column.ravel(), row.ravel()], axis=-1)
    points = pitch * place.astype(np.float64)
    front = np.linalg.det(view.jacobian(points)) > 0.0
    place, points = place[front], points[front]
    matrix = ellipse_matrices(view, points, np.full(len(points), 0.5 * pitch))
    which, found = lattice_places(view.image(points), matrix, 4.0)
    reached = np.abs(points[which, 0]) / 40.0
    assert np.degrees(reached.max()) > reach_deg
    # Right as far as it goes: turned by a quarter at most, it is the same grid.
    told = place[which] - place[which][0]
    seen_as = found - found[0]
    turned = [seen_as @ np.linalg.matrix_power(np.array([[0, -1], [1, 0]]), k) for k in range(4)]
    assert any(np.array_equal(one, told) for one in turned)


def test_a_drawn_dot_of_a_plane_is_off_by_the_pole_of_infinity() -> None:
    homography = np.array([[9.0, 0.4, 40.0], [-0.3, 7.0, 42.0], [0.02, 0.01, 1.0]])
    centre, diameter = np.array([[0.3, -0.2]]), np.array([2.0])
    angle = 2.0 * np.pi * np.arange(outline_points(10.0, 0.6)) / outline_points(10.0, 0.6)
    disc = centre + 0.5 * diameter * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    outline = through_homography(homography, disc)[None]
    matrix = np.diag([1.0 / 8.8, 1.0 / 6.9])[None]
    found = fitted_centres(outline, matrix, 0.6, np.array([2.4]))
    told = through_homography(homography, centre) + centre_bias(homography, centre, diameter)
    # The fit's model of a blurred edge leaves a thousandth of a pixel of a curved one.
    assert found == pytest.approx(told, abs=2e-3)
    assert np.abs(centre_bias(homography, centre, diameter)).max() > 0.05
