"""Folders of fringe frames become the measurements of a campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from math import degrees
from pathlib import Path
from typing import Any

from sms_jobs.app.importing.copies import remarks_on_copies
from sms_jobs.app.importing.image_entry import Counted, remarks_on_textures
from sms_jobs.app.importing.outcomes import Outcome, TupleOutcome, existing_campaign, outcome_of
from sms_jobs.app.progress import Tell, nobody
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.formats import configuration
from sms_jobs.formats.configuration import CampaignPlan
from sms_jobs.formats.importers.folders import Listing, list_folder
from sms_jobs.formats.importers.frames import Arrangement, arrange, role_descriptions
from sms_jobs.formats.importers.guess import Guess, guess_layout, with_options
from sms_jobs.formats.importers.inspection import (
    CameraModel,
    Inspected,
    camera_models,
    inspect,
    measurement_of,
    source_hash,
)
from sms_jobs.formats.importers.layout import FrameLayout, layout_of, load_layout
from sms_jobs.jobs.archiving.importing import (
    amend_campaign,
    existing_measurement,
    import_measurement,
    imported_files,
    with_states,
)
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.kinds.products import CALIBRATED
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.people import Right
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import view_of


@dataclass(frozen=True)
class Task:
    """What is asked for: which files, as what, where to, and how freely.

    Attributes
    ----------
    folder
        Of the frames; its sub-folders belong to it.
    only
        Only files whose path below the folder has this form.
    campaign
        That they belong to.
    rig, specimen, plan
        Of a campaign that is to be made: by name, or all of it by the file of its test plan.
    layout
        File that says what the files are; None to guess.
    layout_values
        What of a layout is known otherwise, by table and name as in "phase.origin"; None where it is not.
    recorded_at
        When; the files' times if it is None.
    add_states
        Give the campaign states that it does not have yet.
    newer
        Enter what differs from a measurement that is there as the newest.
    """

    folder: Path
    campaign: str
    only: str | None = None
    rig: str | None = None
    specimen: str | None = None
    plan: Path | None = None
    layout: Path | None = None
    layout_values: Mapping[str, Any] = field(default_factory=dict)
    recorded_at: datetime | None = None
    add_states: bool = False
    newer: bool = False


@dataclass(frozen=True)
class Guessed:
    """What the files of a task may be: a layout, what of it was guessed, and the campaign that is there."""

    task: Task
    listing: Listing
    guess: Guess
    existing: Campaign | None

    @property
    def layout_text(self) -> str:
        """The layout as a file to correct and give back."""
        return self.guess.as_toml()


@use_case(Right.READ)
def guess(services: Services, task: Task) -> Guessed:
    """Say what the files of a folder may be, where it is not given.

    Raises `InvalidInput` for a folder or a layout that cannot be read.
    """
    listing = list_folder(task.folder, task.only)
    existing = existing_campaign(services, task.campaign, task.rig)
    table = with_options({} if task.layout is None else load_layout(task.layout), dict(task.layout_values))
    guessed = guess_layout(listing, table, None if existing is None else existing.sequence)
    return Guessed(task, listing, guessed, existing)


@dataclass(frozen=True)
class Example:
    """A complete tuple: its state and view, and each file with what it shows."""

    state: str
    view: str
    frames: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Arranged:
    """What the files are taken for, and the campaign as it has to be, before anything is entered."""

    guessed: Guessed
    layout: FrameLayout
    arrangement: Arrangement
    plan: CampaignPlan | None
    definition: Campaign

    @property
    def fringes(self) -> str:
        """What is projected, in words."""
        return _fringes(self.layout.sequence)

    @property
    def example(self) -> Example | None:
        """A complete tuple; None where there is none."""
        complete = next((t for t in self.arrangement.tuples if not t.faults), None)
        if complete is None:
            return None
        return Example(complete.state, complete.view, tuple(role_descriptions(self.layout, complete)))


@use_case(Right.READ)
def arrange_frames(services: Services, guessed: Guessed) -> Arranged:
    """Say what each file is taken for, and for which campaign.

    Raises `InvalidInput` where the layout makes no sense, or contradicts the files or the campaign.
    """
    task, listing = guessed.task, guessed.listing
    named = "the layout" if task.layout is None else str(task.layout)
    layout, plan = layout_of(guessed.guess.table, named), _planned(task)
    arrangement = arrange(listing, layout)
    run = _Import(services, task, listing, layout, guessed.existing, plan)
    return Arranged(guessed, layout, arrangement, plan, run.definition(arrangement))


@use_case(Right.COMPUTE)
def enter(services: Services, found: Arranged, *, dry_run: bool = False, tell: Tell = nobody) -> Outcome:
    """Read everything, then enter what has no fault, and say what became of each tuple.

    Each state and view is taken as a whole or not at all; what is in the archive is not entered again.

    Parameters
    ----------
    dry_run
        Read and check everything, and change nothing.
    tell
        Counts files that are read, then tuples that are entered.
    """
    guessed = found.guessed
    run = _Import(services, guessed.task, guessed.listing, found.layout, guessed.existing, found.plan)
    return run.enter(found.arrangement, found.definition, dry_run, tell)


def _planned(task: Task) -> CampaignPlan | None:
    """Return the test plan of a campaign that is to be made; `InvalidInput` for that of another."""
    if task.plan is None:
        return None
    plan = configuration.load_campaign(task.plan)
    if plan.campaign.name != task.campaign:
        raise InvalidInput(
            f"{task.plan} is the plan of campaign {plan.campaign.name}, not of {task.campaign}"
        )
    return plan


def _fringes(sequence: Any) -> str:
    angles = ", ".join(f"{degrees(a):g}" for a in sequence.orientations_rad)
    return f"{sequence.in_words} along {angles} deg"


@dataclass(frozen=True)
class _Import:
    """Frames of a folder on their way into a campaign: the one that is there, a planned one, or a new one."""

    services: Services
    task: Task
    listing: Listing
    layout: FrameLayout
    existing: Campaign | None
    plan: CampaignPlan | None

    def definition(self, arrangement: Arrangement) -> Campaign:
        """Return the campaign as it has to be; raise where what there is contradicts the files."""
        task, layout = self.task, self.layout
        if not arrangement.tuples:
            raise InvalidInput(
                f"no file of {task.folder} fits the pattern '{layout.pattern.text}': give another "
                "`pattern`; printing the layout shows the guess"
            )
        campaign = self._described()
        if campaign is None:
            if task.rig is None:
                raise InvalidInput(
                    f"there is no campaign {task.campaign} yet: name the `rig` that measured, for example "
                    "desk, or give its `plan`; 'sms calibration list' shows rigs"
                )
            return Campaign(
                name=task.campaign,
                specimen=Specimen(task.specimen or task.campaign),
                rig=task.rig,
                states=tuple(LoadState(label, time=task.recorded_at) for label in arrangement.labels)
                or (LoadState("S00"),),
                views=arrangement.views or ("C1P1",),
                sequence=layout.sequence,
            )
        unknown = [p for p in arrangement.views if p not in campaign.recordings]
        if unknown:
            raise InvalidInput(
                f"campaign {campaign.name} has no view {', '.join(unknown)} of which frames are recorded; it "
                f"has {', '.join(campaign.recordings)}"
            )
        if layout.sequence != campaign.sequence:
            raise InvalidInput(
                f"campaign {campaign.name} is measured with {_fringes(campaign.sequence)}, but the layout "
                f"has {_fringes(layout.sequence)}: import into another campaign"
            )
        added = [label for label in arrangement.labels if label not in {s.label for s in campaign.states}]
        if added and not task.add_states:
            raise InvalidInput(
                f"campaign {campaign.name} has no state {', '.join(added[:5])}: set `add_states` to add "
                f"{len(added)}, take other files with `only`, or map them to its own under [states] of a "
                "layout"
            )
        return with_states(campaign, added)

    def _described(self) -> Campaign | None:
        """Return the campaign as the catalogue or its plan describes it; None for a new one."""
        return self.plan.campaign if self.existing is None and self.plan is not None else self.existing

    def enter(self, arrangement: Arrangement, definition: Campaign, dry_run: bool, tell: Tell) -> Outcome:
        """Read everything, then enter what has no fault, and say what became of each tuple."""
        inspected = _inspect_all(self.listing, self.layout, arrangement, tell)
        good = [one for one in inspected if not one.found.faults]
        remarks = list(dict.fromkeys(r for one in good for r in one.remarks))
        models, found = camera_models(good, self.layout) if good else ((), ())
        cameras = {one.found: camera for one, camera in zip(good, models, strict=True)}
        remarks += [*found, *_on_white(good, models)]
        remarks += self._calibrated_otherwise(definition.rig, good)
        known = imported_files(self.services.catalogue, self.services.archive, definition.name)
        remarks += remarks_on_copies(good, known)
        if good and not dry_run:
            self._prepare(definition)
        counted, rows = Counted(tell, "importing", len(inspected)), []
        for one in inspected:
            if one.found.faults:
                rows.append(outcome_of(one, "refused", "; ".join(one.found.faults)))
            else:
                rows.append(self._enter(cameras[one.found], one, dry_run))
            counted.one_more()
        return Outcome(tuple(rows), tuple(remarks), arrangement.left_out)

    def _calibrated_otherwise(self, rig: str, good: Sequence[Inspected]) -> list[str]:
        """Say which cameras the newest calibration of the rig knows with images of another size."""
        with self.services.catalogue.reading() as session:
            views = [v for v in search.list_calibrations(session, rig) if not v.inactive]
        if not views:
            return []
        with self.services.archive.open(views[0]) as dataset:
            sensors = {s.name: s for s in CALIBRATED.read(dataset).rig.sensors}
        remarks: dict[str, None] = {}
        for one in good:
            camera = view_of(one.found.view).camera
            about, sensor = next(iter(one.facts.values())), sensors.get(camera)
            if sensor and (about.columns, about.rows) != (sensor.columns, sensor.rows):
                remark = (
                    f"{camera} of rig {rig} is calibrated for {sensor.columns} x {sensor.rows} px, and these "
                    f"frames have {about.columns} x {about.rows}: shape needs a calibration of that size"
                )
                remarks[remark] = None
        return list(remarks)

    def _prepare(self, definition: Campaign) -> None:
        catalogue, archive, now = self.services.catalogue, self.services.archive, datetime.now(UTC)
        if self.existing is not None:
            if definition != self.existing:
                amend_campaign(catalogue, archive, self.existing, definition, now)
        elif self.plan is not None:
            register_campaign(catalogue, archive, definition, self.plan.calibration, now, self.plan.text)
        else:
            register_campaign(catalogue, archive, definition, None, now)

    def _enter(self, camera: CameraModel, one: Inspected, dry_run: bool) -> TupleOutcome:
        task, catalogue, archive = self.task, self.services.catalogue, self.services.archive
        subject = Subject(task.campaign, one.found.state, one.found.view)
        digest = source_hash(one, self.layout)
        known = existing_measurement(catalogue, archive, subject, digest)
        if known.status == "there":
            return outcome_of(one, "already there", known.path)
        if dry_run:
            differs = known.status == "other" and not task.newer
            detail = "it already has another measurement: set `newer` to use this one" if differs else ""
            return outcome_of(one, "refused" if differs else "would be imported", detail)
        at = task.recorded_at or one.recorded_at
        sources = _sources(task, self.listing, one, self.layout)
        try:
            measurement = measurement_of(self.listing.folder, one, self.layout, camera, at)
            done = import_measurement(
                catalogue,
                archive,
                subject,
                measurement,
                digest,
                sources,
                datetime.now(UTC),
                newer=task.newer,
            )
        except (Conflict, InvalidInput) as error:
            return outcome_of(one, "refused", str(error))
        return outcome_of(one, "imported", done.path)


def _on_white(good: Sequence[Inspected], models: Sequence[CameraModel]) -> list[str]:
    """Return remarks on the white frames, which are the texture."""
    white = [
        (replace(one, facts={one.found.white: one.facts[one.found.white]}), model.full_scale)
        for one, model in zip(good, models, strict=True)
        if one.found.white is not None
    ]
    return remarks_on_textures([one for one, _ in white], [scale for _, scale in white])


def _inspect_all(
    listing: Listing, layout: FrameLayout, arrangement: Arrangement, tell: Tell
) -> list[Inspected]:
    """Read every file once, before anything is written."""
    counted = Counted(tell, "reading", sum(len(t.files) for t in arrangement.tuples))
    known = layout.gain is not None and layout.read_noise is not None
    sequence = None if known else layout.sequence
    return [
        inspect(listing.folder, t, layout.raw, layout.full_scale, counted.one_more, sequence)
        for t in arrangement.tuples
    ]


def _sources(task: Task, listing: Listing, one: Inspected, layout: FrameLayout) -> Mapping[str, Any]:
    """Return what the provenance holds besides the hash: where from, and which file is what."""
    roles = dict(role_descriptions(layout, one.found))
    return {
        "folder": str(listing.folder),
        "pattern": layout.pattern.text,
        "time_from": "given" if task.recorded_at else "files",
        "texture_from": "white frame" if one.found.white else "mean of the fringe frames",
        "remarks": list(one.remarks),
        "files": [
            {"name": name, "sha256": one.facts[name].sha256, "shows": roles.get(name, "black")}
            for name in dict.fromkeys(one.found.files)
        ],
    }
