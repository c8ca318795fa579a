"""What a camera alone measures of a flat specimen, made up: a surface, its displacement and its strain."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.geometry.planes import pixels_as_plane
from sms_jobs.records.fields import DisplacementField, MergedField, Regions, StrainField, Surface
from sms_jobs.records.quantity import LengthUnit
from sms_jobs.records.reasons import Reason

SIGMA_PX = 0.01


def unit_of(mm_per_px: float | None) -> LengthUnit:
    return "px" if mm_per_px is None else "mm"


def plane(reason: np.ndarray, mm_per_px: float | None = None, view: str = "C1") -> Surface:
    """Return the plane of an image, without the pixels (rows, columns) that have a reason."""
    position = pixels_as_plane(reason.shape, mm_per_px or 1.0)
    position[:, reason != 0] = np.nan
    return Surface(view, unit_of(mm_per_px), position, reason.astype(np.uint32), mm_per_px=mm_per_px)


def moved_in_plane(
    surface: Surface, u: np.ndarray, v: np.ndarray, reason: np.ndarray | None = None
) -> DisplacementField:
    """Return a displacement by u columns and v rows, as `correlate` stores it."""
    why = surface.reason if reason is None else reason.astype(np.uint32)
    image = np.where(why == Reason.VALID, np.stack([u, v]), np.nan)
    size = surface.mm_per_px or 1.0
    variance = np.where(why == Reason.VALID, (size * SIGMA_PX) ** 2, np.nan)
    covariance = np.stack([variance, 0.0 * variance, 4.0 * variance]).astype(np.float32)
    moved = size * image * np.array([1.0, -1.0])[:, None, None]
    return DisplacementField("C1", "00", surface.unit, moved, covariance, image, why, 0.0, 10)


def strain_in_plane(surface: Surface, gauge_length: float = 40.0) -> StrainField:
    """Return the same strain everywhere: -300, 1000 and 200 microstrain."""
    one = np.where(surface.reason == Reason.VALID, 1.0, np.nan)
    return StrainField(
        "small",
        surface.unit,
        gauge_length * (surface.mm_per_px or 1.0),
        np.stack([-3e-4 * one, 1e-3 * one, 2e-4 * one]),
        np.stack([1e-5 * one, 2e-5 * one, 1e-5 * one]).astype(np.float32),
        np.stack([1.03e-3 * one, -3.3e-4 * one]),
        1.2e-3 * one,
        surface.reason,
    )


def one_region(surface: Surface) -> Regions:
    """Return all that is measured as one region."""
    return Regions((), (surface.reason == Reason.VALID).astype(np.int32))


def merged_in_plane(surface: Surface, moved: DisplacementField) -> MergedField:
    """Return what `merge` makes of a camera alone."""
    valid = moved.reason == Reason.VALID
    return MergedField(
        "C1",
        ("C1",),
        surface.unit,
        np.nan,
        moved.displacement,
        np.where(valid, surface.position, np.nan),
        moved.covariance,
        valid.astype(np.uint8),
        moved.reason,
        mm_per_px=surface.mm_per_px,
    )
