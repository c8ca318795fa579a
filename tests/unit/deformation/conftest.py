"""Speckle whose grey level is known at every real point, so that deformed images are exact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Map = Callable[[Floats, Floats], tuple[Floats, Floats]]


@dataclass(frozen=True)
class Speckle:
    """A sum of Gaussian blobs of standard deviation `width` px on a bright ground."""

    x: Floats
    y: Floats
    height: Floats
    width: float

    @classmethod
    def random(cls, seed: int, size: int, width: float = 1.8, margin: int = 60) -> Speckle:
        rng = np.random.default_rng(seed)
        count = int((size + 2 * margin) ** 2 / (6.0 * width) ** 2 * 4)
        x, y = rng.uniform(-margin, size + margin, (2, count))
        return cls(x, y, rng.uniform(200.0, 600.0, count), width)

    def at(self, x: Floats, y: Floats) -> Floats:
        """Return the grey level at points of any shape."""
        grey = np.full(x.shape, 3000.0)
        reach = 6.0 * self.width  # exp(-18): a hundred-thousandth of a grey level
        for bx, by, h in zip(self.x, self.y, self.height, strict=True):
            if bx < x.min() - reach or bx > x.max() + reach or by < y.min() - reach or by > y.max() + reach:
                continue
            near = (np.abs(x - bx) < reach) & (np.abs(y - by) < reach)
            d2 = (x[near] - bx) ** 2 + (y[near] - by) ** 2
            grey[near] -= h * np.exp(-0.5 * d2 / self.width**2)
        return grey

    def image(self, size: int, source: Map | None = None) -> Floats:
        """Return a square image; `source` gives the reference point (x, y) that each pixel shows."""
        y, x = np.mgrid[0:size, 0:size].astype(np.float64)
        if source is not None:
            x, y = source(x, y)
        return self.at(x, y)


@pytest.fixture(scope="session")
def speckle() -> type[Speckle]:
    return Speckle
