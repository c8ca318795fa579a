"""Three ways to the end of a displacement that two cameras see, against exact truth: `correlate.following`.

Where the reference camera sees a point of the first state later is known by matching its texture in time.
Where the partner sees it then may be told by the shape of that state, by following the partner's own texture,
or by matching the partner's image with that of the reference camera in the first state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias, get_args

import numpy as np

from sms_jobs.bench.compared_fields import reported_over_observed
from sms_jobs.bench.study import Outcome, Study, Table, new_figure
from sms_jobs.bench.two_cameras.errors import PointErrors, displacement_errors
from sms_jobs.kinds.deformation import correlate
from sms_jobs.kinds.deformation.correlate_parameters import Following
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.kinds.shape import stereo
from sms_jobs.metrology.arrays import Floats
from sms_jobs.records.scene import Deformation, Rigid, Surface, UniaxialStrain
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import Shelf
from sms_jobs.virtual_rig.campaigns import Made
from sms_jobs.virtual_rig.stereo_campaigns import curved, stepped, stereo_campaign, stereo_rig

COLUMNS = 640
WAYS: tuple[Following, ...] = get_args(Following)
_RADIUS, _RANGE_PX = 12, 60
_STILL = (0.0, 0.0, 0.0)
_MICRO = 1e3
_SPECIMENS = {"cylinder": curved, "plate with a step": stepped}

Motions: TypeAlias = Callable[[float], dict[str, tuple[Deformation, ...]]]
"""What is done to a specimen, by name, if a pixel is so large on it, in mm."""


def motions(px_mm: float) -> dict[str, tuple[Deformation, ...]]:
    """Return what is done to the specimen, by name; `px_mm` is the size of a pixel on it."""
    return {
        "shift by 0.3 px": (Rigid(_STILL, (0.3 * px_mm, 0.1 * px_mm, 0.2 * px_mm)),),
        "shift by 25 px": (Rigid(_STILL, (25.0 * px_mm, -10.0 * px_mm, 10.0 * px_mm)),),
        "turn by 8 degrees in its plane": (Rigid((0.0, 0.0, 0.14), _STILL),),
        "tilt by 8 degrees": (Rigid((0.0, 0.14, 0.0), _STILL),),
        "tilt by 15 degrees": (Rigid((0.0, 0.26, 0.0), _STILL),),
        "stretch by 5 %": (UniaxialStrain(0.05, 0.33),),
    }


@dataclass(frozen=True)
class Judged:
    """What errors of a way come to.

    Attributes
    ----------
    rms, median, tail, bias
        Rms, median, 99.9th percentile and mean where all ways have a value, in um.
    stated, outliers, points, valid
        Of all that have a value by this way: stated over observed deviation, how many are off by more than
        six deviations and 0.05 px, how many there are, and their part of what both cameras see.
    """

    rms: float
    median: float
    tail: float
    bias: float
    stated: float
    outliers: int
    points: int
    valid: float


def specimen(
    columns: int, chosen: Motions, shape: Callable[[float], Surface] = curved, seed: int = 0
) -> Made:
    """Return a campaign of a specimen before two cameras, one state for each motion."""
    rig = stereo_rig(columns, columns * 4 // 5)
    field_mm = 500.0 * columns / rig.sensor("C1").intrinsics.fx
    done = tuple(chosen(field_mm / columns).values())
    return stereo_campaign("strategies", rig=rig, surface=shape(field_mm), deformations=done, seed=seed)


def compared(
    say: Callable[[str], None],
    columns: int,
    chosen: Motions = motions,
    shape: Callable[[float], Surface] = curved,
    seed: int = 0,
) -> dict[str, dict[str, Judged]]:
    """Return the errors of displacement by motion and way."""
    calibration, campaign = specimen(columns, chosen, shape, seed)
    partner = calibration.rig.sensor("C2")
    shelf = Shelf(campaign, 1)
    at_rest = Subject(campaign.name, "S00", "C1C2")

    def measure(subject: Subject) -> None:
        shelf.records[CALIBRATION, subject] = {"calibration": calibration}
        shelf.record(subject)
        shelf.run(stereo.KIND, subject, stereo.KIND.parameters())

    measure(at_rest)
    found: dict[str, dict[str, Judged]] = {}
    for number, name in enumerate(chosen(1.0), start=1):
        say(name)
        subject = replace(at_rest, state=f"S{number:02d}")
        measure(subject)
        truth = shelf.truth(subject)
        errors, points = [], []
        for way in WAYS:
            parameters = correlate.KIND.parameters(
                subset_radius_px=_RADIUS,
                search_range_x_px=_RANGE_PX,
                search_range_y_px=_RANGE_PX,
                following=way,
            )
            shelf.run(correlate.KIND, subject, parameters)
            field = shelf.records["correlate", subject]["displacement"]
            errors.append(field.displacement - truth.displacement)
            points.append(displacement_errors(field, truth, partner))
        found[name] = dict(zip(WAYS, _judged(errors, points), strict=True))
        shelf.forget(f"S{number:02d}")
    return found


def _judged(errors: list[Floats], points: list[PointErrors]) -> list[Judged]:
    """Return what errors (3, rows, columns) in mm of each way come to."""
    common = np.isfinite(errors).all(axis=(0, 1))
    told = []
    for error, every in zip(errors, points, strict=True):
        own = _MICRO * error[:, common]
        length = np.linalg.norm(own, axis=0)
        told.append(
            Judged(
                float(np.sqrt(np.mean(length**2))),
                float(np.median(length)),
                float(np.quantile(length, 0.999)),
                float(np.linalg.norm(own.mean(axis=1))),
                reported_over_observed([every.normalised]),
                every.outliers,
                len(every.length_mm),
                every.valid_part,
            )
        )
    return told


def run(say: Callable[[str], None]) -> Outcome:
    """Move, turn, tilt and stretch a cylinder and a plate with a step before two cameras."""
    found = {name: compared(say, COLUMNS, shape=shape) for name, shape in _SPECIMENS.items()}
    figure = new_figure(9.5, 7.5)
    for axes, (name, by_motion) in zip(figure.subplots(len(found), sharex=True), found.items(), strict=True):
        for number, way in enumerate(WAYS):
            place = np.arange(len(by_motion)) + 0.27 * (number - 1)
            axes.bar(place, [each[way].rms for each in by_motion.values()], 0.25, label=way)
        labels = [motion.replace(" by ", "\n", 1) for motion in by_motion]
        axes.set_xticks(np.arange(len(by_motion)), labels, fontsize="small")
        axes.set_ylabel("rms error of displacement [um]")
        axes.set_title(name, fontsize="medium")
        axes.legend(fontsize="small")
    figures = (
        "rms, um", "median, um", "99.9 %, um", "bias, um", "stated over observed", "outliers", "points",
        "valid part",
    )  # fmt: skip
    rows = [
        (name, motion, way, *(round(value, 4) for value in vars(one).values()))
        for name, by_motion in found.items()
        for motion, each in by_motion.items()
        for way, one in each.items()
    ]
    remarks = {
        "conditions": f"two cameras of {COLUMNS} x {COLUMNS * 4 // 5} px at 20 degrees and 500 mm, 12 bit, "
        f"subsets of {2 * _RADIUS + 1} px, of second order between cameras and of first in time; errors "
        "where all three have a value; outliers, off by more than six deviations and 0.05 px, and valid "
        "parts of what both cameras see in both states, of each way's own points",
        "each-state": "cameras matched with each other at every state, the default",
        "own-reference": "each camera's texture followed from its own first image",
        "shared-reference": "the partner's image matched with the reference camera's first image",
    }
    return Outcome(Table(("specimen", "motion", "way", *figures), rows, remarks), figure)


STUDY = Study(
    "stereo-strategies", "where the partner of a camera sees a point later: three ways compared", run
)
