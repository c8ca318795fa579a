"""Views of a surface: texture and shape at rest, displacement and strain of a deformed state."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.formats.report.view import Field, Sampler, Statistic, View
from sms_jobs.metrology.geometry.planes import covariance_in_space, in_space
from sms_jobs.metrology.images.texture_quality import speckle_width
from sms_jobs.records.field_names import (
    DISPLACEMENT_LENGTH,
    DISPLACEMENT_XYZ,
    POSITION_XYZ,
    STRAIN_VALUES,
    TEXTURE,
)
from sms_jobs.records.fields import MergedField, Regions, StrainField, Surface
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.quantity import STRAIN_COMPONENTS, SYMMETRIC, XYZ
from sms_jobs.records.reasons import Reason
from sms_jobs.records.sizes import number_of

MICROSTRAIN = 1e6
PER_CENT = 100.0

_LEAST_IMAGE_PX = 16
_ROWS = 16
_DIAGONAL = [SYMMETRIC.index(name) for name in ("XX", "YY", "ZZ")]


def reference_view(
    view: str, measurement: Measurement, surface: Surface, regions: Regions | None, sampler: Sampler
) -> View:
    """Return texture and shape as a view sees them at the reference state."""
    valid = surface.reason == Reason.VALID
    labels = regions.labels if regions is not None else None
    fields, statistics = _shape(surface, sampler) if surface.has_depth else ([], [])
    if measurement.texture.shape == surface.reason.shape:
        texture = sampler.field(TEXTURE, "count", measurement.texture, still=True)
        fields.append(sampler.outlined(texture, labels))
        statistics += texture_statistics(measurement, valid if labels is None else labels > 0)
    if surface.ray_gap is not None:
        gap = surface.ray_gap
        fields.append(sampler.field("gap between the rays", "mm", gap, grain=_grain(gap)))
        statistics.append(Statistic("gap between the rays, rms", "mm", _rms(gap)))
    fields.append(sampler.reasons("status", surface.reason))
    notes: tuple[str, ...] = ()
    if regions is not None:
        count = len(regions.regions)
        notes = (f"The outlines show {number_of(count, 'continuous piece')} of surface.",)
    notes += _said_of_calibration(surface.has_depth, surface.sigma_calibration)
    return View(
        f"{surface.camera} ({view})" if surface.has_depth else view,
        surface.camera,
        sampler.size,
        sampler.step_px,
        tuple(fields),
        (Statistic("valid", "%", PER_CENT * float(valid.mean())), *statistics),
        POSITION_XYZ if surface.has_depth else None,
        mm_per_px=surface.mm_per_px,
        notes=notes,
    )


_UNKNOWN = (
    "The calibration states no covariance, so what it adds to the standard deviations is not known; it is "
    "not zero."
)
_COMMON = (
    "Beside the standard deviations stands what the calibration adds to them. Its error is common to all "
    "pixels: no mean makes it less, and between near points it all but cancels."
)


def _said_of_calibration(deep: bool, part: NDArray[np.float32] | None) -> tuple[str, ...]:
    """Return what is said of the calibration's part, of what lies in space."""
    return ((_UNKNOWN if part is None else _COMMON),) if deep else ()


def _calibrations_part(part: NDArray[np.float32] | None, unit: str, group: str = "") -> tuple[Statistic, ...]:
    """Return the median of the calibration's part of a vector's sigma, (3, rows, columns); none of None."""
    if part is None:
        return ()
    length = np.sqrt(np.sum(np.square(part, dtype=np.float64), axis=0))
    return (Statistic("sigma from the calibration, median", unit, _median(length), group=group),)


def _shape(surface: Surface, sampler: Sampler) -> tuple[list[Field], list[Statistic]]:
    """Return what is shown of positions in space."""
    deviation: list[NDArray[np.floating] | None] = [None] * len(XYZ)
    statistics = [*_spans(surface.position)]
    if surface.covariance is not None:
        deviation = list(np.sqrt(surface.covariance[_DIAGONAL]))
        statistics.append(
            Statistic("sigma Z, median", "mm", _median(np.sqrt(surface.covariance[_DIAGONAL[2]])))
        )
    if surface.sigma_calibration is not None:
        part = surface.sigma_calibration[2]
        statistics.append(Statistic("sigma Z from the calibration, median", "mm", _median(part)))
    fields = []
    for place, name in reversed(list(enumerate(POSITION_XYZ))):
        shown = name == POSITION_XYZ[2]
        values, sigma = surface.position[place], deviation[place]
        fields.append(sampler.field(name, "mm", values, sigma, still=shown, still_sigma=shown))
    return fields, statistics


