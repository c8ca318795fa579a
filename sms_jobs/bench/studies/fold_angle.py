"""Strain beside a fold: what gauge discs that end there are worth, on the bent top hat (section 5.3)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import ndimage

from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.kinds.deformation import correlate, strain
from sms_jobs.metrology.arrays import Floats, Mask
from sms_jobs.metrology.deformation.fields.displacement import pixel_pitch
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf, reconstructed
from sms_jobs.virtual_rig.campaigns import top_hat_bending
from sms_jobs.virtual_rig.truth import Truth

ANGLES_DEG = (180.0, 45.0, 30.0, 20.0, 10.0)
NEAR_MM = 20.0
_GAUGE_LENGTH_MM = 20.0
_THREADS = 2


def distance_from_edges(truth: Truth) -> Floats:
    """Return how far each pixel is, in the image, from where its face meets or hides another, in mm.

    The distance in pixels times their median pitch; 0 where no face is seen.
    """
    region = truth.shape.region
    distance = np.zeros(region.shape)
    for number in range(1, region.max() + 1):
        own = region == number
        distance[own] = ndimage.distance_transform_edt(own)[own]
    return distance * pixel_pitch(truth.shape.xyz, np.where(truth.shape.seen, region, 0), 0.5)


def errors(shelf: Shelf, subject: Subject, truth: Truth, near: Mask, angle_deg: float) -> list[float]:
    """Return rms errors of strain in microstrain: of all pixels, near edges, elsewhere; and that stated."""
    parameters = strain.StrainParameters(gauge_length_mm=_GAUGE_LENGTH_MM, fold_angle_deg=angle_deg)
    shelf.run(strain.KIND, subject, parameters)
    found = shelf.records["strain", subject]["strain"]
    error = found.strain - truth.strain(found.measure)
    valid = (found.reason == 0) & np.isfinite(error).all(axis=0)
    rms = [
        float(np.sqrt(np.mean(np.square(field[:, where], dtype=np.float64))))
        for field, where in (
            (error, valid),
            (error, valid & near),
            (error, valid & ~near),
            (found.sigma, valid),
        )
    ]
    return [1e6 * value for value in rms]


def run(say: Callable[[str], None]) -> Outcome:
    """Take strain with several limits from one displacement."""
    calibration, campaign = top_hat_bending("hat", "full")
    shelf, subject = reconstructed(calibration, campaign, say, _THREADS)
    truth = shelf.truth(subject)
    say("correlating")
    shelf.run(correlate.KIND, subject, correlate.KIND.parameters())
    near = distance_from_edges(truth) < NEAR_MM
    rows: list[tuple[Cell, ...]] = []
    for angle in ANGLES_DEG:
        say(f"strain up to a turn of {angle:g} degrees")
        rows.append((angle, *errors(shelf, subject, truth, near, angle)))
    figure = new_figure(6.0, 4.0)
    axes = figure.subplots()
    for label, column in (
        ("all", 1),
        (f"within {NEAR_MM:g} mm of an edge", 2),
        ("elsewhere", 3),
        ("stated", 4),
    ):
        axes.loglog(ANGLES_DEG, [row[column] for row in rows], "o-", label=label)
    axes.set_xticks(ANGLES_DEG, [f"{angle:g}" for angle in ANGLES_DEG])
    axes.minorticks_off()
    axes.set_xlabel("turn of the surface at which a gauge disc ends [degrees]")
    axes.set_ylabel("rms error of the strain [microstrain]")
    axes.legend(fontsize="small")
    columns = (
        "fold angle, degrees", "rms error, microstrain", f"within {NEAR_MM:g} mm of an edge", "elsewhere",
        "stated",
    )  # fmt: skip
    remarks = {
        "conditions": "virtual rig, top hat of 500 mm pushed out by 10 mm, one camera of 1024 px and one "
        f"projector, 12 bit, gauge length {_GAUGE_LENGTH_MM:g} mm, default parameters otherwise; xx, yy and "
        "xy together over all valid pixels, nothing trimmed; edges are where a face meets or hides another",
    }
    return Outcome(Table(columns, rows, remarks), figure)


STUDY = Study("fold-angle", "strain of the bent top hat, with gauge discs that end at folds or do not", run)
