"""`sms import frames`: folders of fringe frames become the measurements of a campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from math import degrees
from pathlib import Path
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.cli import output
from sms_jobs.cli.import_options import (
    AddStates,
    CampaignName,
    DryRun,
    FullScale,
    Gain,
    Newer,
    Only,
    Raw,
    ReadNoise,
    RecordedAt,
    SpecimenName,
    Yes,
)
from sms_jobs.cli.import_outcomes import (
    TOLD,
    Outcome,
    confirm,
    existing_campaign,
    row_of,
    tell,
    time_given,
)
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.formats import configuration
from sms_jobs.formats.configuration import CampaignPlan
from sms_jobs.formats.importers.folders import Listing, list_folder
from sms_jobs.formats.importers.frames import Arrangement, arrange, roles_told
from sms_jobs.formats.importers.guess import Guess, guess_layout, with_options
from sms_jobs.formats.importers.inspection import (
    CameraModel,
    Inspected,
    camera_model,
    inspect,
    measurement_of,
    source_hash,
)
from sms_jobs.formats.importers.layout import FrameLayout, layout_of, load_layout
from sms_jobs.jobs.importing import amend_campaign, import_measurement, known_of, with_states
from sms_jobs.jobs.registration import register_campaign
from sms_jobs.records.campaign import Campaign, LoadState, Specimen, Subject
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.views import view_of


@dataclass(frozen=True)
class _Task:
    """What is asked for: where to, and how freely."""

    folder: Path
    campaign: str
    rig: str | None
    specimen: str | None
    plan: Path | None
    recorded_at: datetime | None
    add_states: bool
    newer: bool


def frames(
    folder: Annotated[Path, typer.Argument(help="Folder of the frames; its sub-folders belong to it.")],
    campaign: CampaignName,
    layout: Annotated[Path | None, typer.Option(help="Layout file (TOML); see docs/import.md.")] = None,
    pattern: Annotated[
        str | None,
        typer.Option(help="File names, as {state}/{view}/frame_{number}.bmp; * for anything."),
    ] = None,
    state: Annotated[str | None, typer.Option(help="State, where the names do not say it.")] = None,
    view: Annotated[str | None, typer.Option(help="View, as C1P1, where the names do not say it.")] = None,
    densities: Annotated[
        str | None, typer.Option(help="Fringes across the projector, in order of recording: '16 1'.")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Phase steps of each density.")] = None,
    orientations: Annotated[
        str | None, typer.Option(help="Directions in which the phase grows, in degrees: '0 90'.")
    ] = None,
    shown: Annotated[
        str | None,
        typer.Option(
            "--frames", help="What is recorded, in order: 'fringes gray white'; see docs/import.md."
        ),
    ] = None,
    order: Annotated[
        str | None, typer.Option(help="Of fringe frames, the slowest first: 'orientation density step'.")
    ] = None,
    gray_bits: Annotated[
        int | None, typer.Option("--gray-bits", help="Gray-code patterns an orientation.")
    ] = None,
    direction: Annotated[
        int | None, typer.Option(help="1 if a step adds 2 pi / steps to the phase, -1 if it takes it off.")
    ] = None,
    origin: Annotated[
        str | None, typer.Option(help="Where the first step has the phase --offset-deg: middle or edge.")
    ] = None,
    offset_deg: Annotated[
        float | None,
        typer.Option("--offset-deg", help="Phase of the first step there: 0 for a cosine, -90 for a sine."),
    ] = None,
    full_scale: FullScale = None,
    gain: Gain = None,
    read_noise: ReadNoise = None,
    raw: Raw = None,
    only: Only = None,
    rig: Annotated[str | None, typer.Option(help="Rig of a campaign that is to be made.")] = None,
    specimen: SpecimenName = None,
    plan: Annotated[
        Path | None, typer.Option(help="Test plan of a campaign that is to be made, instead of --rig.")
    ] = None,
    recorded_at: RecordedAt = None,
    add_states: AddStates = False,
    newer: Newer = False,
    print_layout: Annotated[
        bool, typer.Option("--print-layout", help="Print the layout to correct and give back, and end.")
    ] = False,
    dry_run: DryRun = False,
    yes: Yes = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Import folders of fringe frames: TIFF, PNG, BMP, JPEG, PNM or raw.

    What the options do not say is guessed, shown, and asked about. Each state and view is taken as a whole or
    not at all; what is in the archive already is not entered again.

    Example: sms import frames scans --campaign skull --rig desk --densities '16 1' --steps 3 --view C1P1

    Example: sms import frames scans -c skull --print-layout > layout.toml; sms import frames scans -c skull
    --layout layout.toml --yes
    """
    listing = list_folder(folder, only)
    task = _Task(folder, campaign, rig, specimen, plan, time_given(recorded_at), add_states, newer)
    given: dict[str, Any] = {
        "pattern": pattern,
        "state": state,
        "view": view,
        "frames": shown,
        "order": order,
        "sequence.densities": _numbers(densities, "--densities", int),
        "sequence.steps": steps,
        "sequence.orientations_deg": _numbers(orientations, "--orientations", float),
        "gray.bits": gray_bits,
        "phase.direction": direction,
        "phase.origin": origin,
        "phase.offset_deg": offset_deg,
        "camera.full_scale": full_scale,
        "camera.gain": gain,
        "camera.read_noise": read_noise,
        "camera.raw": raw,
    }
    with bootstrap.services(home) as services:
        existing = existing_campaign(services, campaign)
        table = with_options({} if layout is None else load_layout(layout), given)
        guess = guess_layout(listing, table, None if existing is None else existing.sequence)
        if print_layout:
            output.print_text(guess.as_toml())
            return
        named = "the layout" if layout is None else str(layout)
        run = _Import(services, task, listing, layout_of(guess.table, named), existing, _planned(task))
        arrangement = arrange(listing, run.layout)
        wanted = run.wanted(arrangement)
        _preview(listing, guess, run.layout, arrangement)
        if not (yes or dry_run or layout is not None):
            confirm("Is this right?")
        outcome = run.enter(arrangement, wanted, dry_run)
    tell(
        outcome,
        arrangement.left_out,
        as_json=as_json,
        dry_run=dry_run,
        campaign=campaign,
        then="pipeline",
    )


