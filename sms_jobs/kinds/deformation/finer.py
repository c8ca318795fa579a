"""Finer subsets where a displacement bends: matched and verified again, and taken where they are better."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from sms_jobs.kinds.deformation.correlate_parameters import CorrelateParameters, match_settings
from sms_jobs.kinds.deformation.dense_fields import ImageDisplacement, resolution_in_image, spread
from sms_jobs.kinds.deformation.textured_state import TexturedState
from sms_jobs.kinds.point_matches import matches_record
from sms_jobs.metrology.arrays import Floats, Ints, Mask
from sms_jobs.metrology.deformation.fields.displacement import blending_reach
from sms_jobs.metrology.deformation.matching.correlation import (
    CONVERGED,
    NOT_CONVERGED,
    PreparedImages,
    match_points,
)
from sms_jobs.metrology.deformation.matching.finer_subsets import (
    Subsets,
    Verdict,
    better_of,
    ladder,
    worth_trying,
)
from sms_jobs.metrology.deformation.matching.grid import GridMatches, GridSettings, is_sure
from sms_jobs.metrology.deformation.matching.shape_functions import WARP, ShapeOrder
from sms_jobs.metrology.images.masks import widened
from sms_jobs.records.fields import ImageMatches


@dataclass(frozen=True)
class Attempt:
    """Points that were matched by some subsets: their indices (n,) among all points, and the matches."""

    subsets: Subsets
    points: Ints
    grid: GridMatches


@dataclass(frozen=True)
class Choice:
    """A displacement that each pixel has from the subsets that serve it best.

    Attributes
    ----------
    image
        The displacement.
    step
        (rows, columns), which of `tried` a pixel has it from.
    attempts
        The first at all points, the others where somebody wanted them.
    """

    image: ImageDisplacement
    step: NDArray[np.uint8]
    attempts: tuple[Attempt, ...]

    def record(self, labels: NDArray[np.int32], steps: NDArray[np.int32] | None) -> ImageMatches:
        """Return each point's match by the subsets that its pixel has taken; by the first where they failed.

        `labels` and `steps` are those of `matches_record`.
        """
        first = self.attempts[0]
        record = matches_record(first.grid, labels, steps)
        if len(self.attempts) == 1:
            return record
        number = np.zeros(len(record.x), dtype=np.int64)
        for k, one in enumerate(self.attempts[1:], start=1):
            grid = one.grid
            own = (self.step[grid.y, grid.x] == k) & (grid.matches.ending == CONVERGED)
            where, found = one.points[own], matches_record(grid, labels)
            number[where] = k
            for name in ("u", "v", "gradient", "sigma_u", "sigma_v", "score", "iterations"):
                getattr(record, name)[..., where] = getattr(found, name)[..., own]
        radius, order = (
            np.array([getattr(one.subsets, name) for one in self.attempts], dtype=np.int32)
            for name in ("radius", "order")
        )
        return replace(record, subset_radius=radius[number], shape_order=order[number])

    def resolution(self, before: TexturedState, parameters: CorrelateParameters) -> Floats:
        """Return the spatial resolution in px of each pixel, (rows, columns)."""
        each = [
            resolution_in_image(one.grid, before, _with(parameters, one.subsets)) for one in self.attempts
        ]
        return np.array(each)[self.step]


def take_subsets(
    image: ImageDisplacement,
    grid: GridMatches,
    images: PreparedImages,
    before: TexturedState,
    parameters: CorrelateParameters,
    threads: int,
) -> Choice:
    """Return a displacement as it is or, adaptively, from finer subsets where that has a smaller error."""
    first = Subsets(parameters.subset_radius_px, cast(ShapeOrder, parameters.shape_order))
    step = np.zeros(image.value.shape[1:], dtype=np.uint8)
    tried = [Attempt(first, np.arange(len(grid.x)), grid)]
    now = Verdict(image.value, image.variance, image.verified, step)
    noise, correlation = image.noise, image.correlation
    for one in ladder(first)[1:] if parameters.subsets == "adaptive" else ():
        wanted = worth_trying(now)
        finer = _matched(grid, wanted, images, one, parameters, threads)
        if not len(finer.points):
            break
        tried.append(finer)
        found = spread(finer.grid, images, before, _with(parameters, one), threads)
        # Beside what was wanted the blend lacks matches on one side.
        found.value[:, ~wanted] = np.nan
        number = np.full_like(step, len(tried) - 1)
        now = better_of(now, Verdict(found.value, found.variance, found.verified, number), one.radius)
        taken = now.step == number
        noise = np.where(taken, found.noise, noise)
        correlation = np.where(taken, found.correlation, correlation)
    chosen = ImageDisplacement(now.value, now.variance, now.verified, noise, correlation)
    return Choice(chosen, now.step, tuple(tried))


def _with(parameters: CorrelateParameters, subsets: Subsets) -> CorrelateParameters:
    return parameters.model_copy(
        update={"subset_radius_px": subsets.radius, "shape_order": int(subsets.order)}
    )


def _matched(
    grid: GridMatches,
    wanted: Mask,
    images: PreparedImages,
    subsets: Subsets,
    parameters: CorrelateParameters,
    threads: int,
) -> Attempt:
    """Match the points again that have a part in what is wanted, from where they were found."""
    reach = int(np.ceil(blending_reach(subsets.radius, WARP)))
    near = widened(wanted, 2 * reach + 1)
    points = np.flatnonzero(near[grid.y, grid.x] & (grid.matches.ending == CONVERGED))
    x, y = grid.x[points], grid.y[points]
    guess = grid.matches.warp[points]
    guess = np.pad(guess, ((0, 0), (0, WARP - guess.shape[1])))
    settings = match_settings(_with(parameters, subsets), parameters.minimum_subset_part)
    found = match_points(images, x, y, guess, settings, threads)
    limits = GridSettings(minimum_score=parameters.minimum_score, maximum_sigma=parameters.maximum_sigma_px)
    ending = np.where(is_sure(found, limits), CONVERGED, NOT_CONVERGED).astype(np.int32)
    return Attempt(subsets, points, GridMatches(x, y, replace(found, ending=ending)))
