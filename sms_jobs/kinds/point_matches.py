"""What kinds that match textures have in common: what became of each point, and what is kept of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.metrology.deformation.cracks.splitting import Split
from sms_jobs.metrology.deformation.fields.displacement import ImagePoints
from sms_jobs.metrology.deformation.matching import correlation
from sms_jobs.metrology.deformation.matching.grid import GridMatches
from sms_jobs.metrology.images.masks import narrowed, widened
from sms_jobs.records.fields import ImageMatches
from sms_jobs.records.reasons import Reason
from sms_jobs.records.statistic_names import fraction_of_points

_REASONS = {
    correlation.CONVERGED: Reason.VALID,
    correlation.TOO_FEW_PIXELS: Reason.OUTSIDE_REGION,
    correlation.NO_TEXTURE: Reason.NO_TEXTURE,
    correlation.LEFT_IMAGE: Reason.LEFT_IMAGE,
    correlation.NOT_CONVERGED: Reason.NO_MATCH,
    correlation.AMBIGUOUS: Reason.AMBIGUOUS_TEXTURE,
}
_IN_WORDS = {
    correlation.LEFT_IMAGE: "left the image",
    correlation.NO_TEXTURE: "without texture",
    correlation.NOT_CONVERGED: "without a counterpart",
    correlation.AMBIGUOUS: "on a texture that repeats itself within the search range",
    correlation.TOO_FEW_PIXELS: "with too little of a region about them",
}

_BEYOND_PX = 2
"""How far matches are carried beyond the outermost points: what lies about those is told from one side."""


def summary(ending: NDArray[np.int32], apart: Split | None = None) -> str:
    """Return in a sentence how the matching of points ended, and which regions came apart."""
    count = {ended: int((ending == ended).sum()) for ended in _REASONS}
    text = f"matched {count[correlation.CONVERGED]} of {len(ending)} points"
    others = ", ".join(f"{count[ended]} {why}" for ended, why in _IN_WORDS.items() if count[ended])
    text += f"; {others}" if others else ""
    if apart:
        each = (f"region {number} has come apart into {len(names)}" for number, names in apart.pieces.items())
        text += f"; {', '.join(each)}"
    if len(ending) and not count[correlation.CONVERGED]:
        text += "; look at the texture of both states, and at the search range"
    return text


def trusted_points(grid: GridMatches, labels: NDArray[np.int32]) -> ImagePoints:
    """Return the points that were matched; `labels` (rows, columns) are the regions that they lie on."""
    matched = grid.matches.ending == correlation.CONVERGED
    return ImagePoints(
        grid.x[matched],
        grid.y[matched],
        labels[grid.y[matched], grid.x[matched]],
        np.ascontiguousarray(grid.matches.warp[matched]),
        grid.matches.sigma[matched],
        1.0 / np.fmax(grid.matches.misfit[matched], 1.0),
    )


def matches_record(
    grid: GridMatches, labels: NDArray[np.int32], steps: NDArray[np.int32] | None = None
) -> ImageMatches:
    """Return the matches, NaN where there is a reason; the score is kept, since it may be that reason."""
    found = grid.matches
    reason = np.zeros(len(grid.x), dtype=np.uint32)
    for ending, why in _REASONS.items():
        reason[found.ending == ending] = np.uint32(why)
    warp, sigma = found.warp.T.copy(), found.sigma.T.astype(np.float32)
    warp[:, reason != 0] = np.nan
    sigma[:, reason != 0] = np.nan
    return ImageMatches(
        x=grid.x.astype(np.float64),
        y=grid.y.astype(np.float64),
        region=labels[grid.y, grid.x],
        u=warp[0],
        v=warp[3],
        gradient=warp[[1, 2, 4, 5]],
        sigma_u=sigma[0],
        sigma_v=sigma[1],
        score=found.score.astype(np.float32),
        iterations=found.iterations,
        reason=reason,
        steps=steps,
    )


def match_statistics(matches: ImageMatches) -> dict[str, float]:
    """Return how much was matched, why the rest was not, and how well."""
    matched = matches.reason == Reason.VALID
    statistics = {"matched_fraction": float(matched.sum() / max(len(matched), 1))}
    for reason in sorted(set(_REASONS.values()) - {Reason.VALID}):
        part = float(np.count_nonzero(matches.reason == reason) / max(len(matched), 1))
        statistics[fraction_of_points(reason)] = part
    if matched.any():
        statistics |= {
            "mean_score": float(matches.score[matched].mean()),
            "median_match_sigma_px": float(np.median(np.hypot(matches.sigma_u, matches.sigma_v)[matched])),
        }
    return statistics


def between_matches(found: GridMatches, shape: tuple[int, ...], spacing_px: int) -> NDArray[np.bool_]:
    """Return the pixels nearest to a matched point, (rows, columns), where somebody has looked.

    They lie between matched points or, farther from the image's border than the points from each other, up
    to `_BEYOND_PX` beyond the outermost ones, whose subsets have held them. Where a point near them has
    failed, only those between matched ones are left.
    """
    matched = found.matches.ending == correlation.CONVERGED
    points, failed = (_marked(found, which, shape) for which in (matched, ~matched))
    size = 2 * spacing_px + 1
    nearest = widened(points, spacing_px | 1)
    between = narrowed(widened(points, size), size, border_ends=True)
    inside = narrowed(np.ones(shape, dtype=bool), size, border_ends=True)
    beyond = widened(between, 2 * _BEYOND_PX + 1) & inside & ~widened(failed, size)
    return nearest & (between | beyond)


def _marked(found: GridMatches, which: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return the pixels (rows, columns) at some of the points."""
    marked = np.zeros(shape, dtype=bool)
    marked[found.y[which], found.x[which]] = True
    return marked
