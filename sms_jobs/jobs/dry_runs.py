"""What recording some states of a campaign would take, and what is missing for it."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from sqlalchemy import select
from sqlalchemy.orm import Session

from sms_jobs.archive import Archive
from sms_jobs.catalogue.campaigns import definition
from sms_jobs.catalogue.models import CampaignRow, FileRow, JobRow, RigRow
from sms_jobs.errors import InvalidInput
from sms_jobs.instruments.rehearsal import BYTES_A_PIXEL, rehearse
from sms_jobs.jobs.planning import checked_parameters
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.kinds.recording.acquire import ANGLES, KIND, AcquireParameters, stage_angles
from sms_jobs.metrology.geometry.stage_poses import StagePose
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.optical_instruments import RigFile
from sms_jobs.records.shown.rehearsals import DryRun, StateRehearsal
from sms_jobs.records.views import view_of

_RECENT = 50
"""So many of the rig's last measurements tell how well its frames are packed."""


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
    parameters = checked_parameters(KIND, campaign.processing.get(KIND.name, {}))
    assert isinstance(parameters, AcquireParameters)
    missing = [*_missing_sensors(rig, campaign), *_missing_channels(rig, parameters)]
    rehearsed: dict[str, StateRehearsal] = {}
    if not missing:
        poses = [_pose(s) for s in states]
        found = rehearse(rig, campaign.fringe_views, campaign.sequence, poses, parameters.texture_exposure)
        rehearsed = {s.label: r for s, r in zip(states, found, strict=True)}
        missing += [f"{label}: {r.problem}" for label, r in rehearsed.items() if r.problem]
    # A set that is recorded again lies beside the one that it replaces.
    again = parameters.recordings > 1
    spool_bytes = max((s.raw_bytes + again * s.set_bytes for s in rehearsed.values()), default=0)
    found_room, packed = {"spool": _free(spool), "archive": archive.room().free_bytes}, _packed(session, rig)
    archived = sum(s.raw_bytes for s in rehearsed.values()) * (packed or 1.0)
    for disk, needed in (("spool", spool_bytes), ("archive", archived)):
        if needed > found_room[disk]:
            missing.append(
                f"the disk of the {disk} has room for {found_room[disk] / 1e9:.1f} GB, and "
                f"{needed / 1e9:.1f} GB are needed: free some space"
            )
    return DryRun(
        rehearsed,
        packed,
        spool_bytes,
        found_room["spool"],
        found_room["archive"],
        tuple(missing),
        _remarks(rig, campaign, states),
    )


def _pose(state: LoadState) -> StagePose | None:
    angles = stage_angles(state)
    return None if angles is None else StagePose(*angles)


def _missing_sensors(rig: RigFile, campaign: Campaign) -> Iterator[str]:
    """Tell which sensors the rig lacks, or has with another size."""
    sizes = {c.name: (c.columns, c.rows) for c in rig.cameras}
    sizes |= {p.name: (p.columns, p.rows) for p in rig.projectors}
    if not campaign.fringe_views:
        yield f"campaign {campaign.name} has no projector, and images without fringes are imported"
    names = dict.fromkeys(name for view in campaign.fringe_views for name in view_of(view).sensors)
    for name in names:
        if name not in sizes:
            yield f"the file of rig {rig.name} has no {name}; it has {', '.join(sizes) or 'none'}"
    expected = () if campaign.session is None else campaign.session.sensors
    for sensor in expected:
        found = sizes.get(sensor.name)
        if found is not None and found != (sensor.columns, sensor.rows):
            yield (
                f"{sensor.name} has {found[0]} x {found[1]} px in the file of rig {rig.name}, and "
                f"{sensor.columns} x {sensor.rows} px in the plan: correct one of them"
            )


def _missing_channels(rig: RigFile, parameters: AcquireParameters) -> Iterator[str]:
    try:
        parameters.limits().require_channels(rig.name, [c.name for c in rig.serial.channels])
    except InvalidInput as error:
        yield str(error)


def _remarks(rig: RigFile, campaign: Campaign, states: Sequence[LoadState]) -> tuple[str, ...]:
    """Tell which cameras are not recorded, and which values of the plan no channel will confirm."""
    alone = tuple(
        f"{camera} looks on without a projector: its images are imported, not recorded"
        for camera in campaign.recordings
        if camera not in campaign.fringe_views
    )
    measured = {c.name for c in rig.serial.channels}
    planned = {"load_n" for s in states if s.load_n is not None} | {n for s in states for n in s.channels}
    unread = sorted(planned - measured - set(ANGLES))
    if not unread:
        return alone
    words = f"the plan says what {' and '.join(unread)} will be, which no channel of rig {rig.name} reads"
    return (*alone, words)


def _packed(session: Session, rig: RigFile) -> float | None:
    """Return what recordings of a rig took in the archive, as a fraction of their raw frames."""
    sizes = {c.name: c.rows * c.columns * BYTES_A_PIXEL for c in rig.cameras}
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
    frames = {
        row.id: definition(row).sequence.frames + 1
        for row in session.scalars(select(CampaignRow).where(CampaignRow.id.in_({r[2] for r in rows})))
    }
    raw = packed = 0
    for size_bytes, view, campaign_id in rows:
        camera = view_of(view).camera
        raw += frames[campaign_id] * sizes.get(camera, 0)
        packed += size_bytes if camera in sizes else 0
    return packed / raw if raw else None


def _free(folder: Path) -> int:
    """Return what is free on the disk of a folder that may not be there yet."""
    there = next(p for p in (folder, *folder.parents) if p.exists())
    return shutil.disk_usage(there).free