def _numbers(text: str | None, option: str, kind: type) -> tuple[Any, ...] | None:
    if text is None:
        return None
    try:
        return tuple(kind(part) for part in text.replace(",", " ").split())
    except ValueError:
        raise InvalidInput(f"{option} should be numbers with spaces between, not '{text}'") from None


def _planned(task: _Task) -> CampaignPlan | None:
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
    return f"densities {', '.join(map(str, sequence.densities))} x {sequence.steps} steps along {angles} deg"


def _preview(listing: Listing, guess: Guess, layout: FrameLayout, arrangement: Arrangement) -> None:
    """Show on stderr what the files are taken for."""
    for remark in guess.remarks:
        output.say(remark)
    output.say(f"pattern   {layout.pattern.text}")
    output.say(f"fringes   {_fringes(layout.sequence)}")
    output.say(
        f"tuples    {len(arrangement.tuples)}, of {len(layout.roles)} frames each, from "
        f"{len(listing.files)} files"
    )
    complete = next((t for t in arrangement.tuples if not t.faults), None)
    if complete is not None:
        told = list(roles_told(layout, complete))
        output.say(f"frames of {complete.state}/{complete.view}:")
        for name, what in told if len(told) <= 2 * TOLD else [*told[:TOLD], ("...", ""), *told[-3:]]:
            output.say(f"  {name}  {what}")


