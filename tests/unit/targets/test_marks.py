"""A round mark is found by a pixel that lies in it, among speckles."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.targets.marks import mark_at

CENTRE = (141.3, 118.7)


def marked(rng: np.random.Generator, radius: float, noise: float = 2.0) -> np.ndarray:
    """Return speckles, and in them a bright disc with a dark dot, drawn four times as fine."""
    fine = ndimage.gaussian_filter(rng.normal(size=(960, 960)), 8.0)
    image = np.where(fine > 0.0, 180.0, 60.0)
    row, column = (np.mgrid[:960, :960] + 0.5) / 4.0 - 0.5
    away = np.hypot(column - CENTRE[0], row - CENTRE[1])
    image[away < 2.2 * radius] = 210.0
    image[away < radius] = 25.0
    coarse = ndimage.gaussian_filter(image, 3.0).reshape(240, 4, 240, 4).mean(axis=(1, 3))
    return np.clip(coarse + noise * rng.normal(size=coarse.shape), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("radius", [7.0, 15.0])
def test_the_middle_of_a_mark_is_found_from_anywhere_within(rng: np.random.Generator, radius: float) -> None:
    image = marked(rng, radius)
    for dx, dy in ((0.0, 0.0), (0.6, 0.3), (-0.5, -0.5)):
        found = mark_at(image, (CENTRE[0] + dx * radius, CENTRE[1] + dy * radius))
        # The centre of a blurred dot of some contrast 90 over its noise is known to hundredths of a pixel;
        # a tenth covers the speckles at the rim of the bright disc, if that is what was fitted.
        assert np.hypot(found.centre[0] - CENTRE[0], found.centre[1] - CENTRE[1]) < 0.1
        assert found.covariance.shape == (2, 2)
        assert np.sqrt(found.covariance.trace()) < 0.1
        assert radius * 0.9 < found.radius_px < 2.4 * radius


def test_a_pixel_beside_every_mark_is_refused(rng: np.random.Generator) -> None:
    image = marked(rng, 10.0)
    for pixel in ((30.0, 200.0), (-50.0, 10.0)):
        with pytest.raises(InvalidInput, match="is in no round mark"):
            mark_at(image, pixel)
