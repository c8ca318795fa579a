"""Projectors in turn, all of their cameras at once, then the cameras without one: how a state is recorded.

Frames go to the spool as they come, so that a set that breaks off loses nothing of what was complete. What
is wrong with a set is found while the specimen is still held: a frame that a camera did not deliver is
taken again at once, and a set that is saturated or dark as often as the order allows.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path

from sms_jobs.errors import InstrumentError, InvalidInput, StorageFull
from sms_jobs.instruments.connected_rig import ConnectedRig
from sms_jobs.instruments.frame_memory import image_bytes, require_memory
from sms_jobs.instruments.judging import Limits
from sms_jobs.instruments.kept_sets import (
    finished_sets,
    frames_of,
    set_aside_interrupted,
)
from sms_jobs.instruments.recording_sets import Adaptation, FringeSet, LampSet, RecordedSet
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.views import view_of

logger = logging.getLogger(__name__)


def record_state(
    rig: ConnectedRig,
    views: Sequence[str],
    sequence: FringeSequence,
    spool: Path,
    limits: Limits,
    progress: Callable[[float, str], None],
    texture_exposure: float = 1.0,
    adaptation: Adaptation | None = None,
) -> None:
    """Record every view of a state into the spool; views that are there already are left alone.

    Parameters
    ----------
    views
        Such as C1P1, in order of their projectors; cameras without one, such as C1, are recorded last, all
        of them at once, and all of them again where one of them is not there.
    spool
        Folder of the job; it holds one file a view afterwards, see `kept_sets`.
    progress
        Told a fraction and a few words; may raise to stop the recording, which leaves the projectors dark.
    texture_exposure
        Of the white frame, and of images without a projector, in units of the camera's own.
    adaptation
        How exposures, or where projectors are dimmed, follow from a pre-exposure; None for the sequence's.

    Raises
    ------
    InvalidInput
        When the rig does not have a sensor of a view, or a channel that has to be read, or a burst does not
        fit into memory.
    InstrumentError
        When an instrument gives up; complete frames stay in the spool.
    StorageFull
        When the spool's disk has no room for these sets, or is full on the way.
    """
    limits.require_channels(rig.name, rig.channels)
    spool.mkdir(parents=True, exist_ok=True)
    set_aside_interrupted(spool)
    there = finished_sets(spool)
    missing = [view for view in views if view not in there]
    _require_sensors(rig, missing)
    _require_room(rig, missing, sequence, spool)
    lamplit = [view for view in views if not view_of(view).projectors]
    # Images that are to show one state are recorded at one time, whichever of them was lost.
    sets: list[RecordedSet] = [
        FringeSet(rig, cameras, sequence, texture_exposure, spool, limits, projector=projector)
        for projector, cameras in by_projector(missing).items()
    ]
    if any(view in missing for view in lamplit):
        sets.append(LampSet(rig, tuple(lamplit), sequence, texture_exposure, spool, limits))
    _require_memory(rig, sets)
    with ExitStack() as stack:
        stack.callback(quietly, rig.lamp.off)
        for projector in rig.projectors.values():
            stack.callback(quietly, projector.dark)
        for camera in rig.cameras.values():
            stack.callback(quietly, camera.disarm)
        for number, one in enumerate(sets):

            def part(fraction: float, words: str, number: int = number) -> None:
                progress((number + fraction) / len(sets), words)

            if adaptation is not None and isinstance(one, FringeSet):
                one = one.adapted(adaptation, part)
                _require_room(rig, [one.view(camera) for camera in one.cameras], one.sequence, spool)
            _until_good(one, part)


def _until_good(one: RecordedSet, progress: Callable[[float, str], None]) -> None:
    """Record a set until nothing is wrong with it, as often as it may be."""
    for attempt in range(1, one.limits.recordings + 1):
        doubts = replace(one, attempt=attempt).record(progress)
        for words in doubts:
            logger.warning("%s", words)
        if not doubts:
            return


def _require_sensors(rig: ConnectedRig, views: Sequence[str]) -> None:
    """Raise `InvalidInput` for a view that a rig has not the sensors for."""
    known = (*rig.cameras, *rig.projectors)
    for view in map(view_of, views):
        for name in view.sensors:
            if name not in known:
                raise InvalidInput(
                    f"rig {rig.name} has no {name} for the view {view}; it has {', '.join(known)}"
                )


def by_projector(views: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return the cameras of each projector, both in the order of the views."""
    found: dict[str, tuple[str, ...]] = {}
    for view in map(view_of, views):
        for projector in view.projectors:
            found[projector] = (*found.get(projector, ()), view.camera)
    return found


def _require_room(rig: ConnectedRig, views: Sequence[str], sequence: FringeSequence, spool: Path) -> None:
    """Raise `StorageFull` when some views have no room, before a load is held for them."""
    needed = 0
    for view in views:
        needed += frames_of(view, sequence) * image_bytes(rig.cameras[view_of(view).camera].facts)
    free = shutil.disk_usage(spool).free
    if needed > free:
        raise StorageFull(
            f"the disk of the spool, {spool}, has {free / 1e6:.0f} MB left, and the frames of this state "
            f"need {needed / 1e6:.0f} MB; free some space"
        )


def _require_memory(rig: ConnectedRig, sets: Sequence[RecordedSet]) -> None:
    """Raise `InvalidInput` when a burst does not fit into memory, before a load is held for it."""
    for one in sets:
        if isinstance(one, FringeSet) and (burst := one.burst(1.0)) is not None:
            bytes_each = {name: image_bytes(rig.cameras[name].facts) for name in one.cameras}
            require_memory(burst.frames, bytes_each, "remove `pulses` of the projector from the rig file")


def quietly(what: Callable[[], None]) -> None:
    """Do what is to be done at the end; a lost link must not hide why the recording ended."""
    with suppress(InstrumentError):
        what()
