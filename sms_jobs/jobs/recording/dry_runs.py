"""What recording some states of a campaign would take, and what is missing for it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive
from sms_jobs.catalogue.campaigns import definition
from sms_jobs.catalogue.tables.campaigns import CampaignRow, RigRow
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.instruments.kept_sets import frames_of
from sms_jobs.instruments.recording_sets import Adaptation, Patterns
from sms_jobs.instruments.rehearsal import BYTES_A_PIXEL, rehearse, ways
from sms_jobs.jobs.devices.disks import free_bytes
from sms_jobs.jobs.recording.lacking import lacking
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.kinds.recording.acquire import ANGLES, KIND, AcquireParameters, stage_angles
from sms_jobs.kinds.recording.adaptation import QUICK
from sms_jobs.metrology.geometry.stage_poses import StagePose
from sms_jobs.records.shown.rehearsals import DryRun, StateRehearsal
from sms_jobs.records.views import view_of

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign, LoadState
    from sms_jobs.records.optical_instruments import RigFile

_RECENT = 50
"""So many of the rig's last measurements tell how well its frames are packed."""
_UNPACKED = {True: 1.0, False: 2.0}
"""With fringes and without: an image alone lies in its file as texture and as frame."""


def dry_run(
    session: Session,
    rig: RigFile,
    campaign: Campaign,
    states: Sequence[LoadState],
    spool: Path,
    archive: Archive,
) -> DryRun:
    """Return what recording some states of a campaign with a rig would take; nothing is moved or asked.

    Parameters
    ----------
    spool, archive
        The folder and the archive whose disks are to hold the frames.
    """
    parameters = KIND.checked_parameters(campaign.processing.get(KIND.name, {}))
    missing = lacking(rig, campaign, campaign.recordings)
    rehearsed: dict[str, StateRehearsal] = {}
    shown: dict[str, str] = {}
    if not missing:
        poses = [_pose(s) for s in states]
        as_planned = Adaptation(QUICK, lambda projector, quick: Patterns(campaign.sequence))
        found = rehearse(
            rig,
            campaign.recordings,
            campaign.sequence,
            poses,
            parameters.texture_exposure,
            None if parameters.adaptive == "none" else as_planned,
        )
        rehearsed = {s.label: r for s, r in zip(states, found, strict=True)}
        shown = ways(rig, campaign.recordings, campaign.sequence)
        missing += [f"{label}: {r.problem}" for label, r in rehearsed.items() if r.problem]
    # A set that is recorded again lies beside the one that it replaces.
    again = parameters.recordings > 1
    spool_bytes = max((s.raw_bytes + again * s.set_bytes for s in rehearsed.values()), default=0)
    done = DryRun(
        rehearsed,
        _mixed(rig, campaign, _packed(session, rig)),
        spool_bytes,
        free_bytes(spool),
        archive.room().free_bytes,
        tuple(missing),
        (*_remarks(rig, states), *_adapted(parameters)),
        _mixed(rig, campaign, _UNPACKED) or 1.0,
        shown,
    )
    needed = ("spool", spool_bytes, done.spool_room), ("archive", done.archived_bytes, done.archive_room)
    full = [
        f"the disk of the {disk} has room for {room / 1e9:.1f} GB, and {needs / 1e9:.1f} GB are needed: free "
        "some space"
        for disk, needs, room in needed
        if needs > room
    ]
    return replace(done, missing=(*done.missing, *full))


def _pose(state: LoadState) -> StagePose | None:
    angles = stage_angles(state)
    return None if angles is None else StagePose(*angles)


def _adapted(parameters: AcquireParameters) -> Iterator[str]:
    if parameters.adaptive == "exposures":
        yield "the exposures are chosen at the rig, and those of the plan are counted: up to 8 may come of it"


def _remarks(rig: RigFile, states: Sequence[LoadState]) -> tuple[str, ...]:
    """Tell which values of the plan no channel will confirm."""
    measured = {c.name for c in rig.serial.channels}
    planned = {"load_n" for s in states if s.load_n is not None} | {n for s in states for n in s.channels}
    unread = sorted(planned - measured - set(ANGLES))
    if not unread:
        return ()
    return (f"the plan says what {' and '.join(unread)} will be, which no channel of rig {rig.name} reads",)


def _mixed(rig: RigFile, campaign: Campaign, ratios: Mapping[bool, float]) -> float | None:
    """Return a ratio of packing for the views of a campaign; None where it is not known of a sort of them."""
    sizes = _image_bytes(rig)
    raw: Counter[bool] = Counter()
    for name in campaign.recordings:
        view = view_of(name)
        raw[bool(view.projectors)] += frames_of(name, campaign.sequence) * sizes.get(view.camera, 0)
    if not raw.total() or any(fringes not in ratios for fringes in raw):
        return None
    return sum(ratios[fringes] * count for fringes, count in raw.items()) / raw.total()


def _image_bytes(rig: RigFile) -> dict[str, int]:
    return {c.name: c.rows * c.columns * BYTES_A_PIXEL for c in rig.cameras}


def _packed(session: Session, rig: RigFile) -> dict[bool, float]:
    """Return what recordings of a rig took in the archive, as a fraction of their raw frames.

    For those with fringes, True, and without, False, as far as there are any.
    """
    sizes = _image_bytes(rig)
    rows = session.execute(
        select(FileRow.size_bytes, FileRow.view, CampaignRow.id)
        .join(CampaignRow, CampaignRow.id == FileRow.campaign_id)
        .join(RigRow, RigRow.id == CampaignRow.rig_id)
        .join(JobRow, JobRow.id == FileRow.job_id)
        .where(
            RigRow.name == rig.name,
            FileRow.view.is_not(None),
            FileRow.source == MEASUREMENT,
            JobRow.kind == KIND.name,
        )
        .order_by(FileRow.id.desc())
        .limit(_RECENT)
    ).all()
    sequences = {
        row.id: definition(row).sequence
        for row in session.scalars(select(CampaignRow).where(CampaignRow.id.in_({r[2] for r in rows})))
    }
    raw: Counter[bool] = Counter()
    packed: Counter[bool] = Counter()
    for size_bytes, name, campaign_id in rows:
        view = view_of(name)
        if view.camera in sizes:
            fringes = bool(view.projectors)
            raw[fringes] += frames_of(str(view), sequences[campaign_id]) * sizes[view.camera]
            packed[fringes] += size_bytes
    return {fringes: packed[fringes] / raw[fringes] for fringes in raw}
