"""What strain is worth on a flat panel in tension, over gauge length and subset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sms_jobs.bench.in_memory import InMemory
from sms_jobs.bench.study import Outcome, Study, Table, new_figure
from sms_jobs.kinds import acquire, correlate, reconstruct, strain
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, DatasetOutput, Inputs, Kind, Parameters
from sms_jobs.records.campaign import Campaign, Subject
from sms_jobs.records.measurement import ArrayStack, Measurement
from sms_jobs.virtual_rig.campaigns import tension_panel
from sms_jobs.virtual_rig.truth import Truth, exact_truth

GAUGE_LENGTHS_MM = (10.0, 15.0, 20.0, 30.0, 40.0)
SUBSET_RADII_PX = (10, 16, 24)
_THREADS = 2


@dataclass(frozen=True)
class _Shelf:
    """What has been recorded and computed of a campaign, by source and subject."""

    campaign: Campaign
    records: dict[tuple[str, Subject], dict[str, Any]] = field(default_factory=dict)

    def run(self, kind: Kind[Any], subject: Subject, parameters: Parameters) -> None:
        """Run a kind on what is there, and keep what it yields."""
        datasets = {
            need.role: InMemory(need.subject, self.records[need.source, need.subject])
            for need in kind.needs(self.campaign, subject)
        }
        inputs = Inputs(subject, kind.context(self.campaign, subject), datasets, _THREADS)
        for output in kind.run(inputs, parameters, lambda fraction, message="": None):
            assert isinstance(output, DatasetOutput)
            self.records[kind.makes or kind.name, output.subject] = dict(output.records)


def _measured(say: Callable[[str], None]) -> tuple[_Shelf, Subject]:
    """Return the panel, recorded and reconstructed at rest and at its largest strain."""
    calibration, campaign = tension_panel("panel", "full")
    shelf = _Shelf(campaign)
    states = (campaign.states[0].label, campaign.states[-1].label)
    for label in states:
        subject = Subject(campaign.name, label, campaign.pairs[0])
        say(f"recording and reconstructing {subject}")
        shelf.records[CALIBRATION, subject] = {"calibration": calibration}
        shelf.run(acquire.KIND, Subject(campaign.name, label), acquire.KIND.parameters())
        recorded: Measurement = shelf.records[MEASUREMENT, subject]["measurement"]
        frames = np.stack([recorded.frames.frame(i) for i in range(recorded.frames.shape[0])])
        shelf.records[MEASUREMENT, subject] = {"measurement": replace(recorded, frames=ArrayStack(frames))}
        shelf.run(reconstruct.KIND, subject, reconstruct.KIND.parameters())
    return shelf, Subject(campaign.name, states[1], campaign.pairs[0])


def _truth(shelf: _Shelf, subject: Subject) -> Truth:
    at_rest = replace(subject, state=shelf.campaign.reference.label)
    simulations = [shelf.records[MEASUREMENT, s]["measurement"].simulation for s in (at_rest, subject)]
    return exact_truth(simulations[0], simulations[1], threads=_THREADS)


def run(say: Callable[[str], None]) -> Outcome:
    """Strain a panel by 2000 microstrain and compare every valid pixel with the exact strain."""
    shelf, subject = _measured(say)
    truth = _truth(shelf, subject)
    rows: list[tuple[float, ...]] = []
    figure = new_figure(7.0, 4.5)
    axes = figure.add_subplot()
    for radius in SUBSET_RADII_PX:
        say(f"subset radius {radius} px")
        shelf.run(correlate.KIND, subject, correlate.KIND.parameters(subset_radius_px=radius))
        pooled = []
        for length in GAUGE_LENGTHS_MM:
            shelf.run(strain.KIND, subject, strain.KIND.parameters(gauge_length_mm=length))
            found = shelf.records["strain", subject]["strain"]
            valid = found.reason == 0
            error = 1e6 * (found.strain - truth.strain(found.measure))[:, valid]
            stated = 1e6 * float(np.sqrt(np.mean(np.square(found.sigma[:, valid], dtype=np.float64))))
            each = np.sqrt(np.mean(error**2, axis=1))
            pooled.append(float(np.sqrt(np.mean(error**2))))
            rows.append((radius, length, *map(float, each), pooled[-1], stated))
        axes.loglog(GAUGE_LENGTHS_MM, pooled, "o-", label=f"subset radius {radius} px")
    axes.set_xlabel("gauge length [mm]")
    axes.set_ylabel("rms error of the strain [microstrain]")
    axes.set_title("flat panel of 290 mm, 2000 microstrain, 1024 px", fontsize="medium")
    axes.set_xticks(GAUGE_LENGTHS_MM, [f"{length:g}" for length in GAUGE_LENGTHS_MM])
    axes.minorticks_off()
    axes.legend(fontsize="small")
    columns = (
        "subset radius, px", "gauge length, mm", "xx, microstrain", "yy, microstrain", "xy, microstrain",
        "pooled, microstrain", "stated, microstrain",
    )  # fmt: skip
    remarks = {
        "conditions": "virtual rig, one camera of 1024 px and one projector, 12 bit, texture averaged over "
        "the fringe frames, Green-Lagrange strain; rms over all valid pixels, nothing trimmed",
        "thesis": "100 microstrain on the wing panel (section 6.2.5)",
    }
    return Outcome(Table(columns, rows, remarks), figure)


STUDY = Study(
    "strain-gauge-length", "noise of strain over gauge length and subset, flat panel in tension", run
)
