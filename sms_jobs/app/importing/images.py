"""Images of cameras, which measure together or each alone, become the states of a campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from sqlalchemy.orm import Session

from sms_jobs.app.importing.image_entry import (
    CameraSettings,
    EnteredImages,
    EntryOptions,
    arranged,
    inspect_images,
    make_campaign,
)
from sms_jobs.app.importing.image_views import (
    UsedCalibration,
    Views,
    cameras_together,
    lacking_by_state,
    of_calibrated_size,
    of_whole_states,
    views_asked_for,
    views_of_all,
    with_their_partners,
    without_calibration,
)
from sms_jobs.app.importing.outcomes import Outcome, existing_campaign
from sms_jobs.app.progress import Tell, nobody
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import valid_calibrations
from sms_jobs.catalogue.campaigns import campaign_id
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.folders import LeftOut, Listing, list_folder, printable
from sms_jobs.formats.importers.frames import Arrangement
from sms_jobs.formats.importers.image_files import RawFormat
from sms_jobs.formats.importers.image_sets import named_cameras
from sms_jobs.jobs.archiving.calibrations import known_calibration
from sms_jobs.jobs.archiving.importing import measured_tuples, with_states
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.people import Right
from sms_jobs.records.views import is_view, view_of


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
    views, alone
        Which cameras measure together, as "C1C2 C2C3"; that none do. By default all that can.
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
    views: str | None = None
    alone: bool = False
    reference: str | None = None
    rig: str | None = None
    specimen: str | None = None
    add_states: bool = False
    made_by: Camera = field(default_factory=Camera)

    @property
    def new_rig(self) -> str:
        """The rig of a campaign that is to be made."""
        return self.rig or "camera"


@dataclass(frozen=True)
class Arranged:
    """What the images are taken for, and the campaign as it has to be, before anything is entered.

    Attributes
    ----------
    remarks
        Why the views are these.
    calibrations
        That are used for the campaign, the one that becomes valid first before the others.
    """

    campaign: str
    listing: Listing
    settings: CameraSettings
    pattern: str
    arrangement: Arrangement
    existing: Campaign | None
    definition: Campaign
    remarks: tuple[str, ...]
    calibrations: tuple[UsedCalibration, ...]


@use_case(Right.READ)
def arrange_images(services: Services, task: Task) -> Arranged:
    """Say what each image is taken for, and for which campaign.

    Raises `InvalidInput` for a folder without images, and where names and campaign contradict each other.
    """
    listing = list_folder(task.folder, task.only)
    camera, named = task.made_by, named_cameras(task.cameras)
    raw = None if camera.raw is None else RawFormat.parse(camera.raw)
    settings = CameraSettings(raw, camera.full_scale, camera.gain, camera.read_noise)
    text, arrangement = arranged(listing, task.pattern, task.camera, task.reference, named)
    existing = existing_campaign(services, task.campaign, task.rig)
    with services.catalogue.reading() as session:
        used = _used(session, existing, task.new_rig)
        there = set() if existing is None else measured_tuples(session, existing)
    views = _views(services, task, existing, _in_order(arrangement, named), used)
    arrangement = _of_views(arrangement, views.views, existing)
    campaign = existing or _new(task, arrangement, views.views)
    lacking = lacking_by_state(arrangement, campaign, there)
    arrangement = of_whole_states(arrangement, lacking)
    definition = _definition(existing, campaign, lacking, arrangement, task)
    return Arranged(
        task.campaign, listing, settings, text, arrangement, existing, definition, views.remarks, used
    )


@use_case(Right.COMPUTE)
def enter(services: Services, found: Arranged, how: EntryOptions, tell: Tell = nobody) -> Outcome:
    """Read all images, then enter those without fault, and say what became of each.

    `tell` counts files that are read, then states that are entered.
    """
    inspected = inspect_images(found.listing, found.arrangement, found.settings, tell)
    calibrated = (found.definition, found.calibrations, how.recorded_at)
    inspected = with_their_partners(of_calibrated_size(inspected, *calibrated), found.definition)
    good = [one for one in inspected if not one.found.faults]
    if good and not how.dry_run:
        make_campaign(services, found.existing, found.definition)
    images = EnteredImages(services, found.campaign, found.listing, found.settings, how, tell)
    outcome = images.all_of(inspected)
    remarks = (*outcome.remarks, *without_calibration(inspected, *calibrated))
    return replace(outcome, remarks=remarks, left_out=found.arrangement.left_out)


def _used(session: Session, existing: Campaign | None, rig: str) -> tuple[UsedCalibration, ...]:
    """Return the calibrations that are used for a campaign: one that is there, or a new one of a rig."""
    found = (
        valid_calibrations.used_for_rig_named(session, rig)
        if existing is None
        else valid_calibrations.used_for_campaign(session, campaign_id(session, existing.name))
    )
    return tuple(
        UsedCalibration(
            one.number, one.valid_from, {n: (s["columns"], s["rows"]) for n, s in one.sensors.items()}
        )
        for one in found
    )


def _in_order(arrangement: Arrangement, named: Mapping[str, str]) -> tuple[str, ...]:
    """Return the cameras in the order in which they are named, others by their number."""
    seen = arrangement.views
    return (*(n for n in named.values() if n in seen), *(n for n in seen if n not in named.values()))


def _views(
    services: Services,
    task: Task,
    existing: Campaign | None,
    cameras: tuple[str, ...],
    used: Sequence[UsedCalibration],
) -> Views:
    """Return the views of the campaign; raise `InvalidInput` where it has others than are asked for."""
    if task.alone and task.views is not None:
        raise InvalidInput("`alone` takes each camera by itself, `views` some of them together: give one")
    if existing is not None:
        asked = None if task.views is None else views_asked_for(task.views, existing.recordings).views
        together = cameras_together(existing)
        if (asked is not None and {*asked} != {*existing.views}) or (task.alone and together):
            raise InvalidInput(
                f"campaign {existing.name} has the views {', '.join(existing.views)}, which stay: "
                "leave out `views` and `alone`, or import into another campaign"
            )
        return Views(existing.views)
    if task.views is not None:
        return views_asked_for(task.views, cameras)
    if task.alone:
        return Views(cameras)
    calibration = None
    if len(cameras) > 2 and used:
        number = used[-1].number
        calibration = number, known_calibration(services.catalogue, services.archive, number).calibration
    return views_of_all(cameras, task.new_rig, calibration)


def _of_views(arrangement: Arrangement, views: Sequence[str], existing: Campaign | None) -> Arrangement:
    """Leave out the images of cameras that no view of a new campaign has; an existing one refuses them."""
    recorded = {str(one) for view in views for one in view_of(view).recordings}
    other = [t for t in arrangement.tuples if t.view not in recorded and is_view(t.view)]
    if existing is not None and other:
        names = ", ".join(dict.fromkeys(t.view for t in other))
        raise InvalidInput(
            f"campaign {existing.name} takes no separate images of {names}; its views are "
            f"{', '.join(existing.views)}"
        )
    left_out = [
        LeftOut(name, f"is of {t.view}, which none of the views {', '.join(views)} has")
        for t in other
        for name in t.files
    ]
    taken = tuple(t for t in arrangement.tuples if t not in other)
    return Arrangement(taken, (*arrangement.left_out, *left_out))


def _new(task: Task, arrangement: Arrangement, views: tuple[str, ...]) -> Campaign:
    return Campaign(
        name=task.campaign,
        specimen=Specimen(task.specimen or task.campaign),
        rig=task.new_rig,
        states=tuple(map(LoadState, arrangement.labels)) or (LoadState("S00"),),
        views=views or ("C1",),
    )


def _definition(
    existing: Campaign | None,
    campaign: Campaign,
    lacking: Mapping[str, Sequence[str]],
    arrangement: Arrangement,
    task: Task,
) -> Campaign:
    """Return the campaign as it has to be; raise where what there is contradicts the files."""
    if existing is None:
        reference = campaign.reference.label
        if arrangement.labels and arrangement.states[0] != reference:
            raise InvalidInput(
                f"state {printable(arrangement.states[0])}, which displacements start from, has no name "
                "that a state can have: write another `pattern`, rename its images, or name another state as "
                "the `reference`"
            )
        if reference in lacking:
            raise InvalidInput(
                f"state {reference}, which displacements start from, has no image of "
                f"{' and '.join(lacking[reference])}: add it, name another state as the "
                "`reference`, or set `alone` if the cameras do not measure together"
            )
        return replace(campaign, states=tuple(s for s in campaign.states if s.label not in lacking))
    if task.reference not in (None, existing.reference.label):
        raise InvalidInput(
            f"campaign {existing.name} has the reference {existing.reference.label}, which stays: leave out "
            "`reference`, or import into another campaign"
        )
    definition = with_states(existing, (label for label in arrangement.labels if label not in lacking))
    added = [s.label for s in definition.states[len(existing.states) :]]
    if added and not task.add_states:
        raise InvalidInput(
            f"campaign {existing.name} has no state {', '.join(added[:5])}: set `add_states` to add "
            f"{len(added)}"
        )
    return definition
