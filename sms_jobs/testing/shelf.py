"""A campaign of the virtual rig whose results lie in memory, and kinds that run on them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, DatasetOutput, Inputs, Kind
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.products import CALIBRATED, MEASURED
from sms_jobs.kinds.recording import simulate
from sms_jobs.kinds.surface_ports import maker_of, textured_by
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.measurement import ArrayStack, Measurement
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of
from sms_jobs.testing.in_memory import InMemory
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
        """Record a state on the virtual rig, and keep the frames of a tuple, or of all, in memory."""
        at = Subject(subject.campaign, subject.state)
        self.run(simulate.KIND, at, simulate.KIND.parameters())
        every = tuple(replace(at, view=view) for view in self.campaign.recordings)
        for own in subject.recordings if subject.view else every:
            recorded: Measurement = self.records[MEASUREMENT, own][MEASURED.stored_as]
            frames = np.stack([recorded.frames.frame(i) for i in range(recorded.frames.shape[0])])
            self.records[MEASUREMENT, own] = {
                MEASURED.stored_as: replace(recorded, frames=ArrayStack(frames))
            }

    def forget(self, state: str) -> None:
        """Drop all that has been recorded and computed of a state."""
        for source, subject in [key for key in self.records if key[1].state == state]:
            del self.records[source, subject]

    def shape(self, subject: Subject) -> Shape:
        """Return the exact shape at a recorded state."""
        recorded = self.records[MEASUREMENT, textured_by(subject)][MEASURED.stored_as]
        return exact_shape(recorded.simulation, view_of(subject.view).partners, threads=self.threads)

    def truth(self, subject: Subject) -> Truth:
        """Return what is exactly true between the reference state and a recorded one."""
        at_rest = replace(subject, state=self.campaign.reference.label)
        first, last = (
            self.records[MEASUREMENT, textured_by(s)][MEASURED.stored_as].simulation
            for s in (at_rest, subject)
        )
        return exact_truth(first, last, view_of(subject.view).partners, threads=self.threads)


def state_by_state(
    calibration: Calibration,
    campaign: Campaign,
    say: Callable[[str], None],
    threads: int,
    chain: Sequence[tuple[Kind[Any], Parameters]],
    labels: Sequence[str] = (),
) -> Iterator[tuple[LoadState, Shelf]]:
    """Record and measure a campaign, yield each deformed state with what came of it, and then forget that.

    Parameters
    ----------
    calibration, campaign
        On the virtual rig.
    say
        Told which state comes next.
    threads
        How many threads to use.
    chain
        Kinds that run one after the other on every tuple of a deformed state, with their parameters.
    labels
        Of the deformed states that are measured; all if none are given.
    """
    shelf = Shelf(campaign, threads)
    for state in campaign.states:
        at_rest = state is campaign.reference
        if labels and not at_rest and state.label not in labels:
            continue
        at = Subject(campaign.name, state.label)
        say(f"recording and measuring {at}")
        shelf.record(at)
        for view in campaign.views:
            subject, maker = replace(at, view=view), all_kinds()[maker_of(view).kind]
            shelf.records[CALIBRATION, subject] = {CALIBRATED.stored_as: calibration}
            shelf.run(maker, subject, maker.parameters())
            for kind, parameters in () if at_rest else chain:
                shelf.run(kind, subject, parameters)
        if not at_rest:
            yield state, shelf
            shelf.forget(state.label)


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
        shelf.records[CALIBRATION, subject] = {CALIBRATED.stored_as: calibration}
        shelf.record(subject)
        shelf.run(kind, subject, kind.parameters())
    return shelf, Subject(campaign.name, deformed[-1], campaign.views[0])
