"""The maps of a report and the numbers under them, from one record at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.formats.figures import Map, draw_map, reduced
from sms_jobs.formats.report.html import Cell, Markup, figure
from sms_jobs.formats.report.tables import MICROSTRAIN, PER_CENT
from sms_jobs.records.fields import MergedField, PointCloud, Regions, StrainField
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.quantity import SYMMETRIC, XYZ

_VARIANCES = [SYMMETRIC.index(name) for name in ("XX", "YY", "ZZ")]

MERGED_HEADER = (
    "state", "camera", "valid [%]", "median X [mm]", "median Y [mm]", "median Z [mm]", "largest [mm]",
    "sigma, median [mm]", "disagreement of pairs, rms [mm]",
)  # fmt: skip
STRAIN_HEADER = (
    "state", "pair", "valid [%]", "gauge length [mm]", "median xx [µε]", "median yy [µε]", "median xy [µε]",
    "largest principal [µε]", "sigma xx, median [µε]",
)  # fmt: skip


def _median(values: NDArray[Any]) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


def _largest(values: NDArray[Any]) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else None


@dataclass(frozen=True)
class Draughtsman:
    """Draws maps of one width.

    Attributes
    ----------
    width_px
        Of every picture.
    """

    width_px: int

    def _draw(
        self, values: NDArray[Any], title: str, unit: str, caption: str, labels: NDArray[Any] | None = None
    ) -> Markup:
        size = (values.shape[0], values.shape[1])
        if values.dtype.kind != "f":
            values = values.astype(np.float32)
        outlines = None if labels is None else reduced(labels, self.width_px)
        drawn = draw_map(Map(reduced(values, self.width_px), size, title, unit, outlines), self.width_px)
        return figure(drawn, caption)

    def texture(self, measurement: Measurement, regions: Regions | None, where: str) -> Markup:
        """Draw the white-light texture with the borders of the continuous pieces of surface."""
        labels = None
        caption = f"{where}: white-light texture"
        if regions is not None and regions.labels.shape == measurement.texture.shape:
            labels = regions.labels
            caption += f", and the borders of {len(regions.regions)} continuous pieces of surface"
        return self._draw(measurement.texture, "Texture", "count", caption, labels)

    def depth(self, cloud: PointCloud, where: str) -> Markup:
        """Draw Z of the world."""
        return self._draw(cloud.xyz[XYZ.index("Z")], "Position Z", "mm", f"{where}: position along Z")

    def depth_sigma(self, cloud: PointCloud, where: str) -> Markup:
        """Draw the standard deviation of Z."""
        sigma = np.sqrt(cloud.covariance[SYMMETRIC.index("ZZ")])
        caption = f"{where}: standard deviation of Z, from the camera's noise"
        return self._draw(sigma, "Standard deviation of Z", "mm", caption)

    def displacement(self, merged: MergedField, where: str) -> list[Markup]:
        """Draw the magnitude and Z of the displacement."""
        length = np.sqrt(np.sum(merged.displacement**2, axis=0))
        view = f"{where}, {', '.join(merged.pairs)} merged"
        return [
            self._draw(length, "Displacement, magnitude", "mm", f"{view}: magnitude of the displacement"),
            self._draw(
                merged.displacement[XYZ.index("Z")],
                "Displacement along Z",
                "mm",
                f"{view}: displacement along Z",
            ),
        ]

    def strain(self, field: StrainField, where: str) -> list[Markup]:
        """Draw the strain along x and the larger principal strain."""
        about = f"{field.measure} strain over {field.gauge_length_mm:.4g} mm"
        return [
            self._draw(field.strain[0] * MICROSTRAIN, "Strain xx", "µε", f"{where}: {about}, along x"),
            self._draw(
                field.principal[0] * MICROSTRAIN,
                "First principal strain",
                "µε",
                f"{where}: {about}, larger principal strain",
            ),
        ]


def merged_row(merged: MergedField, state: str) -> list[Cell]:
    """Return the numbers of a camera's displacement; see `MERGED_HEADER`."""
    length = np.sqrt(np.sum(merged.displacement**2, axis=0))
    sigma = np.sqrt(merged.covariance[_VARIANCES].sum(axis=0))
    return [
        state,
        merged.camera,
        float(np.mean(merged.reason == 0)) * PER_CENT,
        *(_median(component) for component in merged.displacement),
        _largest(length),
        _median(sigma),
        merged.discrepancy_rms_mm,
    ]


def strain_row(field: StrainField, state: str, pair: str) -> list[Cell]:
    """Return the numbers of a pair's strain; see `STRAIN_HEADER`."""
    medians = [_median(component * MICROSTRAIN) for component in field.strain]
    return [
        state,
        pair,
        float(np.mean(field.reason == 0)) * PER_CENT,
        field.gauge_length_mm,
        *medians,
        _largest(field.principal[0] * MICROSTRAIN),
        _median(field.sigma[0] * MICROSTRAIN),
    ]
