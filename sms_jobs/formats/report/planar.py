"""Views of a flat specimen that one camera sees: its texture at rest, displacement and strain in the image.

In print x points to the right and y up, as in the strain that is stored and in exported files; the stored
displacement along the rows points down and is turned round here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.formats.report.surface import gauge_statistics
from sms_jobs.formats.report.tables import MICROSTRAIN, PER_CENT
from sms_jobs.formats.report.view import Field, Sampler, Statistic, View
from sms_jobs.metrology.images.texture_quality import speckle_width
from sms_jobs.records.fields import ImageMatches
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.planar import PlanarDisplacement, PlanarStrain
from sms_jobs.records.reasons import Reason

_HIGH = 99.0
_GRAIN_MICROSTRAIN = 1.0
_LEAST_IMAGE_PX = 16


def texture_view(
    camera: str, measurement: Measurement, reason: NDArray[np.uint32] | None, sampler: Sampler
) -> View:
    """Return the image of the reference state, with the outline of what of it was measured at first."""
    texture = measurement.texture.astype(np.float64)
    labels = None if reason is None else (reason == Reason.VALID).astype(np.int32)
    shown = texture if labels is None else texture[labels > 0]
    noise = float(np.sqrt(measurement.read_noise**2 + measurement.gain * _mean(shown)))
    fields = [sampler.field("texture", "count", measurement.texture, still=True, outlines=labels)]
    statistics = [
        Statistic("image", "Mpx", texture.size / 1e6),
        Statistic("mean grey level", "count", _mean(shown)),
        Statistic("scatter of the grey levels", "count", float(shown.std()) if shown.size else None),
        Statistic("noise there", "count", noise),
        Statistic("speckle, full width at half maximum", "px", _speckle(texture, labels, noise)),
        Statistic("saturated", "%", PER_CENT * float(np.mean(texture >= measurement.full_scale))),
    ]
    notes: tuple[str, ...] = ()
    if reason is not None:
        fields.append(sampler.reasons("status at the next state", reason))
        notes = ("The outline is that of what was measured at the state after the reference.",)
    return View(camera, camera, sampler.size, sampler.step_px, tuple(fields), tuple(statistics), notes=notes)


def _mean(values: NDArray[np.float64]) -> float:
    return float(values.mean()) if values.size else 0.0


def _speckle(texture: NDArray[np.float64], labels: NDArray[np.int32] | None, noise: float) -> float | None:
    """Return the width of the speckle; what is not of the specimen gets its mean level."""
    part = texture
    if labels is not None:
        valid = labels > 0
        rows, columns = (np.flatnonzero(valid.any(axis=axis)) for axis in (1, 0))
        if rows.size == 0:
            return None
        filled = np.where(valid, texture, texture[valid].mean())
        part = filled[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    if min(part.shape) < _LEAST_IMAGE_PX:
        return None
    width = speckle_width(part, noise)
    return width if np.isfinite(width) else None


def planar_view(
    moved: PlanarDisplacement,
    matches: ImageMatches,
    strain: PlanarStrain,
    sampler: Sampler,
    gauges: GaugeReadings | None = None,
) -> View:
    """Return displacement, strain and gauge readings of a camera's image at a deformed state."""
    scale, unit = (1.0, "px") if moved.mm_per_px is None else (moved.mm_per_px, "mm")
    u, v = scale * moved.displacement[0], -scale * moved.displacement[1]
    sigma_u, sigma_v = scale * moved.sigma[0], scale * moved.sigma[1]
    length = np.hypot(u, v)
    fields = [
        *_strain_fields(strain, sampler),
        sampler.field("displacement x", unit, u, sigma_u, still=True),
        sampler.field("displacement y", unit, v, sigma_v, still=True, still_sigma=True),
        sampler.field("displacement, magnitude", unit, length, np.hypot(sigma_u, sigma_v)),
        sampler.reasons("status of the displacement", moved.reason),
        sampler.reasons("status of the strain", strain.reason),
    ]
    group = "Displacement"
    valid = matches.reason == Reason.VALID
    matched = PER_CENT * float(valid.mean()) if valid.size else None
    statistics = (
        Statistic("points matched", "%", matched, group=group),
        Statistic(
            "displacement valid", "%", PER_CENT * float(np.mean(moved.reason == Reason.VALID)), group=group
        ),
        Statistic("displacement x, median", unit, _percentile(u), group=group),
        Statistic("displacement y, median", unit, _percentile(v), group=group),
        Statistic(
            "displacement, 99th percentile", unit, _percentile(length, _HIGH), charted=True, group=group
        ),
        Statistic("sigma of displacement x, median", unit, _percentile(sigma_u), group=group),
        Statistic("sigma of displacement y, median", unit, _percentile(sigma_v), group=group),
        *_strain_statistics(strain),
        *gauge_statistics(gauges),
    )
    return View(
        moved.camera,
        moved.camera,
        sampler.size,
        sampler.step_px,
        tuple(fields),
        statistics,
        mm_per_px=moved.mm_per_px,
        notes=(_method(moved, matches, strain),),
    )


