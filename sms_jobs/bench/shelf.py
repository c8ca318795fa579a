"""A campaign of the virtual rig whose results lie in memory, and kinds that run on them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sms_jobs.bench.in_memory import InMemory
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, DatasetOutput, Inputs, Kind, Parameters
from sms_jobs.kinds.recording import simulate
from sms_jobs.kinds.surface_ports import maker_of, textured_by
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.measurement import ArrayStack, Measurement
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.truth import Shape, Truth, exact_shape, exact_truth


@dataclass(frozen=True)
class Shelf:
    """What has been recorded and computed of a campaign, by source and subject."""

    campaign: Campaign
    threads: int
    records: dict[tuple[str, Subject], dict[str, Any]] = field(default_factory=dict)

    def run(self, kind: Kind[Any], subject: Subject, parameters: Parameters) -> None:
        """Run a kind on what is there, and keep what it yields."""
        datasets = {
            need.role: InMemory(need.subject, self.records[need.source, need.subject])
            for need in kind.checked_needs(self.campaign, subject, parameters)
        }
        inputs = Inputs(subject, kind.context(self.campaign, subject), datasets, self.threads)
        for output in kind.run(inputs, parameters, lambda fraction, message="": None):
            kind.checked(output)
            assert isinstance(output, DatasetOutput)
            self.records[kind.makes or kind.name, output.subject] = dict(output.records)

    def record(self, subject: Subject) -> None:
        """Record a state on the virtual rig, and keep the frames of a tuple in memory."""
        self.run(simulate.KIND, Subject(subject.campaign, subject.state), simulate.KIND.parameters())
        for own in subject.recordings:
            recorded: Measurement = self.records[MEASUREMENT, own]["measurement"]
            frames = np.stack([recorded.frames.frame(i) for i in range(recorded.frames.shape[0])])
            self.records[MEASUREMENT, own] = {"measurement": replace(recorded, frames=ArrayStack(frames))}

    def shape(self, subject: Subject) -> Shape:
        """Return the exact shape at a recorded state."""
        recorded = self.records[MEASUREMENT, textured_by(subject)]["measurement"]
        return exact_shape(recorded.simulation, view_of(subject.view).partners, threads=self.threads)

    def truth(self, subject: Subject) -> Truth:
        """Return what is exactly true between the reference state and a recorded one."""
        at_rest = replace(subject, state=self.campaign.reference.label)
        first, last = (
            self.records[MEASUREMENT, textured_by(s)]["measurement"].simulation for s in (at_rest, subject)
        )
        return exact_truth(first, last, view_of(subject.view).partners, threads=self.threads)


def reconstructed(
    calibration: Calibration,
    campaign: Campaign,
    say: Callable[[str], None],
    threads: int,
    states: Sequence[str] = (),
) -> tuple[Shelf, Subject]:
    """Record and measure a campaign's first view at rest and at some states; return the last tuple.

    The campaign's last state alone if none is given.
    """
    shelf = Shelf(campaign, threads)
    kind = all_kinds()[maker_of(campaign.views[0]).kind]
    deformed = tuple(states) or (campaign.states[-1].label,)
    for label in (campaign.reference.label, *deformed):
        subject = Subject(campaign.name, label, campaign.views[0])
        say(f"recording and measuring {subject}")
        shelf.records[CALIBRATION, subject] = {"calibration": calibration}
        shelf.record(subject)
        shelf.run(kind, subject, kind.parameters())
    return shelf, Subject(campaign.name, deformed[-1], campaign.views[0])
