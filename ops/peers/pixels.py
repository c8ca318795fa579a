"""How scripts make images of what they have rendered on a finer raster."""

import numpy as np
from scipy.ndimage import gaussian_filter

FINE = 2
"""Along a pixel: the lens's blur is taken on this raster."""


def pixels(fine, blur):
    """Blur images (n, FINE * rows, FINE * columns) by a deviation in px, and average them over pixels."""
    out = []
    for image in fine:
        blurred = gaussian_filter(image.astype(np.float64), FINE * blur, mode="nearest", truncate=5.0)
        rows, columns = blurred.shape
        out.append(blurred.reshape(rows // FINE, FINE, columns // FINE, FINE).mean(axis=(1, 3)))
    return np.stack(out).astype(np.float32)
