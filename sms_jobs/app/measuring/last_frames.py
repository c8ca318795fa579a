"""The newest frame of a recording: while it goes on, after it broke off, and once it is sealed."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.errors import NotFound
from sms_jobs.jobs.recording import recordings
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.records.job import SHORT_ID
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import FileView
from sms_jobs.records.shown.last_frames import LastFrame
from sms_jobs.records.subject import Subject

_PICTURE_PX = 480


@use_case(Right.READ)
def last_frame(services: Services, job: str) -> LastFrame:
    """Return what is known of the newest frame of a recording: how much saturates, what channels read.

    Parameters
    ----------
    job
        Beginning of its job's id.

    Raises
    ------
    NotFound
        There is no such job, or no frame of it in the spool of this host or the archive.
    InvalidInput
        It is no recording.
    ArchiveCorrupt
        A sealed frame is not what was sealed.
    """
    found = _newest(services, job)
    rows, columns = found.image.shape
    return LastFrame(
        found.job,
        found.view,
        found.number,
        found.frames,
        found.taken_at,
        rows,
        columns,
        float(np.mean(found.image >= found.full_scale)),
        found.channels,
        found.sealed,
    )


@use_case(Right.READ)
def last_picture(services: Services, job: str) -> bytes:
    """Return the newest frame of a recording as a small PNG, saturated pixels red; raises as `last_frame`."""
    from sms_jobs.formats.frame_pictures import frame_as_png

    found = _newest(services, job)
    return frame_as_png(found.image, found.full_scale, _PICTURE_PX)


@dataclass(frozen=True)
class _Newest:
    """A frame, wherever it lies; see `LastFrame`."""

    job: str
    view: str
    number: int
    frames: int
    taken_at: datetime
    channels: dict[str, float]
    sealed: bool
    image: NDArray[Any]
    full_scale: float


def _newest(services: Services, prefix: str) -> _Newest:
    from sms_jobs.instruments.last_frames import newest_frame

    with services.catalogue.reading() as session:
        job = recordings.recording_row(session, prefix).id
        sealed = [one for one in search.files_of_job(session, job) if one.source == MEASUREMENT]
    # The spool is emptied once everything is sealed.
    found = newest_frame(services.stations.spool_of(job))
    if found is not None:
        place = (found.view, found.number, found.frames, found.taken_at)
        return _Newest(job, *place, found.channels, False, found.image, found.full_scale)
    if not sealed:
        raise NotFound(
            f"no frame of recording {job[:SHORT_ID]} is in the spool of this host or in the archive; "
            f"'sms job explain {job[:SHORT_ID]}' shows its status"
        )
    return _sealed(services, job, sealed[-1])


def _sealed(services: Services, job: str, file: FileView) -> _Newest:
    """Return the last frame of a measurement: that in white light, or the image of a camera alone."""
    from sms_jobs.kinds.products import MEASURED, RECORDED

    with services.archive.open(file) as dataset:
        measured = MEASURED.read(dataset)
        recording = RECORDED.read(dataset)
    frames = len(recording.times_s)
    taken_at = measured.recorded_at + timedelta(seconds=float(recording.times_s[-1]))
    view = Subject.parse(file.subject).view or ""
    image, full_scale = measured.texture, measured.full_scale
    return _Newest(job, view, frames, frames, taken_at, recording.readings(), True, image, full_scale)
