"""Finds dots and rings in grey images, as ellipses with sub-pixel centres and their covariance."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from sms_jobs.metrology.arrays import Floats, Ints, Mask, Singles
from sms_jobs.metrology.targets import ellipse_fit
from sms_jobs.metrology.targets.ellipse_fit import FittedEllipses, fit_ellipses

_WINDOWS = (
    1 / 80,
    1 / 32,
    1 / 13,
    1 / 6,
)  # of the image's longer side; a dot must be smaller than two thirds
_LEAST_SEMI_AXIS_PX = 1.5
_LEAST_AXIS_RATIO = 0.15  # a dot seen at 81 degrees
_LEAST_CONTRAST_OVER_NOISE = 5.0
_MOST_RESIDUAL_OVER_CONTRAST = 0.12  # a square, fitted by an ellipse, leaves twice as much
_RING_FILL = 0.5

_REASONS = {
    ellipse_fit.TOO_FEW_PIXELS: "too small",
    ellipse_fit.AT_THE_BORDER: "at the border of the image",
    ellipse_fit.RAN_AWAY: "no ellipse",
    ellipse_fit.NOT_CONVERGED: "no ellipse",
}


@dataclass(frozen=True)
class Circles:
    """Dots and rings that were found in an image.

    Attributes
    ----------
    centre
        (n, 2), centres of the outer ellipses, in px; not yet the images of the circles' centres.
    covariance
        (n, 2, 2), of the centres, in px squared.
    matrix
        (n, 2, 2), symmetric M of the outer ellipse |M (x - c)| = 1, in 1/px.
    blur
        (n,), standard deviation of the edge's profile, in px.
    ground, ink
        (n,), grey levels about and in the dot.
    residual
        (n,), standard deviation of grey levels from the model.
    ring
        (n,), whether the middle has the ground's grey level rather than the ink's.
    hole_centre, hole_covariance, hole_matrix
        The inner ellipses, as the outer ones; NaN for dots, and for rings whose hole is too small.
    refused
        How many candidates were refused, by reason.
    """

    centre: Floats
    covariance: Floats
    matrix: Floats
    blur: Floats
    ground: Floats
    ink: Floats
    residual: Floats
    ring: Mask
    hole_centre: Floats
    hole_covariance: Floats
    hole_matrix: Floats
    refused: dict[str, int]

    def contrast(self) -> Floats:
        """Return ink minus ground, (n,), in grey levels."""
        return np.asarray(self.ink - self.ground)

    def chosen(self, which: Ints) -> Circles:
        """Return some of the circles, by number."""
        some = {name: getattr(self, name)[which] for name in _ARRAYS}
        return Circles(**some, refused=self.refused)

    def joined(self, others: Circles) -> Circles:
        """Return these circles and others; what was refused is that of these."""
        both = {name: np.concatenate([getattr(self, name), getattr(others, name)]) for name in _ARRAYS}
        return Circles(**both, refused=self.refused)

    def axes(self) -> tuple[Floats, Floats]:
        """Return the semi-axes (n, 2) in px, the longer first, and the longer one's angle (n,) in rad."""
        return semi_axes(self.matrix)


_ARRAYS = tuple(part.name for part in fields(Circles) if part.name != "refused")


def semi_axes(matrix: Floats) -> tuple[Floats, Floats]:
    """Return semi-axes (n, 2) in px, the longer first, and the angle (n,) from x to y of the longer one."""
    values, vectors = np.linalg.eigh(matrix)
    longer = vectors[..., :, 0]
    angle = np.arctan2(longer[..., 1], longer[..., 0])
    return 1.0 / values, (angle + np.pi / 2) % np.pi - np.pi / 2


