"""Images of cameras without a projector become the states of a campaign."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path

from sms_jobs.app.importing.image_entry import (
    EnteredImages,
    GivenCamera,
    arranged,
    inspect_images,
    make_campaign,
)
from sms_jobs.app.importing.outcomes import Outcome, existing_campaign
from sms_jobs.app.progress import Tell, nobody
from sms_jobs.bootstrap import Services
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.folders import Listing, list_folder
from sms_jobs.formats.importers.frames import Arrangement
from sms_jobs.formats.importers.image_files import RawFormat
from sms_jobs.formats.importers.image_sets import named_cameras
from sms_jobs.jobs.importing import with_states
from sms_jobs.records.campaign import Campaign, LoadState, Specimen


@dataclass(frozen=True)
class Camera:
    """What is said of the camera; None for what the files or usual cameras say.

    Attributes
    ----------
    raw
        Columns x rows x bits of raw files, as "1280x1024x12".
    full_scale
        Grey level at which it saturates.
    gain
        Noise variance a grey level of signal.
    read_noise
        In the dark, in grey levels.
    """

    raw: str | None = None
    full_scale: int | None = None
    gain: float | None = None
    read_noise: float | None = None


@dataclass(frozen=True)
class Task:
    """What is asked for: which files, as what, and where to.

    Attributes
    ----------
    folder
        Of the images; its sub-folders belong to it.
    only
        Only files whose path below the folder has this form.
    pattern
        Of the files' names; guessed if it is None.
    cameras, camera
        Cameras by what the names call them, as "left=C1"; and the one that the names do not say.
    reference
        State that displacements start from; the first if it is None.
    campaign
        That they belong to.
    rig, specimen
        Of a campaign that is to be made.
    add_states
        Give the campaign states that it does not have yet.
    made_by
        What is said of the camera.
    """

    folder: Path
    campaign: str
    only: str | None = None
    pattern: str | None = None
    cameras: str | None = None
    camera: str | None = None
    reference: str | None = None
    rig: str = "camera"
    specimen: str | None = None
    add_states: bool = False
    made_by: Camera = field(default_factory=Camera)


@dataclass(frozen=True)
class Arranged:
    """What the images are taken for, and the campaign as it has to be, before anything is entered."""

    campaign: str
    listing: Listing
    settings: GivenCamera
    pattern: str
    arrangement: Arrangement
    existing: Campaign | None
    definition: Campaign


def arrange_images(services: Services, task: Task) -> Arranged:
    """Say what each image is taken for, and for which campaign.

    Raises `InvalidInput` for a folder without images, and where names and campaign contradict each other.
    """
    listing = list_folder(task.folder, task.only)
    camera, named = task.made_by, named_cameras(task.cameras)
    raw = None if camera.raw is None else RawFormat.parse(camera.raw)
    settings = GivenCamera(raw, camera.full_scale, camera.gain, camera.read_noise)
    text, arrangement = arranged(listing, task.pattern, task.camera, task.reference, named)
    existing = existing_campaign(services, task.campaign)
    definition = _definition(existing, task.campaign, task.rig, task.specimen, arrangement, task.add_states)
    return Arranged(task.campaign, listing, settings, text, arrangement, existing, definition)


def enter(
    services: Services,
    found: Arranged,
    *,
    recorded_at: datetime | None = None,
    newer: bool = False,
    dry_run: bool = False,
    tell: Tell = nobody,
) -> Outcome:
    """Read all images, then enter those without fault, and say what became of each.

    Parameters
    ----------
    recorded_at
        When; the files' times if it is None.
    newer
        Enter what differs from an image that is there as the newest.
    dry_run
        Read and check everything, and change nothing.
    tell
        Counts files that are read, then states that are entered.
    """
    inspected = inspect_images(found.listing, found.arrangement, found.settings, tell)
    good = [one for one in inspected if not one.found.faults]
    if good and not dry_run:
        make_campaign(services, found.existing, found.definition)
    images = EnteredImages(
        services, found.campaign, found.listing, found.settings, recorded_at, newer, dry_run, tell
    )
    return replace(images.all_of(inspected), left_out=found.arrangement.left_out)


def _definition(
    existing: Campaign | None,
    name: str,
    rig: str,
    specimen: str | None,
    arrangement: Arrangement,
    add_states: bool,
) -> Campaign:
    """Return the campaign as it has to be; raise where what there is contradicts the files."""
    if existing is None:
        return Campaign(
            name=name,
            specimen=Specimen(specimen or name),
            rig=rig,
            states=tuple(map(LoadState, arrangement.labels)) or (LoadState("S00"),),
            views=arrangement.views or ("C1",),
        )
    unknown = [p for p in arrangement.views if p not in existing.views]
    if unknown:
        raise InvalidInput(
            f"campaign {name} has no camera {', '.join(unknown)} by itself; it has "
            f"{', '.join(existing.views)}"
        )
    definition = with_states(existing, arrangement.labels)
    added = [s.label for s in definition.states[len(existing.states) :]]
    if added and not add_states:
        raise InvalidInput(
            f"campaign {name} has no state {', '.join(added[:5])}: say --add-states to add {len(added)}"
        )
    return definition
