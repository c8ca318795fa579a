"""Boards of dots: which dot is which, from every side, in part, and when there is no single answer."""

from __future__ import annotations

from dataclasses import replace
from math import pi
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sms_jobs.metrology.targets.boards import find_board
from sms_jobs.metrology.targets.lattice import lattice_places
from sms_jobs.metrology.targets.patterns import BoardPoints, board_points
from sms_jobs.records.artefacts import CircleBoard

Floats = NDArray[np.float64]
RINGS = CircleBoard(9, 7, 10.0, 5.0, ((2, 5), (6, 5), (2, 1)), "ring", 5.0, 2.0)
LARGER = CircleBoard(9, 7, 10.0, 4.0, ((1, 1), (6, 1), (1, 5)), "larger-dot", 6.0)
PLAIN = CircleBoard(9, 7, 10.0, 5.0)
NOISE = 3.0


def errors(found: BoardPoints, view: Any, pitch: float = 10.0) -> Floats:
    """Return the errors (n, 2) of the centres in px, as the places say where each dot is."""
    return np.asarray(found.centre_px - view.image(found.place * pitch))


@pytest.mark.parametrize("turn", [0.0, 0.7, pi / 2, 2.5, pi, -1.2])
def test_every_turn_of_a_board_is_recognised(draughtsman: Any, rng: np.random.Generator, turn: float) -> None:
    view = draughtsman.view_of(320, 320, (40.0, 30.0), 2.8, turn=turn, tilt=(0.4, -0.3), k1=-0.1)
    image = draughtsman.draw(view, draughtsman.dots(RINGS), slope=(0.5, 0.3))
    found = find_board(image + rng.normal(0.0, NOISE, image.shape), RINGS)
    assert found.reason == ""
    assert found.markers_seen == 3
    assert len(found.place) == 63
    assert len({tuple(p) for p in found.place.tolist()}) == 63
    z = errors(found, view) / found.sigma_px[:, None]
    # A dot by another's name would be 28 px off. 126 normal numbers: 1 / sqrt(252) = 6 %, four of those, and
    # ellipses' covariances are not round.
    assert float(np.sqrt(np.mean(z**2))) == pytest.approx(1.0, abs=0.3)
    assert np.abs(z).max() < 5.0


@pytest.mark.parametrize(
    ("px_per_mm", "blur", "noise", "tilt", "dark"),
    [
        (1.2, 0.6, 3.0, (0.4, -0.3), 40.0),  # radius of 3 px
        (2.8, 2.5, 3.0, (0.4, -0.3), 40.0),  # out of focus
        (2.8, 0.7, 20.0, (0.4, -0.3), 40.0),  # an eighth of the contrast
        (2.8, 0.7, 3.0, (0.0, 1.2), 40.0),  # 69 degrees
        (2.8, 0.7, 3.0, (0.4, -0.3), 150.0),  # grey ink
    ],
)
def test_hard_views_are_found_and_rightly_judged(
    draughtsman: Any,
    rng: np.random.Generator,
    px_per_mm: float,
    blur: float,
    noise: float,
    tilt: tuple[float, float],
    dark: float,
) -> None:
    view = draughtsman.view_of(320, 320, (40.0, 30.0), px_per_mm, turn=0.5, tilt=tilt)
    image = draughtsman.draw(view, draughtsman.dots(RINGS), blur=blur, dark=dark)
    found = find_board(image + rng.normal(0.0, noise, image.shape), RINGS)
    assert (len(found.place), found.markers_seen) == (63, 3)
    z = errors(found, view) / found.sigma_px[:, None]
    # As in every turn; the covariances of oblique dots are far from round.
    assert float(np.sqrt(np.mean(z**2))) == pytest.approx(1.0, abs=0.35)


def test_larger_dots_are_markers_too(draughtsman: Any) -> None:
    view = draughtsman.view_of(320, 320, (40.0, 30.0), 2.8, turn=2.0, tilt=(0.4, -0.3))
    image = 240.0 - draughtsman.draw(view, draughtsman.dots(LARGER))
    found = find_board(image, replace(LARGER, ink="bright"))
    assert (len(found.place), found.markers_seen) == (63, 3)
    # Without noise: see the test of centres.
    assert np.abs(errors(found, view)).max() < 5e-3


def test_the_board_of_a_session_can_be_looked_for(draughtsman: Any) -> None:
    board = CircleBoard(9, 7, 10.0, 5.0, ((2, 5), (6, 5), (2, 1)), "ring", 5.0, 2.0)
    view = draughtsman.view_of(260, 320, (40.0, 30.0), 2.8)
    found = find_board(draughtsman.draw(view, draughtsman.dots(RINGS)), board)
    assert len(found.place) == 63
    origin = found.place.tolist().index([2, 5])
    np.testing.assert_array_equal(found.point[origin], 0.0)


