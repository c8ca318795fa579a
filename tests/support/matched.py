"""Displacement of every pixel as subsets find it, for tests of what is done with it."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.deformation.fields.displacement import ImagePoints, blend_matches
from sms_jobs.metrology.deformation.matching.correlation import CONVERGED, MatchSettings, PreparedImages
from sms_jobs.metrology.deformation.matching.grid import GridSettings, match_grid
from sms_jobs.metrology.deformation.matching.seeding import SearchSettings
from sms_jobs.metrology.geometry.planes import in_space, pixels_as_plane


def spread_over_pixels(images: PreparedImages, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Return u and v in px and their variances by noise, (2, rows, columns) each."""
    settings, labels = MatchSettings(radius=radius), images.labels
    found = match_grid(images, images.deformed, settings, GridSettings(), SearchSettings(8, 8))
    sure = found.matches.ending == CONVERGED
    x, y = found.x[sure], found.y[sure]
    points = ImagePoints(x, y, labels[y, x], found.matches.warp[sure], found.matches.sigma[sure])
    found = blend_matches(points, in_space(pixels_as_plane(labels.shape)), labels, radius)
    return found.value, found.variance
