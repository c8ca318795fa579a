"""The printed speckle pattern, a function of the material coordinates.

The material is divided into square cells with one round dark speckle in each, its place in the cell and
its diameter drawn from a hash of cell and seed; neighbours may overlap. The pattern is therefore endless,
needs no memory, and is the same wherever and however often it is looked up.
"""

from __future__ import annotations

from math import ceil, floor, pi, sqrt

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.compilation import inner, uncounted_kernel
from sms_jobs.records.scene import Speckle
from sms_jobs.virtual_rig.ink import edge_share

CELL_DIAMETERS = 1.15
"""Side of a cell in mean speckle diameters: covers about 45 % of the ground with paint."""
SPREAD = 0.2
"""Diameters are spread evenly within this fraction of their mean."""


def packed_speckle(speckle: Speckle | None) -> Floats:
    """Return the pattern as kernels take it: cell side in mm (0: none), dark, bright, seed."""
    if speckle is None:
        return np.array([0.0, 1.0, 1.0, 0.0])
    # Kernels carry the seed as a double, which counts exactly up to 2^53.
    seed = float(speckle.seed % 2**48)
    return np.array([CELL_DIAMETERS * speckle.diameter_mm, speckle.dark, speckle.bright, seed])


@inner
@uncounted_kernel
def scrambled(value: np.uint64) -> np.uint64:
    """Return 64 well-mixed bits of a number (the finaliser of Steele et al. 2014, SplitMix64)."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return value ^ (value >> np.uint64(31))


@inner
@uncounted_kernel
def speckle_of_cell(pattern: Floats, i: int, j: int) -> tuple[float, float, float]:
    """Return centre (a, b) and radius of the speckle in cell (i, j), in mm."""
    bits = scrambled(np.uint64(int(pattern[3])) + np.uint64(0x9E3779B97F4A7C15) * np.uint64(i))
    bits = scrambled(bits + np.uint64(0x9E3779B97F4A7C15) * np.uint64(j))
    unit = 1.0 / 2097152.0  # 2^-21: three numbers from one word
    u = float(bits & np.uint64(0x1FFFFF)) * unit
    v = float((bits >> np.uint64(21)) & np.uint64(0x1FFFFF)) * unit
    w = float((bits >> np.uint64(42)) & np.uint64(0x1FFFFF)) * unit
    radius = 0.5 * pattern[0] / CELL_DIAMETERS * (1.0 + SPREAD * (2.0 * w - 1.0))
    return (i + u) * pattern[0], (j + v) * pattern[0], radius


@inner
@uncounted_kernel
def reflectance(pattern: Floats, a: float, b: float, footprint: float) -> float:
    """Return the diffuse reflectance at (a, b), averaged over about `footprint` mm.

    The share of the square footprint that a speckle covers is exact for a straight edge of any direction,
    with the mean distance that a curved edge is further off. Anything coarser shows: sub-samples that
    depend on where their square lies shift the image by thousandths of a pixel, a different one each state.
    """
    side = pattern[0]
    if side == 0.0:
        return float(pattern[2])
    open_ground = 1.0
    i0, j0 = floor(a / side), floor(b / side)
    half = sqrt(0.5) * footprint  # from the footprint's middle to its corners
    reach = 0.5 * (1.0 + SPREAD) / CELL_DIAMETERS * side + half
    ring = ceil(reach / side)
    for j in range(j0 - ring, j0 + ring + 1):
        for i in range(i0 - ring, i0 + ring + 1):
            x, y, radius = speckle_of_cell(pattern, i, j)
            squared = (a - x) * (a - x) + (b - y) * (b - y)
            if squared < (radius + half) * (radius + half):
                distance = max(sqrt(squared), 1e-9 * side)
                bulge = footprint * footprint / (24.0 * max(distance, 0.5 * footprint))
                beyond = (distance + bulge - radius) / footprint
                covered = edge_share(beyond, abs(a - x) / distance, abs(b - y) / distance)
                # A footprint wider than the speckle is never covered by more than the speckle's area.
                covered = min(covered, pi * radius * radius / (footprint * footprint))
                open_ground *= 1.0 - covered
    return float(pattern[1] + (pattern[2] - pattern[1]) * open_ground)


@uncounted_kernel
def _fill_image(pattern: Floats, pitch: float, left: float, top: float, out: Floats) -> None:
    """Fill an image, whose corner is at (left, top) mm, with the reflectance of squares of `pitch` mm."""
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            out[r, c] = reflectance(pattern, left + (c + 0.5) * pitch, top + (r + 0.5) * pitch, pitch)


def speckle_image(
    speckle: Speckle, rows: int, columns: int, pitch_mm: float, corner_mm: tuple[float, float] = (0.0, 0.0)
) -> Floats:
    """Return the pattern on squares of `pitch_mm`, (rows, columns): reflectance, dark .. bright.

    `corner_mm` is where on the material the top-left square begins, (a, b).
    """
    image = np.empty((rows, columns))
    _fill_image(packed_speckle(speckle), pitch_mm, *corner_mm, image)
    return image
