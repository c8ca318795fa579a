"""All states of the plate with a hole and a step on its translation stage (thesis section 4.6)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sms_jobs.bench.compared_fields import lengths
from sms_jobs.bench.published import Judged
from sms_jobs.bench.study import Cell, Outcome, Study, Table, new_figure
from sms_jobs.kinds.deformation import correlate
from sms_jobs.records.subject import Subject
from sms_jobs.testing.shelf import state_by_state
from sms_jobs.virtual_rig.campaigns import PIXELS, Size, hole_and_step_translation

_THREADS = 2
_BASE, _STEP = 1, 2
_COLUMNS = (
    "state", "stage, mm", "measured, mm", "error, mm", "z", "standard deviation, mm", "stated, mm", "valid",
)  # fmt: skip


def run_at(size: Size, say: Callable[[str], None], labels: tuple[str, ...] = ()) -> Outcome:
    """Measure the states, all if none are named, and compare the length of displacement with the stage's."""
    calibration, campaign = hole_and_step_translation("plate", size)
    rows: list[tuple[Cell, ...]] = []
    between = float("nan")
    regions = 0
    chain = [(correlate.KIND, correlate.KIND.parameters())]
    for state, shelf in state_by_state(calibration, campaign, say, _THREADS, chain, labels):
        subject = Subject(campaign.name, state.label, campaign.views[0])
        truth, found = shelf.truth(subject), shelf.records["correlate", subject]
        moved = lengths(found["displacement"], truth)
        usable = truth.shape.seen & truth.shape.lit & truth.lit_and_seen_at_end
        every = moved.mean(usable)
        known = usable & np.isfinite(moved.error)
        scatter, stated = float(np.std(moved.error[known])), float(np.sqrt(np.mean(moved.sigma[known] ** 2)))
        part = float(known.sum() / usable.sum())
        rows.append(
            (state.label, every.exact, every.measured, every.error, every.z, scatter, stated, part)
        )  # fmt: skip
        base, step = (moved.mean(usable & (truth.shape.region == number)) for number in (_BASE, _STEP))
        between = abs(step.measured - base.measured)
        regions = len(found["regions"].regions)
    errors, scatters = (np.array([row[k] for row in rows], dtype=np.float64) for k in (3, 5))
    judged = (
        Judged("motion-regions", float(regions), 2.0),
        Judged("motion-between", between),
        Judged("motion-largest", float(np.abs(errors).max())),
        Judged("motion-scatter", float(scatters.max())),
        Judged("motion-resolution", float(scatters.mean())),
    )
    figure = new_figure(7.0, 4.0)
    axes = figure.add_subplot()
    stage = [float(row[1]) for row in rows if isinstance(row[1], float)]
    axes.errorbar(stage, 1e3 * errors, 1e3 * scatters, fmt="o", markersize=3, capsize=2)
    axes.axhline(0.0, color="grey", linewidth=0.5)
    axes.set_xlabel("displacement of the stage [mm]")
    axes.set_ylabel("error of the mean, standard deviation [um]")
    remarks = {
        "conditions": "virtual rig, a tilted plate of 640 mm with a hole and a step of 40 mm, moved along X; "
        f"one camera of {PIXELS[size]} px and one projector, 12 bit, default parameters; length of the "
        "displacement of all pixels that are lit and in sight in both states",
        "z": "error of the mean over what is stated of it, if values within a subset are one value; the "
        "length of a vector with noise is too long by the variance across it over twice its length",
        "thesis": "section 4.6 has 18 states of translation and none of rotation; Fig. 53 is a picture, "
        "of which the text tells the largest and mean values",
    }
    return Outcome(Table(_COLUMNS, rows, remarks), figure, judged)


STUDY = Study(
    "rigid-motion",
    "all states of the plate on its translation stage (section 4.6, Fig. 48-53)",
    lambda say: run_at("small", say),
    lambda say: run_at("full", say),
)
