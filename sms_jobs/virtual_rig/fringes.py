"""Fringes as a camera's sub-samples see them: the light of each times cosine and sine of its phase."""

from __future__ import annotations

from math import pi

import numpy as np

from sms_jobs.metrology.arrays import Floats, Singles
from sms_jobs.metrology.compilation import inlined, inner, uncounted_kernel


@inlined
def cosine_and_sine(turns: float) -> tuple[float, float]:
    """Return cosine and sine of an angle in turns, without branches, so that a loop works on several at once.

    Taylor's series about the nearest quarter of a turn, of which 3e-18 is left out at the most.
    """
    quarters = np.floor(4.0 * turns + 0.5)
    angle = 2.0 * pi * (turns - 0.25 * quarters)
    squared = angle * angle
    cosine = sine = 1.0
    for k in range(9, 0, -1):
        cosine = 1.0 - squared * (1.0 / (2 * k * (2 * k - 1))) * cosine
        sine = 1.0 - squared * (1.0 / (2 * k * (2 * k + 1))) * sine
    sine *= angle
    quarters -= 4.0 * np.floor(0.25 * quarters)
    odd = quarters == 1.0 or quarters == 3.0
    x, y = (sine, cosine) if odd else (cosine, sine)
    return (-x if 0.5 < quarters < 2.5 else x), (-y if quarters > 1.5 else y)


@inner
@uncounted_kernel
def _add_row(
    x: Floats,
    y: Floats,
    strength: Singles,
    turns: Floats,
    n: int,
    share: float,
    cosines: Singles,
    sines: Singles,
) -> None:
    """Add the light of one row of sub-samples to a row of two images, as `add_fringes` does."""
    for j in range(x.shape[0]):
        light = strength[j] * share
        cosine, sine = cosine_and_sine(n * (turns[0] * x[j] + turns[1] * y[j] + turns[2]))
        cosines[j] += light * cosine
        sines[j] += light * sine


@uncounted_kernel
def add_fringes(
    x: Floats,
    y: Floats,
    strength: Singles,
    samples: tuple[int, int, int, int],
    turns: Floats,
    harmonics: Floats,
    out: Singles,
) -> None:
    """Add strength x c_n cos(n phase) and c_n sin(n phase) to the images of a window of sub-samples."""
    top, bottom, left, right = samples
    for r in range(x.shape[0]):
        for i in range(top, bottom):
            first, last = left, right
            while first < last and strength[r, i, first] == 0.0:
                first += 1
            while first < last and strength[r, i, last - 1] == 0.0:
                last -= 1
            xs, ys, light = x[r, i, first:last], y[r, i, first:last], strength[r, i, first:last]
            for n in range(1, harmonics.shape[0]):
                cosines = out[2 * n - 2, i - top, first - left : last - left]
                sines = out[2 * n - 1, i - top, first - left : last - left]
                _add_row(xs, ys, light, turns, n, harmonics[n], cosines, sines)
