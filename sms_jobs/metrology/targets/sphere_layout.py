"""Which spheres of a cloud are those of an artefact, and which of them is which."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.arrays import Floats, Ints

SEPARATION_TOLERANCE = 0.01
"""Of a bar's length; an earlier calibration is better than that."""

_AMBIGUOUS = 0.25  # of the separation: labels are doubtful when the other order is hardly worse


@dataclass(frozen=True)
class Sphere:
    """One sphere of a cloud.

    Attributes
    ----------
    number
        1, 2, ...: which of the artefact's spheres it is.
    centre, covariance
        (3,) in mm and (3, 3) in mm^2, from the noise of its points.
    radius, radius_sigma
        In mm, when the radius is free too: a check of scale and of noise.
    rms, misfit
        Of the residuals along the rays, in mm and in standard deviations.
    coverage
        Part of the cap within the limit of incidence that has points.
    votes
        Points that voted for it.
    pixels
        (n, 2) int32: row and column of the pixels that the centre was fitted to.
    selected
        (m,) which of `pixels` to hand on: evenly spread, at most as many as asked for.
    refused
        Pixels of its surroundings that were left out, by reason.
    off_prediction_mm
        Distance from its predicted centre; NaN without a prediction.
    """

    number: int
    centre: Floats
    covariance: Floats
    radius: float
    radius_sigma: float
    rms: float
    misfit: float
    coverage: float
    votes: int
    pixels: NDArray[np.int32]
    selected: Ints
    refused: dict[str, int]
    off_prediction_mm: float


@dataclass(frozen=True)
class SphereLayout:
    """How many spheres an artefact has, and what is known beforehand of where they are.

    Raises `InvalidInput` for less than one sphere, for a bar that has not two, and for predicted centres of
    another number.

    Attributes
    ----------
    count
        Of the spheres.
    bar_length_mm
        Distance of the centres of a bar's two spheres; tells them from other spheres and is checked. None
        for no bar.
    predicted
        (count, 3) where the centres should be, in mm; spheres are numbered by the least total distance. None
        without a prediction.
    order_along
        Without a prediction spheres are numbered in this direction: by default sphere 2 is that of greater
        X (thesis section 3.3.4).
    """

    count: int = 2
    bar_length_mm: float | None = None
    predicted: Floats | None = None
    order_along: tuple[float, float, float] = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if self.count < 1 or (self.bar_length_mm is not None and self.count != 2):
            raise InvalidInput(f"at least 1 sphere can be sought, and on a bar 2, not {self.count}")
        if self.predicted is not None and np.shape(self.predicted) != (self.count, 3):
            raise InvalidInput(
                f"{self.count} predicted centres have the shape ({self.count}, 3), "
                f"not {np.shape(self.predicted)}"
            )

    def members(self, candidates: Sequence[Sphere]) -> list[Sphere]:
        """Return those that are meant: nearest to the prediction, as far apart as the bar, most points."""
        from scipy.optimize import linear_sum_assignment

        if len(candidates) <= self.count:
            return list(candidates)
        if self.predicted is not None:
            _, members = linear_sum_assignment(_distances(self.predicted, candidates))
            return [candidates[i] for i in members]
        ranked = sorted(candidates, key=lambda sphere: -len(sphere.pixels))
        if self.bar_length_mm is not None:
            for pair in combinations(ranked, 2):
                if self.fits(float(np.linalg.norm(pair[0].centre - pair[1].centre))):
                    return list(pair)
        return ranked[: self.count]

    def fits(self, separation_mm: float) -> bool:
        """Return whether two spheres that far apart may be those of the bar; any two where there is none."""
        if self.bar_length_mm is None:
            return True
        return abs(separation_mm - self.bar_length_mm) <= SEPARATION_TOLERANCE * self.bar_length_mm

    def numbered(self, spheres: Sequence[Sphere]) -> tuple[tuple[Sphere, ...], list[str]]:
        """Return the spheres with their numbers and in their order, and what is doubtful about these."""
        from scipy.optimize import linear_sum_assignment

        if not spheres:
            return (), []
        if self.predicted is None:
            along = np.asarray(self.order_along, dtype=np.float64)
            ordered = sorted(spheres, key=lambda sphere: float(sphere.centre @ along))
            return tuple(replace(sphere, number=i + 1) for i, sphere in enumerate(ordered)), []
        distance = _distances(self.predicted, spheres)
        rows, columns = linear_sum_assignment(distance)
        problems: list[str] = []
        if self.count == 2:
            # How much worse the other numbering would be, against the most that it can be.
            best = float(distance[rows, columns].sum())
            other = float(distance[1 - rows, columns].sum())
            separation = float(np.linalg.norm(self.predicted[1] - self.predicted[0]))
            if other - best < _AMBIGUOUS * separation * len(spheres):
                problems.append(
                    f"the spheres' numbers are doubtful: they are {best:.1f} mm from the predicted centres, "
                    f"and {other:.1f} mm the other way round; check the stage's angles"
                )
        numbered = [
            replace(spheres[c], number=int(r) + 1, off_prediction_mm=float(distance[r, c]))
            for r, c in zip(rows, columns, strict=True)
        ]
        return tuple(numbered), problems


def _distances(predicted: Floats, spheres: Sequence[Sphere]) -> Floats:
    """Return the distance of each sphere (columns) from each predicted centre (rows), in mm."""
    centres = np.array([sphere.centre for sphere in spheres])
    return np.asarray(np.linalg.norm(predicted[:, None] - centres, axis=-1))
