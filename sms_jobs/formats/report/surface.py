"""Views of a surface that fringes measure: shape at rest, displacement and strain of a deformed state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.formats.report.view import Field, Sampler, Statistic, View
from sms_jobs.records.fields import MergedField, PointCloud, Regions, StrainField
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.quantity import SYMMETRIC, XYZ
from sms_jobs.records.reasons import Reason

MICROSTRAIN = 1e6
PER_CENT = 100.0

POSITION = ("position X", "position Y", "position Z")
MOVEMENT = ("displacement X", "displacement Y", "displacement Z")

_DIAGONAL = [SYMMETRIC.index(name) for name in ("XX", "YY", "ZZ")]


def reference_view(
    view: str, measurement: Measurement, cloud: PointCloud, regions: Regions | None, sampler: Sampler
) -> View:
    """Return texture and shape as a view sees them at the reference state."""
    deviation = np.sqrt(cloud.covariance[_DIAGONAL])
    valid = cloud.reason == Reason.VALID
    fields: list[Field] = []
    labels = regions.labels if regions is not None else None
    for place, name in reversed(list(enumerate(POSITION))):
        shown = name == POSITION[2]
        fields.append(
            sampler.field(name, "mm", cloud.xyz[place], deviation[place], still=shown, still_sigma=shown)
        )
    if measurement.texture.shape == cloud.reason.shape:
        fields.append(sampler.field("texture", "count", measurement.texture, still=True, outlines=labels))
    fields.append(sampler.field("gap between the rays", "mm", cloud.ray_gap, grain=_grain(cloud.ray_gap)))
    fields.append(sampler.reasons("status", cloud.reason))
    statistics = (
        Statistic("valid", "%", PER_CENT * float(valid.mean())),
        *_spans(cloud.xyz),
        Statistic("sigma Z, median", "mm", _median(deviation[2])),
        Statistic("gap between the rays, rms", "mm", _rms(cloud.ray_gap)),
    )
    notes: tuple[str, ...] = ()
    if regions is not None:
        count = len(regions.regions)
        notes = (f"The outlines show {count} continuous piece{'s' if count != 1 else ''} of surface.",)
    return View(
        f"{cloud.camera} ({view})",
        cloud.camera,
        sampler.size,
        sampler.step_px,
        tuple(fields),
        statistics,
        POSITION,
        notes=notes,
    )


def deformed_view(
    merged: MergedField,
    view: str,
    strain: StrainField,
    sampler: Sampler,
    gauges: GaugeReadings | None = None,
) -> View:
    """Return the displacement of a camera's view, and strain and gauge readings of one view."""
    components = np.sqrt(merged.covariance[_DIAGONAL])
    length, length_sigma = _length(merged)
    fields = [
        sampler.field("displacement", "mm", length, length_sigma, still=True, followed=True),
        *(
            sampler.field(name, "mm", merged.displacement[k], components[k], still=k == XYZ.index("Z"))
            for k, name in enumerate(MOVEMENT)
        ),
        *_strain_fields(strain, sampler),
        *(sampler.field(name, "mm", merged.xyz[k]) for k, name in enumerate(POSITION)),
    ]
    if merged.discrepancy is not None and len(merged.views) > 1:
        fields.append(
            sampler.field("disagreement of the views", "mm", merged.discrepancy, grain=_grain(length_sigma))
        )
    fields += [
        sampler.reasons("status of the displacement", merged.reason),
        sampler.reasons("status of the strain", strain.reason),
    ]
    return View(
        f"{merged.camera} (displacement {', '.join(merged.views)}; strain {view})",
        merged.camera,
        sampler.size,
        sampler.step_px,
        tuple(fields),
        (
            *_displacement_statistics(merged, length, length_sigma),
            *_strain_statistics(strain),
            *gauge_statistics(gauges),
        ),
        POSITION,
        MOVEMENT,
        notes=(f"Strain: {strain.measure}, over a gauge length of {strain.gauge_length_mm:.4g} mm.",),
    )


def _length(merged: MergedField) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the length of the displacement and its standard deviation, along the displacement.

    Of a displacement d with covariance C the length has the variance d' C d / d' d, to first order; where
    nothing moves that has no direction, and the largest that it can be is taken, the trace of C.
    """
    d = merged.displacement
    c = dict(zip(SYMMETRIC, merged.covariance.astype(np.float64), strict=True))
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
    micro, sigma = MICROSTRAIN * field.strain, MICROSTRAIN * field.sigma
    first, second = MICROSTRAIN * field.principal
    first_sigma, second_sigma = principal_sigma(micro, sigma)
    return [
        *(
            sampler.field(f"strain {name}", "µε", micro[k], sigma[k], still=k == 0)
            for k, name in enumerate(("xx", "yy", "xy"))
        ),
        sampler.field("first principal strain", "µε", first, first_sigma, still=True, followed=True),
        sampler.field("second principal strain", "µε", second, second_sigma),
        sampler.field("von Mises strain", "µε", MICROSTRAIN * field.von_mises, grain=_grain(sigma)),
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
    most = Statistic("largest displacement", "mm", None, group=group)
    if known.any():
        most = Statistic(most.name, "mm", float(length[largest]), float(sigma[largest]), group=group)
    return (
        Statistic("valid", "%", PER_CENT * float(np.mean(merged.reason == Reason.VALID)), group=group),
        *(
            Statistic(f"{axis}, median", "mm", _median(component), group=group)
            for axis, component in zip(XYZ, merged.displacement, strict=True)
        ),
        most,
        Statistic("sigma, median", "mm", _median(sigma), group=group),
        Statistic("disagreement of the views, rms", "mm", _finite(merged.discrepancy_rms_mm), group=group),
    )


def _strain_statistics(field: StrainField) -> tuple[Statistic, ...]:
    group = "Strain"
    return (
        Statistic("valid", "%", PER_CENT * float(np.mean(field.reason == Reason.VALID)), group=group),
        Statistic("gauge length", "mm", field.gauge_length_mm, group=group),
        *(
            Statistic(f"{name}, median", "µε", _median(MICROSTRAIN * field.strain[k]), group=group)
            for k, name in enumerate(("xx", "yy", "xy"))
        ),
        Statistic(
            "first principal, 99th percentile",
            "µε",
            _percentile(MICROSTRAIN * field.principal[0], 99.0),
            group=group,
        ),
        Statistic("sigma xx, median", "µε", _median(MICROSTRAIN * field.sigma[0]), group=group),
    )


def gauge_statistics(gauges: GaugeReadings | None) -> tuple[Statistic, ...]:
    """Return what virtual gauges read, each charted under its name; nothing where none were read."""
    if gauges is None:
        return ()
    return tuple(
        Statistic(
            name,
            "µε",
            _finite(MICROSTRAIN * float(strain)),
            _finite(MICROSTRAIN * float(sigma)),
            charted=True,
            group="Virtual gauges",
        )
        for name, strain, sigma in zip(gauges.names, gauges.strain, gauges.sigma, strict=True)
    )


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


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def _percentile(values: NDArray[Any], percentile: float) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, percentile)) if known.size else None


def _median(values: NDArray[Any]) -> float | None:
    return _percentile(values, 50.0)


def _rms(values: NDArray[Any]) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known.astype(np.float64) ** 2))) if known.size else None
