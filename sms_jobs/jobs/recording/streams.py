"""Streams of frames among the jobs of a campaign: which comes next, what it takes, and what came of one."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.catalogue.campaigns import campaign_row, definition
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import InvalidInput
from sms_jobs.instruments.frame_memory import PART_OF_MEMORY
from sms_jobs.instruments.rehearsal import BYTES_A_PIXEL
from sms_jobs.jobs.archiving.importing import measured_tuples
from sms_jobs.jobs.devices.disks import free_bytes
from sms_jobs.jobs.recording.lacking import lacking_scene
from sms_jobs.jobs.recording.recordings import PairVerdict
from sms_jobs.kinds.recording.stream import KIND, StreamParameters, require_exposures
from sms_jobs.records.shown.streams import StreamedCamera, StreamOutcome, StreamRehearsal
from sms_jobs.records.statistic_names import DOUBTS, SINCE_START_S, channels_before, of_stream
from sms_jobs.records.streams import stream_of
from sms_jobs.records.subject import Subject

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign
    from sms_jobs.records.optical_instruments import RigFile

_ACCOUNT = ("moments", "whole", "late", "lost", "refused")


def next_number(session: Session, campaign: str) -> int:
    """Return the number of the next stream of a campaign: of no job yet, and of no state that is recorded."""
    row = campaign_row(session, campaign)
    given = session.scalars(
        select(JobRow.parameters).where(JobRow.campaign_id == row.id, JobRow.kind == KIND.name)
    )
    recorded = (stream_of(label) for label, _ in measured_tuples(session, definition(row)))
    return 1 + max([*(int(parameters["number"]) for parameters in given), *recorded], default=0)


def rehearse(
    rig: RigFile,
    campaign: Campaign,
    parameters: StreamParameters,
    spool: Path,
    archive_room: int,
    memory_limit_mb: float,
) -> StreamRehearsal:
    """Return what a stream would take on this host; nothing is asked of any instrument.

    Parameters
    ----------
    spool
        Folder whose disk is to hold the frames.
    archive_room
        What is free on the archive's disk, in bytes.
    memory_limit_mb
        What a job may take of memory; 0 for no limit.
    """
    size, cameras = parameters.size, campaign.recordings
    raw = {c.name: BYTES_A_PIXEL * c.rows * c.columns for c in rig.cameras if c.name in cameras}
    each = sum(raw.values())
    states = -(-size.frames // parameters.every)
    ring, memory = size.ring_frames * each, int(PART_OF_MEMORY * psutil.virtual_memory().available)
    if memory_limit_mb:
        memory = min(memory, int(1e6 * memory_limit_mb))
    # The image of a state lies in its file as texture and as frame.
    needs = size.most_frames * each, (size.frames + states) * each
    found = StreamRehearsal(
        cameras=cameras,
        frames=size.frames,
        states=states,
        seconds=size.kept_s,
        ring_bytes=ring,
        memory_room=memory,
        spool_bytes=needs[0],
        spool_room=free_bytes(spool),
        archived_bytes=needs[1],
        archive_room=archive_room,
        missing=tuple(_missing(rig, campaign, parameters)),
    )
    return _with_lacking_room(found)


def _missing(rig: RigFile, campaign: Campaign, parameters: StreamParameters) -> Iterator[str]:
    yield from rig.lacking(campaign.recordings, ())
    yield from lacking_scene(rig, campaign)
    try:
        require_exposures(rig, campaign.recordings, parameters)
    except InvalidInput as error:
        yield str(error)


def _with_lacking_room(found: StreamRehearsal) -> StreamRehearsal:
    needed = (
        ("memory", found.ring_bytes, found.memory_room, "keep less before the event, or take fewer frames"),
        ("the spool's disk", found.spool_bytes, found.spool_room, "free some space"),
        ("the archive's disk", found.archived_bytes, found.archive_room, "free some space"),
    )
    lacking = [
        f"{where} has {room / 1e6:.0f} MB for it, and {needs / 1e6:.0f} MB are needed: {what}"
        for where, needs, room, what in needed
        if needs > room
    ]
    return replace(found, missing=(*found.missing, *lacking))


def outcome(verdicts: Sequence[PairVerdict]) -> StreamOutcome:
    """Return what came of a stream, from what is known of the images of its states, in their order."""
    if not verdicts:
        return StreamOutcome()
    subjects = [Subject.parse(one.subject) for one in verdicts]
    by_camera: dict[str, list[Mapping[str, float]]] = {}
    for subject, one in zip(subjects, verdicts, strict=True):
        by_camera.setdefault(subject.view or "", []).append(one.statistics)
    of_first = next(iter(by_camera.values()))
    times = [one[SINCE_START_S] for one in of_first]
    values: dict[str, list[float]] = {}
    for statistics in of_first:
        for name, value in channels_before(statistics).items():
            values.setdefault(name, []).append(value)
    return StreamOutcome(
        subjects[0].state or "",
        subjects[-1].state or "",
        {name: _of_camera(of_states) for name, of_states in by_camera.items()},
        any(of_states[0][of_stream("broke_off")] for of_states in by_camera.values()),
        (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else None,
        {name: (min(read), max(read)) for name, read in values.items()},
        {name: len(times) - len(read) for name, read in values.items() if len(read) < len(times)},
    )


def _of_camera(of_states: Sequence[Mapping[str, float]]) -> StreamedCamera:
    account = {name: int(of_states[0][of_stream(name)]) for name in _ACCOUNT}
    return StreamedCamera(
        **account, states=len(of_states), doubted=sum(bool(one[DOUBTS]) for one in of_states)
    )