def _method(moved: PlanarDisplacement, matches: ImageMatches, strain: PlanarStrain) -> str:
    side = 2 * moved.subset_radius_px + 1
    gauge = f"{strain.gauge_length_px:.4g} px"
    if strain.mm_per_px is not None:
        gauge = f"{strain.gauge_length_px * strain.mm_per_px:.4g} mm ({gauge})"
    measure = strain.measure.replace("green-lagrange", "Green-Lagrange")
    return (
        f"Displacement since state {moved.reference_state}, from {len(matches.x)} points with subsets of "
        f"{side} x {side} px. Strain: {measure}, over a gauge length of {gauge}."
    )


def _strain_fields(field: PlanarStrain, sampler: Sampler) -> list[Field]:
    micro, sigma = MICROSTRAIN * field.strain, MICROSTRAIN * field.sigma
    first, second = (_principal_sigma(field, place) for place in (0, 1))
    return [
        sampler.field(
            "first principal strain", "µε", MICROSTRAIN * field.principal[0], first, still=True, followed=True
        ),
        *(
            sampler.field(f"strain {name}", "µε", micro[k], sigma[k], still=True, still_sigma=k == 1)
            for k, name in enumerate(("xx", "yy", "xy"))
        ),
        sampler.field("second principal strain", "µε", MICROSTRAIN * field.principal[1], second),
        sampler.field("von Mises strain", "µε", MICROSTRAIN * field.von_mises, grain=_GRAIN_MICROSTRAIN),
    ]


def _principal_sigma(field: PlanarStrain, place: int) -> NDArray[np.float64]:
    """Return the standard deviation of a principal strain, in microstrain.

    A principal strain e with the direction (c, s) is c^2 xx + s^2 yy + 2 s c xy, and to first order no
    change of the direction changes it; that errors of xx, yy and xy go together is left out.
    """
    xx, yy, xy = field.strain
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy) + place * np.pi / 2.0
    c, s = np.cos(angle), np.sin(angle)
    weighted = (
        (c**2 * field.sigma[0]) ** 2 + (s**2 * field.sigma[1]) ** 2 + (2.0 * s * c * field.sigma[2]) ** 2
    )
    return np.asarray(MICROSTRAIN * np.sqrt(weighted))


def _strain_statistics(field: PlanarStrain) -> tuple[Statistic, ...]:
    medians = [_percentile(MICROSTRAIN * component) for component in field.strain]
    first, second = MICROSTRAIN * field.principal
    group = "Strain"
    return (
        Statistic("strain valid", "%", PER_CENT * float(np.mean(field.reason == Reason.VALID)), group=group),
        *(
            Statistic(f"strain {name}, median", "µε", value, charted=name != "xy", group=group)
            for name, value in zip(("xx", "yy", "xy"), medians, strict=True)
        ),
        Statistic(
            "first principal strain, 99th percentile",
            "µε",
            _percentile(first, _HIGH),
            charted=True,
            group=group,
        ),
        Statistic(
            "second principal strain, 1st percentile", "µε", _percentile(second, 100.0 - _HIGH), group=group
        ),
        Statistic("sigma of strain yy, median", "µε", _percentile(MICROSTRAIN * field.sigma[1]), group=group),
    )


def _percentile(values: NDArray[Any], percentile: float = 50.0) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, percentile)) if known.size else None
