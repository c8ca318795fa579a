"""Finds boards of dots, flat or about a cylinder: which dot is which, and the image of each dot's centre."""

from __future__ import annotations

from dataclasses import replace
from math import isinf

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.arrays import Floats, Ints, Ints32, Mask, Singles
from sms_jobs.metrology.targets.circles import Circles, find_circles, refine_circles, semi_axes
from sms_jobs.metrology.targets.lattice import lattice_places
from sms_jobs.metrology.targets.patterns import (
    BoardPoints,
    DotBoard,
    board_points,
    goes_around,
    not_found,
)
from sms_jobs.metrology.targets.perspective import (
    View,
    bend_size,
    bend_terms,
    ellipse_matrices,
    fit_plane_view,
)
from sms_jobs.metrology.targets.unseen import why_unseen
from sms_jobs.metrology.targets.wrapped_view import fit_wrapped_view

_LEAST_DOTS = 6
_LEAST_MARKERS = 2
_FRAME_MARKERS = 3
_MOST_OUTSIDE = 0.1  # part of the dots of a lattice that may lie outside the board: clutter in its order
_AREA_TOLERANCE = 1.4
_SIZE_TOLERANCE = 1.2
"""How many times as wide or as narrow as they are told all dots may be, by the pitch between them."""

_OUTLIER_SIGMAS = 6.0
_LEAST_OUTLIER_PX = 0.1
_CENTRE_ROUNDS = 2  # the view is fitted to centres that it corrects: each round leaves a hundredth
_LIGHT_TERMS = 3  # at least: a slope
_NEAR_PREDICTION = 0.15  # of a pitch


def _plane(board: DotBoard, place: Ints32) -> Floats:
    """Return places as points (n, 2) in mm that run with columns and rows, whatever the markers say."""
    return np.asarray(place, np.float64) * board.pitch_mm


def _view(board: DotBoard, plane: Floats, centre: Floats) -> View:
    """Return how points of a board are seen; raises `ValueError` where they do not tell."""
    if not isinf(board.diameter_mm):
        return fit_wrapped_view(plane, centre, 0.5 * board.diameter_mm)
    try:
        return fit_plane_view(plane, centre)
    except ValueError as error:
        raise ValueError("all dots that were seen are on a line") from error


def _marker_diameter(board: DotBoard) -> float:
    return board.marker_diameter_mm if board.marker_diameter_mm > 0.0 else board.dot_diameter_mm


def _flags(board: DotBoard, circles: Circles, which: Ints, place: Ints32) -> Mask:
    """Return which dots of a lattice look like markers."""
    if board.marker == "ring":
        return np.asarray(circles.ring[which])
    area = 1.0 / np.linalg.det(circles.matrix[which])
    ratio = np.empty(len(which))
    for i, here in enumerate(place):
        near = np.abs(place - here).max(axis=1) <= 2
        ratio[i] = area[i] / np.median(area[near])
    return np.asarray(ratio > _marker_diameter(board) / board.dot_diameter_mm)


def _turned(place: Ints32, quarter: int) -> Ints32:
    """Turn places by quarters of a turn."""
    x, y = place[:, 0], place[:, 1]
    return np.stack([(x, y), (-y, x), (-x, -y), (y, -x)][quarter], axis=-1).astype(np.int32)


def _around(board: DotBoard, place: Ints32) -> Ints32:
    """Return places with columns that go on across the seam of a cylinder."""
    if not goes_around(board):
        return place
    return np.stack([place[:, 0] % board.columns, place[:, 1]], axis=-1).astype(np.int32)


def _inside(board: DotBoard, place: Ints32) -> Mask:
    return np.asarray(((place >= 0) & (place < [board.columns, board.rows])).all(axis=1))