def noise_of(image: Singles) -> float:
    """Return the standard deviation of an image's noise, in grey levels.

    From the median size of a second difference in both directions, which flat and sloping light leave out
    (Immerkaer 1996, with the median in place of the mean so that edges do not count).
    """
    # Every third row is enough for a median.
    a = image[: image.shape[0] // 3 * 3].reshape(-1, 3, image.shape[1])
    rows = a[:, 0] - 2.0 * a[:, 1] + a[:, 2]
    second = rows[:, :-2:3] - 2.0 * rows[:, 1:-1:3] + rows[:, 2::3]
    return float(np.median(np.abs(second)) / 0.6745 / 6.0)


def _contours(excess: Singles, window: int, noise: float) -> list[NDArray[np.int32]]:
    """Return the outlines of what is more like ink than its surroundings of `window` px."""
    import cv2

    side = (window, window)
    above = excess - cv2.boxFilter(excess, -1, side, borderType=cv2.BORDER_REFLECT)
    spread = cv2.sqrt(cv2.boxFilter(above * above, -1, side, borderType=cv2.BORDER_REFLECT))
    binary = (above > np.maximum(0.5 * spread, 3.0 * noise)).astype(np.uint8)
    # The darkness round a lit board is a frame that the dots lie within: outlines of holes are left out, but
    # not what lies in holes.
    found, tree = cv2.findContours(binary, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    outer = [] if tree is None else [k for k, parent in enumerate(tree[0, :, 3]) if parent < 0]
    return [np.asarray(found[k], dtype=np.int32) for k in outer]


def _starts(contours: list[NDArray[np.int32]], rows: int, columns: int) -> tuple[Floats, dict[str, int]]:
    """Return the outlines that may be ellipses: (n, 6) of centre, m11, m12, m22 and deviation from one."""
    import cv2

    found: list[tuple[float, ...]] = []
    refused = {"at the border of the image": 0, "no ellipse": 0}
    for outline in contours:
        if len(outline) < 8:
            continue
        m = cv2.moments(outline)
        area = m["m00"]
        if area < 6.0:
            continue
        cov = np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / area
        values, vectors = np.linalg.eigh(cov)
        if values[0] <= 0.0 or values[0] < _LEAST_AXIS_RATIO**2 * values[1]:
            continue
        axes = 2.0 * np.sqrt(values)
        if not 0.8 < area / (np.pi * axes[0] * axes[1]) < 1.1:
            continue
        points = outline[:, 0, :]
        low, high = points.min(axis=0), points.max(axis=0)
        if low[0] < 1 or low[1] < 1 or high[0] > columns - 2 or high[1] > rows - 2:
            refused["at the border of the image"] += 1
            continue
        centre = np.array([m["m10"], m["m01"]]) / area
        q = np.hypot(*((points - centre) @ vectors / axes).T)
        deviation = float(q.std())
        # Outlines run through pixel centres, half a pixel inside the edge; stairs spread by 0.3 px.
        if deviation > 0.08 + 0.3 / axes[0]:
            refused["no ellipse"] += 1
            continue
        matrix = (vectors / (axes + 0.5)) @ vectors.T
        found.append((*centre, matrix[0, 0], matrix[0, 1], matrix[1, 1], deviation * axes[0]))
    return np.array(found).reshape(-1, 6), refused


def _distinct(starts: Floats) -> Floats:
    """Keep the roundest of the starts that lie in one another."""
    order = np.argsort(starts[:, 5], kind="stable")
    starts = starts[order]
    if len(starts) < 2:
        return starts
    size = 1.0 / np.sqrt(starts[:, 2] * starts[:, 4] - starts[:, 3] ** 2)
    tree = cKDTree(starts[:, :2])
    alive = np.ones(len(starts), dtype=bool)
    for i, near in enumerate(tree.query_ball_point(starts[:, :2], 0.5 * size)):
        if alive[i]:
            others = np.array([k for k in near if k > i], dtype=np.int64)
            alive[others] = False
    return starts[alive]


def _matrices(starts: Floats) -> Floats:
    return starts[:, [2, 3, 3, 4]].reshape(-1, 2, 2)


def _middle(image: Singles, centre: Floats) -> Floats:
    """Return the grey level at each centre (n, 2), by bilinear interpolation, (n,)."""
    import cv2

    at = centre.astype(np.float32)
    return np.asarray(
        cv2.remap(image, at[:, 0], at[:, 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float64
    ).reshape(-1)


def _holes(image: Singles, fit: FittedEllipses, ring: Mask) -> FittedEllipses:
    """Fit the inner ellipses of rings; starts of 0.35, 0.5 and 0.65 of the outer one, the best one kept."""
    centre, matrix = fit.centre[ring], fit.matrix[ring]
    semi = semi_axes(matrix)[0][:, 1] if len(matrix) else np.empty(0)
    best: FittedEllipses | None = None
    for part in (0.5, 0.35, 0.65):
        reach = 0.5 * semi * (1.0 - part)
        tried = fit_ellipses(image, centre, matrix / part, 0.8 * part * semi, reach)
        if best is None:
            best = tried
            continue
        better = (tried.status == ellipse_fit.FITTED) & (
            (best.status != ellipse_fit.FITTED) | (tried.residual < best.residual)
        )
        best = best.where(better, tried)
    assert best is not None
    return best


def _judged(fit: FittedEllipses, dark: bool, noise: float, refused: dict[str, int]) -> Mask:
    """Return which fits are dots, and count the reasons of the others."""
    good = fit.status == ellipse_fit.FITTED
    for status, reason in _REASONS.items():
        refused[reason] = refused.get(reason, 0) + int((fit.status == status).sum())
    contrast = (fit.ground - fit.ink) if dark else (fit.ink - fit.ground)
    axes = np.full((len(good), 2), np.nan)
    axes[good] = semi_axes(fit.matrix[good])[0]
    with np.errstate(invalid="ignore"):
        tests = {
            "no ellipse": fit.residual < np.maximum(_MOST_RESIDUAL_OVER_CONTRAST * contrast, 3.0 * noise),
            "too little contrast": contrast > _LEAST_CONTRAST_OVER_NOISE * noise,
            "too small": axes[:, 1] > _LEAST_SEMI_AXIS_PX,
            "too oblique": axes[:, 1] > _LEAST_AXIS_RATIO * axes[:, 0],
        }
    for reason, passed in tests.items():
        refused[reason] = refused.get(reason, 0) + int((good & ~passed).sum())
        good &= passed
    return np.asarray(good)


def reach_inside(semi: Floats) -> Floats:
    """Return how far inside of an edge grey levels are taken, (n,) in px, of the shorter semi-axes (n,)."""
    # A ring has ink only near its edge: a third of the semi-axis is less than the thinnest wall of a marker.
    return np.maximum(0.35 * semi, 1.5)


def refine_circles(
    image: Singles,
    centre: Floats,
    matrix: Floats,
    *,
    ink: Literal["dark", "bright"] = "dark",
    threads: int = 1,
) -> Circles:
    """Fit dots and rings to an image from approximate ellipses.

    Parameters
    ----------
    image
        (rows, columns), grey levels.
    centre, matrix
        (n, 2) in px and (n, 2, 2) in 1/px: ellipses |M (x - c)| = 1 that are right to about a pixel.
    ink, threads
        See `find_circles`.

    Returns
    -------
    The circles that could be fitted, and why the others could not.
    """
    refused: dict[str, int] = {}
    noise = noise_of(image)
    semi = semi_axes(matrix)[0][:, 1] if len(matrix) else np.empty(0)
    fit = fit_ellipses(image, centre, matrix, reach_inside(semi), np.full(len(centre), 12.0), threads=threads)
    good = _judged(fit, ink == "dark", noise, refused)
    fit = fit.chosen(good)
    fill = (_middle(image, fit.centre) - fit.ground) / (fit.ink - fit.ground) if good.any() else np.empty(0)
    ring = fill < _RING_FILL
    n = len(ring)
    hole = [np.full((n, 2), np.nan), np.full((n, 2, 2), np.nan), np.full((n, 2, 2), np.nan)]
    if ring.any():
        inner = _holes(image, fit, ring)
        fitted = inner.status == ellipse_fit.FITTED
        at = np.flatnonzero(ring)[fitted]
        for into, found in zip(hole, (inner.centre, inner.covariance, inner.matrix), strict=True):
            into[at] = found[fitted]
    return Circles(
        centre=fit.centre,
        covariance=fit.covariance,
        matrix=fit.matrix,
        blur=fit.blur,
        ground=fit.ground,
        ink=fit.ink,
        residual=fit.residual,
        ring=ring,
        hole_centre=hole[0],
        hole_covariance=hole[1],
        hole_matrix=hole[2],
        refused={reason: count for reason, count in refused.items() if count},
    )


def find_circles(
    image: NDArray[np.generic], *, ink: Literal["dark", "bright"] = "dark", threads: int = 1
) -> Circles:
    """Find every dot and ring in an image.

    Pixels that are more like ink than their surroundings, at four scales, give outlines; those that are
    nearly ellipses are fitted by `fit_ellipses`, and judged by contrast, size and residual.

    Parameters
    ----------
    image
        (rows, columns), grey levels of any type.
    ink
        Whether dots are darker or brighter than the ground.
    threads
        Number of threads; never changes a result.

    Returns
    -------
    The circles in no particular order, and how many candidates were refused and why.
    """
    grey = np.ascontiguousarray(image, dtype=np.float32)
    excess = -grey if ink == "dark" else grey
    noise = noise_of(grey)
    rows, columns = grey.shape
    outlines = []
    for part in _WINDOWS:
        window = max(9, int(part * max(rows, columns)) // 2 * 2 + 1)
        outlines += _contours(excess, window, noise)
    starts, refused = _starts(outlines, rows, columns)
    starts = _distinct(starts)
    found = refine_circles(grey, starts[:, :2], _matrices(starts), ink=ink, threads=threads)
    for reason, count in found.refused.items():
        refused[reason] = refused.get(reason, 0) + count
    found.refused.clear()
    found.refused.update({reason: count for reason, count in refused.items() if count})
    return found
