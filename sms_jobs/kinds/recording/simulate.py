"""Simulate: one measurement of every view at a state, rendered by the virtual rig."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np
from pydantic import Field

from sms_jobs.errors import InvalidInput
from sms_jobs.instruments.protocols import Recorder
from sms_jobs.instruments.simulated.rig import SimulatedRig
from sms_jobs.kinds.kind import (
    MEASUREMENT,
    DatasetOutput,
    Inputs,
    Kind,
    Output,
    Progress,
    Queue,
    Scope,
    no_needs,
)
from sms_jobs.kinds.parameters import Parameters
from sms_jobs.kinds.products import MEASURED
from sms_jobs.kinds.recording.adaptation import QUICK, Adaptive, adaptation_statistics, adapted
from sms_jobs.records.artefacts import BallBar
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.measurement import FringeSequence, Measurement
from sms_jobs.records.scene import Deformation, Scene
from sms_jobs.records.sizes import number_of
from sms_jobs.records.subject import Subject
from sms_jobs.records.times import UNTIMED
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.artefacts import bowed


class SimulateParameters(Parameters):
    """What is recorded follows from the campaign; how it is exposed may follow from what stands there."""

    adaptive: Adaptive = Field(
        "none",
        description="what a quick pre-exposure of every view decides: nothing, the set of exposures that "
        "keeps every pixel in the camera's range instead of that of the sequence, or where the projector is "
        "dimmed so that one exposure does",
    )
    longest_exposure: float = Field(
        1.0,
        gt=0.0,
        description="exposure that an adaptive set does not exceed, in units of the camera's own",
    )


@dataclass(frozen=True)
class Recipe:
    """What the virtual rig is to record.

    Attributes
    ----------
    scene
        With the artefact in place of a specimen where the state shows one.
    state
        Label of the load state.
    deformation
        What that state does to the specimen.
    views, sequence
        Recorded one after the other, each with the whole sequence.
    recorded_at
        The time that the measurements bear.
    """

    scene: Scene
    state: str
    deformation: tuple[Deformation, ...]
    views: tuple[str, ...]
    sequence: FringeSequence
    recorded_at: datetime


def recipe(campaign: Campaign, subject: Subject) -> Recipe:
    """Return what is to be recorded at a state.

    Raises
    ------
    InvalidInput
        When the campaign has no scene for the virtual rig.
    """
    if campaign.scene is None:
        raise InvalidInput(
            f"campaign {campaign.name} has no scene for the virtual rig to record; "
            "describe one under [scene] in its test plan"
        )
    state = campaign.state(subject.state or "")
    return Recipe(
        scene_at(campaign.scene, campaign, state),
        state.label,
        deformation_at(campaign, state),
        campaign.recordings_at(state.label),
        campaign.sequence,
        state.time or UNTIMED,
    )


def scene_at(scene: Scene, campaign: Campaign, state: LoadState) -> Scene:
    """Return what stands before a virtual rig at a state: an artefact in place of a specimen in a session."""
    if campaign.session is None or state.artefact is None:
        return scene
    return replace(scene, surface=campaign.session.artefacts[state.artefact], speckle=None)


def deformation_at(campaign: Campaign, state: LoadState) -> tuple[Deformation, ...]:
    """Return what is done to what stands before a virtual rig at a state: a board is bowed in every pose."""
    if campaign.scene is None or campaign.session is None or state.artefact is None:
        return state.deformation
    artefact = campaign.session.artefacts[state.artefact]
    if isinstance(artefact, BallBar):
        return state.deformation
    return (*bowed(artefact, campaign.scene.board_bow_mm), *state.deformation)


def simulated_states(campaign: Campaign) -> tuple[Subject, ...]:
    """Return every state of a campaign on the virtual rig; none of any other."""
    if campaign.scene is None:
        return ()
    return tuple(Subject(campaign.name, s.label) for s in campaign.states)


def run(inputs: Inputs, parameters: SimulateParameters, progress: Progress) -> Iterator[Output]:
    """Record every view of a state, one after the other; frames are made while they are stored."""
    task: Recipe = inputs.context
    if parameters.adaptive != "none" and not any(view_of(view).projectors for view in task.views):
        raise InvalidInput(
            f"adaptive={parameters.adaptive} needs fringes, and nothing is projected in campaign "
            f"{inputs.subject.campaign}, whose views are recorded by {', '.join(task.views)}: set "
            "adaptive=none, and the exposure under [scene.camera] of its plan"
        )
    rig: Recorder = SimulatedRig(
        task.scene, task.state, task.deformation, task.recorded_at, inputs.threads, task.views
    )
    for number, view in enumerate(task.views):
        progress(number / len(task.views), f"recording {view}")
        measurement = _recorded(rig, task, view, parameters, inputs.threads)
        subject = Subject(inputs.subject.campaign, task.state, view)
        yield DatasetOutput(subject, {MEASURED: measurement}, _statistics(measurement))
    progress(1.0, f"recorded {number_of(len(task.views), 'view')}")


def _recorded(
    rig: Recorder, task: Recipe, view: str, parameters: SimulateParameters, threads: int
) -> Measurement:
    """Record a view, for adaptive patterns after a quick look at how bright it is."""
    if parameters.adaptive == "none":
        return rig.record(view, task.sequence)
    seen_by = view_of(view)
    if not seen_by.projectors:
        return rig.record(view, task.sequence)  # a lamp stays as it is
    projector = task.scene.rig.sensor(seen_by.projector)
    quick = rig.record(view, QUICK)
    adaptive, longest = parameters.adaptive, parameters.longest_exposure
    shown = adapted(adaptive, longest, task.sequence, projector, [quick], threads)
    return rig.record(view, shown.sequence, shown.dimming)


def _statistics(measurement: Measurement) -> dict[str, float]:
    """Return what the white frame, the brightest, says of the exposure, and how that was adapted."""
    texture = measurement.texture
    return {
        "saturated_fraction": float(np.mean(texture >= measurement.full_scale)),
        "mean_level_count": float(np.mean(texture)),
        **adaptation_statistics(measurement),
    }


KIND = Kind(
    name="simulate",
    summary="render every view of a state on the virtual rig",
    version=4,
    scope=Scope.STATE,
    parameters=SimulateParameters,
    inputs=(),
    outputs=(MEASURED,),
    needs=no_needs,
    run=run,
    subjects=simulated_states,
    context=recipe,
    queue=Queue.ACQUISITION,
    makes=MEASUREMENT,
    in_pipeline=False,
)
