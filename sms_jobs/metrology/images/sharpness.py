"""How wide the spot is that blurs a texture, from its own grey levels."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

BLOCK_PX: Final = 16
"""Side of the blocks whose scatter is looked at: light that changes slowly over the image is none."""
_LEAST_BLOCKS: Final = 8


def texture_width(image: NDArray[Any], where: NDArray[np.bool_], floor: float, slope: float) -> float:
    """Return the width of the finest that a texture shows, in px; NaN where it shows too little.

    Blurred by a spot of the standard deviation s, a texture of the width w has sqrt(w^2 + s^2).

    Parameters
    ----------
    image
        (rows, columns), in grey levels.
    where
        (rows, columns): pixels that show the texture; only blocks of 16 px full of them count.
    floor, slope
        Noise model: variance = floor + slope * grey level.

    Notes
    -----
    White noise that is smoothed by a Gaussian of the standard deviation w has the correlation
    exp(-r^2 / (4 w^2)), so that the squares of its central differences, half the change over 2 px, along both
    axes come to 1 - exp(-1 / w^2) of its variance.
    """
    rows, columns = (n // BLOCK_PX * BLOCK_PX for n in np.subtract(image.shape, 2))
    if not (rows and columns):
        return float("nan")
    level = np.asarray(image, np.float32)
    down, across = 0.5 * (level[2:, 1:-1] - level[:-2, 1:-1]), 0.5 * (level[1:-1, 2:] - level[1:-1, :-2])

    def blocks(values: NDArray[Any]) -> NDArray[Any]:
        cut = values[:rows, :columns]
        return cut.reshape(rows // BLOCK_PX, BLOCK_PX, columns // BLOCK_PX, BLOCK_PX)

    whole = blocks(where[1:-1, 1:-1]).all(axis=(1, 3))
    if np.count_nonzero(whole) < _LEAST_BLOCKS:
        return float("nan")
    inner = blocks(level[1:-1, 1:-1])
    noise = floor + slope * inner.mean(axis=(1, 3))[whole]
    scatter = inner.var(axis=(1, 3))[whole] - noise
    # Half the difference of two pixels, along two axes: what is left of the noise is once its variance.
    change = blocks(down**2 + across**2).mean(axis=(1, 3))[whole] - noise
    part = float(change.mean(dtype=np.float64) / scatter.mean(dtype=np.float64))
    if not (scatter.mean() > noise.mean() and 0.0 < part < 1.0):
        return float("nan")
    return float(np.sqrt(-1.0 / np.log1p(-part)))