@dataclass(frozen=True)
class _Import:
    """Frames of a folder on their way into a campaign: the one that is there, a planned one, or a new one."""

    services: Services
    task: _Task
    listing: Listing
    layout: FrameLayout
    existing: Campaign | None
    plan: CampaignPlan | None

    def wanted(self, arrangement: Arrangement) -> Campaign:
        """Return the campaign as it has to be; raise where what there is contradicts the files."""
        task, layout = self.task, self.layout
        if not arrangement.tuples:
            raise InvalidInput(
                f"no file of {task.folder} fits the pattern '{layout.pattern.text}': give another "
                "--pattern; '--print-layout' shows the guess"
            )
        known = self._known()
        if known is None:
            if task.rig is None:
                raise InvalidInput(
                    f"there is no campaign {task.campaign} yet: name the rig that measured, as --rig desk, "
                    "or give its --plan; 'sms calibration list' shows rigs"
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
        unknown = [p for p in arrangement.views if p not in known.views]
        if unknown:
            raise InvalidInput(
                f"campaign {known.name} has no view {', '.join(unknown)}; it has {', '.join(known.views)}"
            )
        if layout.sequence != known.sequence:
            raise InvalidInput(
                f"campaign {known.name} is measured with {_fringes(known.sequence)}, but the layout has "
                f"{_fringes(layout.sequence)}: import into another campaign"
            )
        added = [label for label in arrangement.labels if label not in {s.label for s in known.states}]
        if added and not task.add_states:
            raise InvalidInput(
                f"campaign {known.name} has no state {', '.join(added[:5])}: say --add-states to add "
                f"{len(added)}, take others by --only, or map them to its own under [states] of a layout"
            )
        return with_states(known, added)

    def _known(self) -> Campaign | None:
        """Return what is known of the campaign besides the files."""
        return self.plan.campaign if self.existing is None and self.plan is not None else self.existing

    def enter(self, arrangement: Arrangement, wanted: Campaign, dry_run: bool) -> Outcome:
        """Read everything, then enter what has no fault, and say what became of each tuple."""
        inspected = _inspect_all(self.listing, self.layout, arrangement)
        good = [one for one in inspected if not one.found.faults]
        remarks = list(dict.fromkeys(r for one in good for r in one.remarks))
        outcome = Outcome([], remarks)
        camera = camera_model(self.listing.folder, good, self.layout) if good else None
        if camera is not None:
            remarks += camera.remarks
        remarks += self._calibrated_otherwise(wanted.rig, good)
        if good and not dry_run:
            self._prepare(wanted)
        with output.progress_bar() as bar:
            step = bar.add_task("importing", total=len(inspected))
            for one in inspected:
                if one.found.faults:
                    outcome.rows.append(row_of(one, "refused", "; ".join(one.found.faults)))
                else:
                    assert camera is not None
                    outcome.rows.append(self._enter(camera, one, dry_run))
                bar.advance(step)
        return outcome

    def _calibrated_otherwise(self, rig: str, good: Sequence[Inspected]) -> list[str]:
        """Say which cameras the newest calibration of the rig knows with images of another size."""
        with self.services.catalogue.reading() as session:
            views = [v for v in search.list_calibrations(session, rig) if not v.inactive]
        if not views:
            return []
        with self.services.archive.open(views[0]) as dataset:
            known = {s.name: s for s in dataset.read("calibration", Calibration).rig.sensors}
        told: dict[str, None] = {}
        for one in good:
            camera = view_of(one.found.view).camera
            about, sensor = next(iter(one.facts.values())), known.get(camera)
            if sensor and (about.columns, about.rows) != (sensor.columns, sensor.rows):
                remark = (
                    f"{camera} of rig {rig} is calibrated for {sensor.columns} x {sensor.rows} px, and these "
                    f"frames have {about.columns} x {about.rows}: shape needs a calibration of that size"
                )
                told[remark] = None
        return list(told)

    def _prepare(self, wanted: Campaign) -> None:
        catalogue, archive, now = self.services.catalogue, self.services.archive, datetime.now(UTC)
        if self.existing is not None:
            if wanted != self.existing:
                amend_campaign(catalogue, archive, self.existing, wanted, now)
        elif self.plan is not None:
            register_campaign(catalogue, archive, wanted, self.plan.calibration, now, self.plan.text)
        else:
            register_campaign(catalogue, archive, wanted, None, now)

    def _enter(self, camera: CameraModel, one: Inspected, dry_run: bool) -> dict[str, Any]:
        task, catalogue, archive = self.task, self.services.catalogue, self.services.archive
        subject = Subject(task.campaign, one.found.state, one.found.view)
        digest = source_hash(one, self.layout)
        known = known_of(catalogue, archive, subject, digest)
        if known.status == "there":
            return row_of(one, "already there", known.path)
        if dry_run:
            differs = known.status == "other" and not task.newer
            detail = "it has another measurement already: say --newer" if differs else ""
            return row_of(one, "refused" if differs else "would be imported", detail)
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
            return row_of(one, "refused", str(error))
        return row_of(one, "imported", done.path)


def _inspect_all(listing: Listing, layout: FrameLayout, arrangement: Arrangement) -> list[Inspected]:
    """Read every file once, before anything is written."""
    with output.progress_bar() as bar:
        step = bar.add_task("reading", total=sum(len(t.files) for t in arrangement.tuples))
        return [
            inspect(listing.folder, t, layout.raw, layout.full_scale, lambda: bar.advance(step))
            for t in arrangement.tuples
        ]


def _sources(task: _Task, listing: Listing, one: Inspected, layout: FrameLayout) -> Mapping[str, Any]:
    """Return what the provenance tells besides the hash: where from, and which file is what."""
    told = dict(roles_told(layout, one.found))
    return {
        "folder": str(listing.folder),
        "pattern": layout.pattern.text,
        "time_from": "given" if task.recorded_at else "files",
        "texture_from": "white frame" if one.found.white else "mean of the fringe frames",
        "remarks": list(one.remarks),
        "files": [
            {"name": name, "sha256": one.facts[name].sha256, "shows": told.get(name, "black")}
            for name in dict.fromkeys(one.found.files)
        ],
    }