def _by_markers(board: DotBoard, place: Ints32, flagged: Mask) -> tuple[Ints32, int] | str:
    """Return the places on the board, and how many markers fit; or why there is no single answer."""
    assert board.markers is not None
    markers = [tuple(m) for m in board.markers]
    found: dict[tuple[int, int, int], tuple[int, int, Ints32]] = {}
    beyond = 0
    for quarter in range(4):
        turned = _turned(place, quarter)
        for i in np.flatnonzero(flagged):
            for marker in markers:
                shift = np.array(marker, dtype=np.int32) - turned[i]
                key = (quarter, *_around(board, shift[None])[0].tolist())
                if key in found:
                    continue
                moved = _around(board, (turned + shift).astype(np.int32))
                inside = _inside(board, moved)
                is_marker = np.array([tuple(p) in markers for p in moved.tolist()])
                matched = int((is_marker & flagged).sum())
                against = int((is_marker != flagged)[inside].sum())
                if inside.mean() < 1.0 - _MOST_OUTSIDE:
                    if matched >= _FRAME_MARKERS and not against:
                        beyond = int((~inside).sum())
                    continue
                found[key] = (matched, 2 * matched - against - int((~inside).sum()), moved)
    # Two markers can fit by chance, even in a mirror: then nothing may speak against them.
    fitting = (
        f for f in found.values() if f[0] >= _FRAME_MARKERS or (f[0] == _LEAST_MARKERS and f[1] == 2 * f[0])
    )
    likely = sorted(fitting, key=lambda f: -f[1])
    if not likely and beyond:
        return (
            f"all three markers fit, but {beyond} of {len(place)} dots then lie outside the board's "
            f"{board.columns} by {board.rows}: correct its columns, its rows and the places of its markers, "
            "if the image is not a mirror's"
        )
    if not likely:
        return (
            f"{int(flagged.sum())} markers were seen among {len(place)} dots, not two that fit the board: "
            "show the part with the markers, or correct their places and sizes"
        )
    if len(likely) > 1 and likely[1][1] == likely[0][1]:
        return (
            f"{likely[0][0]} of three markers were seen, which leaves more than one place for the board: "
            "show all three"
        )
    return likely[0][2], likely[0][0]


def _by_extent(board: DotBoard, place: Ints32, centre: Floats) -> Ints32 | str:
    """Return the places on a board without markers, all of which must be seen."""
    board_size = (board.columns, board.rows)
    best: tuple[float, Ints32] | None = None
    for quarter in range(4):
        turned = _turned(place, quarter)
        size = turned.max(axis=0) - turned.min(axis=0) + 1
        if tuple(size) != board_size:
            continue
        moved = (turned - turned.min(axis=0)).astype(np.int32)
        # The way of growing columns, in the image.
        centred = moved[:, 0] - moved[:, 0].mean()
        way = centred @ (centre - centre.mean(axis=0))
        right = float(way[0] / (np.hypot(way[0], way[1]) + 1e-12))
        if best is None or right > best[0]:
            best = (right, moved)
    if best is None:
        size = place.max(axis=0) - place.min(axis=0) + 1
        return (
            f"a lattice of {size[0]} by {size[1]} dots was seen, not the board's {board_size[0]} by "
            f"{board_size[1]}; without markers all rows and columns must be in view: show the board whole, "
            "or correct its number of columns and rows"
        )
    return best[1]