def texture_statistics(measurement: Measurement, shown: NDArray[np.bool_]) -> list[Statistic]:
    """Return how good the texture of the pixels (rows, columns) that show the specimen is."""
    texture = measurement.texture.astype(np.float64)
    level = float(texture[shown].mean()) if shown.any() else None
    noise = float(np.sqrt(measurement.read_noise**2 + measurement.gain * (level or 0.0)))
    return [
        Statistic("image", "Mpx", texture.size / 1e6),
        Statistic("mean grey level", "count", level),
        Statistic(
            "scatter of the grey levels", "count", float(texture[shown].std()) if shown.any() else None
        ),
        Statistic("noise there", "count", noise),
        Statistic("speckle, full width at half maximum", "px", speckle_within(texture, shown, noise)),
        Statistic("saturated", "%", PER_CENT * float(np.mean(texture >= measurement.full_scale))),
    ]


def speckle_within(texture: NDArray[np.float64], shown: NDArray[np.bool_], noise: float) -> float | None:
    """Return the width of the speckle; what is not of the specimen gets its mean level."""
    rows, columns = (np.flatnonzero(shown.any(axis=axis)) for axis in (1, 0))
    if rows.size == 0:
        return None
    filled = np.where(shown, texture, texture[shown].mean())
    part = filled[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    if min(part.shape) < _LEAST_IMAGE_PX:
        return None
    width = speckle_width(part, noise)
    return width if np.isfinite(width) else None


def deformed_view(
    merged: MergedField,
    view: str,
    strain: StrainField,
    sampler: Sampler,
    gauges: GaugeReadings | None = None,
) -> View:
    """Return the displacement of a camera's view, and strain and gauge readings of one view."""
    length, length_sigma = displacement_length(merged.displacement, merged.covariance)
    deep = merged.has_depth
    title = f"{merged.camera} (displacement {', '.join(merged.views)}; strain {view})"
    fields = [
        sampler.field(DISPLACEMENT_LENGTH, merged.unit, length, length_sigma, still=True, followed=True),
        *_components(merged, sampler),
        *_strain_fields(strain, sampler),
    ]
    if deep:
        fields += [sampler.field(name, "mm", merged.position[k]) for k, name in enumerate(POSITION_XYZ)]
    if merged.discrepancy is not None and len(merged.views) > 1:
        grain = _grain(length_sigma)
        fields.append(
            sampler.field("disagreement of the views", merged.unit, merged.discrepancy, grain=grain)
        )
    fields += [
        sampler.reasons("status of the displacement", merged.reason),
        sampler.reasons("status of the strain", strain.reason),
    ]
    return View(
        title if deep else merged.camera,
        merged.camera,
        sampler.size,
        sampler.step_px,
        tuple(fields),
        (
            *_displacement_statistics(merged, length, length_sigma),
            *_strain_statistics(strain),
            *gauge_statistics(gauges),
        ),
        POSITION_XYZ if deep else None,
        DISPLACEMENT_XYZ if deep else None,
        mm_per_px=merged.mm_per_px,
        notes=(
            _method(strain, merged.mm_per_px),
            *_said_of_calibration(deep, merged.sigma_calibration),
        ),
    )


def _components(merged: MergedField, sampler: Sampler) -> list[Field]:
    """Return the components of the displacement; printed is that along Z, in a plane both."""
    deviations = np.sqrt(covariance_in_space(sampler.samples(merged.covariance))[_DIAGONAL])
    printed = DISPLACEMENT_XYZ[2:] if merged.has_depth else DISPLACEMENT_XYZ[:2]
    return [
        replace(sampler.field(name, merged.unit, values, still=name in printed), sigma=sigma)
        for name, values, sigma in zip(DISPLACEMENT_XYZ, merged.displacement, deviations, strict=False)
    ]


def _method(strain: StrainField, mm_per_px: float | None) -> str:
    measure = strain.measure.replace("green-lagrange", "Green-Lagrange")
    length = f"{strain.gauge_length:.4g} {strain.unit}"
    if strain.square_px is not None:
        return f"Strain: {measure}, over squares of {strain.square_px} px with a side of {length}."
    if mm_per_px is not None:
        length += f" ({strain.gauge_length / mm_per_px:.4g} px)"
    return f"Strain: {measure}, over a gauge length of {length}."


def displacement_length(
    displacement: NDArray[np.float64], covariance: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the length of a displacement and its standard deviation, along the displacement.

    Of a displacement d with covariance C the length has the variance d' C d / d' d, to first order; where
    nothing moves that has no direction, and the largest that it can be is taken, the trace of C.
    """
    length, sigma = np.empty(displacement.shape[1:]), np.empty(displacement.shape[1:])
    for start in range(0, len(length), _ROWS):  # which fit into the processor's cache
        rows = slice(start, start + _ROWS)
        length[rows], sigma[rows] = _lengths(displacement[:, rows], covariance[:, rows])
    return length, sigma


def _lengths(
    displacement: NDArray[np.float64], covariance: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    d = in_space(displacement)
    c = dict(zip(SYMMETRIC, covariance_in_space(covariance.astype(np.float64)), strict=True))
    squared = np.sum(d**2, axis=0)
    along = (
        c["XX"] * d[0] ** 2
        + c["YY"] * d[1] ** 2
        + c["ZZ"] * d[2] ** 2
        + 2.0 * (c["XY"] * d[0] * d[1] + c["XZ"] * d[0] * d[2] + c["YZ"] * d[1] * d[2])
    )
    trace = c["XX"] + c["YY"] + c["ZZ"]
    known = squared > trace
    variance = np.where(known, np.divide(along, squared, out=np.zeros_like(along), where=known), trace)
    return np.sqrt(squared), np.sqrt(np.maximum(variance, 0.0))


def _strain_fields(field: StrainField, sampler: Sampler) -> list[Field]:
    def micro(
        name: str,
        values: NDArray[np.float64],
        still: bool = False,
        followed: bool = False,
        grain: float = 0.0,
    ) -> Field:
        return sampler.field(
            name, "µε", values, scale=MICROSTRAIN, still=still, followed=followed, grain=grain
        )

    sigma = sampler.samples(field.sigma, MICROSTRAIN)
    strain = sampler.samples(field.strain, MICROSTRAIN).astype(np.float64)
    of_principal = principal_sigma(strain, sigma)
    known = [
        *(micro(name, field.strain[k], still=k == 0) for k, name in enumerate(STRAIN_VALUES)),
        micro("first principal strain", field.principal[0], still=True, followed=True),
        micro("second principal strain", field.principal[1]),
    ]
    deviations = [*sigma, *(each.astype(np.float32) for each in of_principal)]
    return [
        *(replace(each, sigma=deviation) for each, deviation in zip(known, deviations, strict=True)),
        micro("von Mises strain", field.von_mises, grain=_grain(sigma)),
    ]


def principal_sigma(
    strain: NDArray[np.float64], sigma: NDArray[Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the standard deviations of the first and the second principal strain.

    To first order, with the errors of the components xx, yy, xy (3, rows, columns) taken as independent: in
    the direction theta of the first, its derivatives are cos^2, sin^2 and sin 2 theta. Where the circle of
    Mohr is smaller than the errors there is no direction, and the largest that they can be is taken.
    """
    xx, yy, xy = strain
    variance = sigma.astype(np.float64) ** 2
    radius = np.hypot(0.5 * (xx - yy), xy)
    largest = variance.max(axis=0)
    known = radius**2 > largest
    cosine = np.divide(0.5 * (xx - yy), radius, out=np.ones_like(radius), where=known)
    sine = np.divide(xy, radius, out=np.zeros_like(radius), where=known)
    near, far = (0.5 * (1.0 + cosine)) ** 2, (0.5 * (1.0 - cosine)) ** 2
    shear = sine**2 * variance[2]
    first = np.where(known, near * variance[0] + far * variance[1] + shear, largest)
    second = np.where(known, far * variance[0] + near * variance[1] + shear, largest)
    return np.sqrt(first), np.sqrt(second)


def _displacement_statistics(
    merged: MergedField, length: NDArray[np.float64], sigma: NDArray[np.float64]
) -> tuple[Statistic, ...]:
    group = "Displacement"
    known = np.isfinite(length)
    largest = np.unravel_index(int(np.argmax(np.where(known, length, -1.0))), length.shape)
    unit = merged.unit
    most = Statistic("largest displacement", unit, None, group=group)
    if known.any():
        most = Statistic(most.name, unit, float(length[largest]), float(sigma[largest]), group=group)
    return (
        Statistic("valid", "%", PER_CENT * float(np.mean(merged.reason == Reason.VALID)), group=group),
        *(
            Statistic(f"{axis}, median", unit, _median(component), group=group)
            for axis, component in zip(XYZ, merged.displacement, strict=False)
        ),
        most,
        Statistic("sigma of the length, median", unit, _median(sigma), group=group),
        *_calibrations_part(merged.sigma_calibration, unit, group),
        *_resolution(merged, group),
        Statistic("disagreement of the views, rms", unit, _finite(merged.discrepancy_rms), group=group),
    )


def _resolution(field: MergedField | StrainField, group: str) -> tuple[Statistic, ...]:
    """Return the period of a wave of which 90 % is left, where it is known."""
    if field.resolution is None:
        return ()
    return (Statistic("spatial resolution, median", field.unit, _median(field.resolution), group=group),)


def _strain_statistics(field: StrainField) -> tuple[Statistic, ...]:
    group = "Strain"
    return (
        Statistic("valid", "%", PER_CENT * float(np.mean(field.reason == Reason.VALID)), group=group),
        Statistic("gauge length", field.unit, field.gauge_length, group=group),
        *_resolution(field, group),
        *(
            Statistic(f"{name}, median", "µε", _micro(_median(field.strain[k])), group=group)
            for k, name in enumerate(STRAIN_COMPONENTS)
        ),
        Statistic(
            "first principal, 99th percentile",
            "µε",
            _micro(_percentile(field.principal[0], 99.0)),
            group=group,
        ),
        Statistic("sigma xx, median", "µε", _micro(_median(field.sigma[0])), group=group),
        *(
            ()
            if field.bias is None
            else (
                Statistic(
                    "sigma xx from bends within the gauge, 95th percentile",
                    "µε",
                    _micro(_percentile(field.bias[0], 95.0)),
                    group=group,
                ),
            )
        ),
        *(
            ()
            if field.sigma_calibration is None
            else (
                Statistic(
                    "sigma xx from the calibration, median",
                    "µε",
                    _micro(_median(field.sigma_calibration[0])),
                    group=group,
                ),
            )
        ),
    )


def gauge_statistics(gauges: GaugeReadings | None) -> tuple[Statistic, ...]:
    """Return what virtual gauges read, each charted under its name; nothing where none were read."""
    if gauges is None:
        return ()
    group, common = "Virtual gauges", gauges.sigma_calibration
    read = [
        Statistic(
            name,
            "µε",
            _finite(MICROSTRAIN * float(strain)),
            _finite(MICROSTRAIN * float(sigma)),
            charted=True,
            group=group,
        )
        for name, strain, sigma in zip(gauges.names, gauges.strain, gauges.sigma, strict=True)
    ]
    parts = [
        Statistic(
            f"{name}, sigma from the calibration", "µε", _finite(MICROSTRAIN * float(part)), group=group
        )
        for name, part in zip(gauges.names, common if common is not None else (), strict=False)
    ]
    return (*read, *parts)


def _spans(xyz: NDArray[np.float64]) -> tuple[Statistic, ...]:
    found = []
    for axis, values in zip(XYZ, xyz, strict=True):
        low, high = _percentile(values, 0.0), _percentile(values, 100.0)
        span = None if low is None or high is None else high - low
        found.append(Statistic(f"extent {axis}", "mm", span))
    return tuple(found)


def _grain(values: NDArray[Any]) -> float:
    """Return a sixteenth of what a field of spreads is in the middle."""
    return (_median(values) or 0.0) / 16.0


def _micro(value: float | None) -> float | None:
    return None if value is None else MICROSTRAIN * value


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _percentile(values: NDArray[Any], percentile: float) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, percentile, overwrite_input=True)) if known.size else None


def _median(values: NDArray[Any]) -> float | None:
    return _percentile(values, 50.0)


def _rms(values: NDArray[Any]) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known.astype(np.float64) ** 2))) if known.size else None