@pytest.mark.parametrize("told", [{"pitch_mm": 12.5}, {"pitch_mm": 8.0}, {"dot_diameter_mm": 4.0}])
def test_dots_of_another_width_by_their_pitch_are_refused(draughtsman: Any, told: dict[str, float]) -> None:
    view = draughtsman.view_of(320, 320, (40.0, 30.0), 2.8, turn=0.7, tilt=(0.4, -0.3))
    image = draughtsman.draw(view, draughtsman.dots(RINGS))
    found = find_board(image, replace(RINGS, **told))
    assert len(found.place) == 0
    assert "dots are 0.50 of the pitch wide, and by their diameter of" in found.reason
    # What is as wide as printing makes it is taken.
    assert find_board(image, replace(RINGS, pitch_mm=10.8)).reason == ""


@pytest.mark.parametrize("middle", [(30.0, 30.0), (55.0, 40.0), (40.0, 45.0)])
def test_a_part_of_a_board_is_enough(draughtsman: Any, middle: tuple[float, float]) -> None:
    view = draughtsman.view_of(240, 280, middle, 3.6, turn=0.2, tilt=(0.2, 0.3))
    image = draughtsman.draw(view, draughtsman.dots(RINGS))
    found = find_board(image, RINGS)
    assert found.reason == ""
    assert 20 < len(found.place) < 63
    assert np.abs(errors(found, view)).max() < 5e-3
    assert found.refused["at the border of the image"] > 0


def test_a_board_with_more_dots_than_told_is_refused(draughtsman: Any) -> None:
    # The markers alone would fit a mirror image too.
    view = draughtsman.view_of(320, 320, (40.0, 30.0), 2.8, turn=0.7, tilt=(0.4, -0.3))
    image = draughtsman.draw(view, draughtsman.dots(RINGS))
    found = find_board(image, replace(RINGS, columns=7, rows=6))
    assert len(found.place) == 0
    assert "21 of 63 dots then lie outside the board's 7 by 6: correct its columns" in found.reason


@pytest.mark.parametrize(("columns", "rows"), [(8, 7), (9, 6), (10, 7)])
def test_a_board_without_markers_of_another_size_is_refused(
    draughtsman: Any, columns: int, rows: int
) -> None:
    view = draughtsman.view_of(320, 320, (40.0, 30.0), 2.8, turn=0.2)
    image = draughtsman.draw(view, draughtsman.dots(PLAIN))
    found = find_board(image, replace(PLAIN, columns=columns, rows=rows))
    assert len(found.place) == 0
    assert f"dots was seen, not the board's {columns} by {rows}; without markers all rows" in found.reason


def test_gaps_do_not_stop_the_walk(draughtsman: Any, rng: np.random.Generator) -> None:
    all_places = [(c, r) for c in range(9) for r in range(7) if (c, r) not in (RINGS.markers or ())]
    hidden = frozenset(all_places[i] for i in rng.permutation(len(all_places))[:12])
    view = draughtsman.view_of(320, 320, (40.0, 30.0), 2.8, turn=0.7, tilt=(0.4, -0.3))
    found = find_board(draughtsman.draw(view, draughtsman.dots(RINGS, hidden)), RINGS)
    assert {tuple(p) for p in found.place.tolist()}.isdisjoint(hidden)
    assert len(found.place) == 51
    assert np.abs(errors(found, view)).max() < 5e-3


def test_a_dot_that_is_half_hidden_is_left_out(draughtsman: Any) -> None:
    view = draughtsman.view_of(260, 320, (40.0, 30.0), 2.8)
    image = draughtsman.draw(view, draughtsman.dots(RINGS))
    x, y = np.rint(view.image(np.array([[50.0, 30.0]]))[0]).astype(int)
    image[y - 9 : y + 10, x + 2 : x + 12] = 200.0
    found = find_board(image, RINGS)
    assert [5, 3] not in found.place.tolist()
    assert len(found.place) == 62
    assert np.abs(errors(found, view)).max() < 5e-3


def test_two_markers_are_enough_where_the_whole_board_is_seen(draughtsman: Any) -> None:
    # The third marker's dot is missing; the extent of the board leaves one place for the other two.
    view = draughtsman.view_of(260, 320, (40.0, 30.0), 2.8, turn=0.1)
    found = find_board(draughtsman.draw(view, draughtsman.dots(RINGS, frozenset({(2, 1)}))), RINGS)
    assert (len(found.place), found.markers_seen) == (62, 2)
    assert np.abs(errors(found, view)).max() < 5e-3