def _recover(
    grey: Singles, board: DotBoard, view: View, place: Ints32, threads: int
) -> tuple[Circles, Ints32]:
    """Look for the dots that are missing, where the view says that they are and neighbours surround them."""
    import cv2

    seen = np.zeros((board.rows, board.columns), dtype=np.float32)
    seen[place[:, 1], place[:, 0]] = 1.0
    near = cv2.boxFilter(seen, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    row, column = np.nonzero((near > 2.5) & (seen == 0.0))
    missing = np.stack([column, row], axis=-1).astype(np.int32)
    missing = missing[view.faces(_plane(board, missing))]
    plane = _plane(board, missing)
    at, matrix = view.image(plane), ellipse_matrices(view, plane, _diameters(board, missing))
    kept: list[int] = []
    found = refine_circles(grey, at, matrix, ink=board.ink, threads=threads)
    where = np.empty(len(found.centre), dtype=np.int64)
    for k, centre in enumerate(found.centre):
        where[k] = int(np.argmin(np.hypot(*(at - centre).T)))
        pitch = np.hypot(*view.jacobian(plane[where[k] : where[k] + 1])[0, :, 0]) * board.pitch_mm
        if np.hypot(*(at[where[k]] - centre)) < _NEAR_PREDICTION * pitch:
            kept.append(k)
    return found.chosen(np.array(kept, dtype=np.int64)), missing[where[kept]]


def _diameters(board: DotBoard, place: Ints32) -> Floats:
    """Return the outer diameters (n,) in mm of the dots at places (n, 2)."""
    markers = [] if board.markers is None else [tuple(m) for m in board.markers]
    wide = np.array([tuple(p) in markers for p in place.tolist()], dtype=bool)
    return np.where(wide, _marker_diameter(board), board.dot_diameter_mm)


def _centres(board: DotBoard, circles: Circles, place: Ints32, rounds: int = _CENTRE_ROUNDS) -> Floats:
    """Return the images of the dots' centres (n, 2), which are not those of their ellipses.

    NaN for dots on the far side of a cylinder, or at its rim. Raises `ValueError` as `_view` does.
    """
    # Of a ring the outer ellipse alone: its hole is smaller, hence weaker, and need not be concentric.
    plane, diameters = _plane(board, place), _diameters(board, place)
    blur = float(np.median(circles.blur))
    found = circles.centre if isinf(board.diameter_mm) else circles.centre + _light_shift(circles)
    centre = found
    for _ in range(rounds):
        known = np.isfinite(centre).all(axis=1)
        centre = found - _view(board, plane[known], centre[known]).centre_bias(plane, diameters, blur)
    return centre


def _light_shift(circles: Circles) -> Floats:
    """Return by how much dots are brighter on one side than light that is even has them, (n, 2) in px.

    Blur mixes what has more light with what has less: edges of the reflectance move by s^2 times the relative
    slope of the light, which about a cylinder is steep, towards where it is darker. The brighter of ground
    and ink tells that slope.
    """
    middle = circles.centre.mean(axis=0)
    reach = float(np.abs(circles.centre - middle).max())
    scaled, terms = (circles.centre - middle) / reach, max(bend_size(len(circles.centre)), _LIGHT_TERMS)
    level = np.log(np.maximum(np.maximum(circles.ground, circles.ink), 1.0))
    fit = np.linalg.lstsq(bend_terms(scaled, terms, 0, 0), level, rcond=1e-9)[0]
    slope = [bend_terms(scaled, terms, *by) @ fit / reach for by in ((1, 0), (0, 1))]
    return np.asarray(circles.blur[:, None] ** 2 * np.stack(slope, axis=-1))


def _kept(
    board: DotBoard, circles: Circles, centre: Floats, place: Ints32, view: View, refused: dict[str, int]
) -> Mask:
    """Return which dots are as large as they must be and where they must be; count the others."""
    plane = _plane(board, place)
    expected = np.linalg.det(ellipse_matrices(view, plane, _diameters(board, place)))
    ratio = expected / np.linalg.det(circles.matrix)
    ratio /= np.median(ratio)
    sized = (ratio < _AREA_TOLERANCE) & (ratio > 1.0 / _AREA_TOLERANCE)
    off = np.hypot(*(centre - view.image(plane)).T)
    sigma = np.sqrt(np.trace(circles.covariance, axis1=1, axis2=2) + np.nanmedian(off) ** 2)
    placed = off < np.maximum(_OUTLIER_SIGMAS * sigma, _LEAST_OUTLIER_PX)
    faces = view.faces(plane)
    for reason, count in (
        ("seen too obliquely", ~faces),
        ("not as large as a dot", faces & ~sized),
        ("off the board's lattice", faces & sized & ~placed),
    ):
        if count.any():
            refused[reason] = refused.get(reason, 0) + int(count.sum())
    return np.asarray(faces & sized & placed)


def _larger_than_told(board: DotBoard, circles: Circles, place: Ints32, view: View) -> float:
    """Return how many times as wide as they are told dots are, by the pitch between them."""
    plane = _plane(board, place)
    told, seen = (
        np.prod(semi_axes(matrix)[0], axis=1)
        for matrix in (ellipse_matrices(view, plane, _diameters(board, place)), circles.matrix)
    )
    return float(np.sqrt(np.nanmedian(seen / told)))


def find_board(image: NDArray[np.generic], board: DotBoard, *, threads: int = 1) -> BoardPoints:
    """Find a board of dots in an image, whole or in part, flat or about a cylinder.

    Dots are brought into the order of a lattice; markers tell which place is which. Two markers are enough
    where they leave a single answer. An image is never mirrored: columns run to the right and rows
    downwards as the board is seen from the front. A board without markers must be seen with all its rows
    and columns; its columns then run to the right of the image, as far as that can be (of a square board:
    within 45 degrees). Of a cylinder the dots that face the camera within 50 degrees are kept.

    Parameters
    ----------
    image
        (rows, columns), grey levels of any type.
    board
        What to look for.
    threads
        Number of threads; never changes a result.

    Returns
    -------
    The points, or none of them and the reason.
    """
    grey = np.ascontiguousarray(image, dtype=np.float32)
    found = _find(grey, board, threads)
    if not found.reason:
        return found
    why = why_unseen(grey)
    return replace(found, reason=f"{found.reason}: {why}" if why else found.reason)


def _find(grey: Singles, board: DotBoard, threads: int) -> BoardPoints:
    """Return the points of a board, or the reason that the dots tell."""
    circles = find_circles(grey, ink=board.ink, threads=threads)
    refused = dict(circles.refused)
    which, lattice = lattice_places(
        circles.centre, circles.matrix, 2.0 * board.pitch_mm / board.dot_diameter_mm
    )
    if len(which) < len(circles.centre):
        refused["not on a lattice"] = len(circles.centre) - len(which)
    if len(which) < _LEAST_DOTS:
        return not_found(
            f"{len(which)} of {len(circles.centre)} dots are in a lattice of {board.pitch_mm:g} mm with "
            f"dots of {board.dot_diameter_mm:g} mm, {_LEAST_DOTS} are needed: check lengths and view",
            refused,
        )
    markers_seen = 0
    if board.markers is None:
        answer = _by_extent(board, lattice, circles.centre[which])
        if isinstance(answer, str):
            return not_found(answer, refused)
        place = answer
    else:
        marked = _by_markers(board, lattice, _flags(board, circles, which, lattice))
        if isinstance(marked, str):
            return not_found(marked, refused)
        place, markers_seen = marked
    inside = _inside(board, place)
    if not inside.all():
        refused["outside the board"] = int((~inside).sum())
    return _finished(
        grey, board, circles.chosen(which[inside]), place[inside], markers_seen, refused, threads
    )


def _finished(
    grey: Singles,
    board: DotBoard,
    circles: Circles,
    place: Ints32,
    markers_seen: int,
    refused: dict[str, int],
    threads: int,
) -> BoardPoints:
    """Drop outliers, look for what is missing, correct for perspective, sort."""
    for last in (False, True):
        try:
            # About a cylinder larger dots are off by more, in the measure of what tells outliers.
            centre = circles.centre if isinf(board.diameter_mm) else _centres(board, circles, place, 1)
            known = np.isfinite(centre).all(axis=1)
            view = _view(board, _plane(board, place[known]), centre[known])
        except ValueError as error:
            return not_found(str(error), refused)
        good = np.flatnonzero(_kept(board, circles, centre, place, view, refused))
        if len(good) < _LEAST_DOTS:
            return not_found(
                f"only {len(good)} dots of the board; at least {_LEAST_DOTS} are needed", refused
            )
        circles, place = circles.chosen(good), place[good]
        if not last:
            more, where = _recover(grey, board, view, place, threads)
            circles, place = circles.joined(more), np.concatenate([place, where])
    larger = _larger_than_told(board, circles, place, view)
    if not 1.0 / _SIZE_TOLERANCE < larger < _SIZE_TOLERANCE:
        told, seen = (k * board.dot_diameter_mm / board.pitch_mm for k in (1.0, larger))
        return not_found(
            f"dots are {seen:.2f} of the pitch wide, and by their diameter of {board.dot_diameter_mm:g} mm "
            f"and the pitch of {board.pitch_mm:g} mm they are {told:.2f}: correct either length",
            refused,
        )
    order = np.lexsort((place[:, 0], place[:, 1]))
    circles, place = circles.chosen(order), place[order]
    try:
        centre = _centres(board, circles, place)
    except ValueError as error:
        return not_found(str(error), refused)
    good = np.flatnonzero(np.isfinite(centre).all(axis=1))
    circles, place, covariance = circles.chosen(good), place[good], circles.covariance[good]
    return BoardPoints(
        place=place,
        point=board_points(board, place),
        centre_px=centre[good],
        covariance_px=covariance,
        sigma_px=np.sqrt(0.5 * np.trace(covariance, axis1=1, axis2=2)),
        ellipse_px=circles.centre,
        radius_px=np.sqrt(np.prod(semi_axes(circles.matrix)[0], axis=1)),
        blur_px=float(np.median(circles.blur)),
        markers_seen=markers_seen,
        refused=refused,
    )