def test_two_places_for_a_board_are_a_refusal(draughtsman: Any) -> None:
    # Origin and x marker alone, in the middle of the board, look the same from both sides.
    even = replace(RINGS, markers=((2, 3), (6, 3), (2, 1)))
    view = draughtsman.view_of(260, 320, (40.0, 30.0), 2.8)
    found = find_board(draughtsman.draw(view, draughtsman.dots(even, frozenset({(2, 1), (6, 5)}))), even)
    assert len(found.place) == 0
    assert "more than one place" in found.reason


def test_a_mirror_image_is_not_taken_for_the_board(draughtsman: Any) -> None:
    view = draughtsman.view_of(260, 320, (40.0, 30.0), 2.8, turn=0.1)
    found = find_board(draughtsman.draw(view, draughtsman.dots(RINGS))[:, ::-1], RINGS)
    assert len(found.place) == 0
    assert "markers" in found.reason


def test_no_board_is_no_board(draughtsman: Any, rng: np.random.Generator) -> None:
    nothing = find_board(rng.normal(120.0, 3.0, (200, 240)), RINGS)
    assert len(nothing.place) == 0
    assert "0 of 0 dots" in nothing.reason
    view = draughtsman.view_of(260, 320, (40.0, 30.0), 2.8)
    unmarked = find_board(draughtsman.draw(view, draughtsman.dots(PLAIN)), RINGS)
    assert "0 markers" in unmarked.reason


@pytest.mark.parametrize("turn", [0.0, 0.6, -1.3])
def test_a_board_without_markers_is_seen_as_it_lies(draughtsman: Any, turn: float) -> None:
    view = draughtsman.view_of(320, 320, (40.0, 30.0), 2.8, turn=turn, tilt=(0.3, 0.3))
    image = draughtsman.draw(view, draughtsman.dots(PLAIN))
    found = find_board(image, PLAIN)
    assert len(found.place) == 63
    assert np.abs(errors(found, view)).max() < 5e-3
    # Turned by half a turn its columns run to the right again: the other way than the truth says.
    turned = find_board(image[::-1, ::-1], PLAIN)
    np.testing.assert_array_equal(turned.place, found.place)
    np.testing.assert_allclose(turned.centre_px, [319.0, 319.0] - found.centre_px[::-1], atol=1e-3)


def test_a_board_without_markers_must_be_whole(draughtsman: Any) -> None:
    view = draughtsman.view_of(240, 280, (55.0, 40.0), 3.6)
    found = find_board(draughtsman.draw(view, draughtsman.dots(PLAIN)), PLAIN)
    assert len(found.place) == 0
    assert "all rows and columns" in found.reason


def test_the_markers_make_the_frame() -> None:
    place = np.array([[2, 5], [6, 5], [2, 1], [3, 4]], dtype=np.int32)
    # y runs from the origin's marker to the third, here up the board: z then points to who looks at it.
    wanted = [[0.0, 0.0, 0.0], [40.0, 0.0, 0.0], [0.0, 40.0, 0.0], [10.0, 10.0, 0.0]]
    np.testing.assert_array_equal(board_points(RINGS, place), wanted)
    np.testing.assert_array_equal(board_points(PLAIN, place[:1]), [[20.0, 50.0, 0.0]])


def test_a_lattice_among_clutter_is_found(rng: np.random.Generator) -> None:
    row, column = np.indices((6, 8))
    place = np.column_stack([column.ravel(), row.ravel()])
    shear = np.array([[30.0, 4.0], [-6.0, 24.0]])
    centre = np.vstack([place @ shear.T + [50.0, 60.0], rng.uniform(300.0, 600.0, (20, 2))])
    # A dot is an image of a circle: |M x| = 1 with M M = (A A^T)^-1 and A the shear of a radius.
    values, vectors = np.linalg.eigh(np.linalg.inv(shear @ shear.T * 0.2**2))
    matrix = np.broadcast_to((vectors * np.sqrt(values)) @ vectors.T, (len(centre), 2, 2))
    order = rng.permutation(len(centre))
    which, found = lattice_places(centre[order], matrix, 5.0)
    assert sorted(order[which].tolist()) == list(range(48))
    truth = place[order[which]]
    # An arbitrary origin and quarter of a turn, and no mirror: one rotation maps all.
    steps = np.linalg.lstsq(truth - truth.mean(axis=0), found - found.mean(axis=0))[0]
    np.testing.assert_allclose(np.linalg.det(steps), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(steps).sum(axis=0), 1.0, atol=1e-9)
