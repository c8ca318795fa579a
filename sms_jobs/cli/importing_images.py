"""`sms import images`: images of a camera without a projector become the states of a campaign."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.cli import completion, output
from sms_jobs.cli.import_outcomes import TOLD, Outcome, confirm, existing_campaign, row_of, tell, time_given
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.formats.importers.folders import Listing, NamePattern, list_folder
from sms_jobs.formats.importers.frames import Arrangement, is_image
from sms_jobs.formats.importers.image_files import RawFormat
from sms_jobs.formats.importers.image_sets import (
    ImageCamera,
    arrange_images,
    guess_image_pattern,
    image_hash,
    image_measurement,
    of_one_size,
)
from sms_jobs.formats.importers.inspection import Inspected, full_scale_of, inspect, usual_noise
from sms_jobs.jobs.importing import amend_campaign, import_measurement, known_of, with_states
from sms_jobs.jobs.registration import register_campaign
from sms_jobs.records.campaign import Campaign, LoadState, Specimen, Subject


@dataclass(frozen=True)
class _Camera:
    """What is said of the camera."""

    raw: RawFormat | None
    full_scale: int | None
    gain: float | None
    read_noise: float | None

    def given(self) -> dict[str, float | None]:
        return {"full_scale": self.full_scale, "gain": self.gain, "read_noise": self.read_noise}


def images(
    folder: Annotated[Path, typer.Argument(help="Folder of the images; its sub-folders belong to it.")],
    campaign: Annotated[
        str,
        typer.Option("--campaign", "-c", help="Campaign.", autocompletion=completion.campaign_names),
    ],
    pattern: Annotated[
        str | None, typer.Option(help="File names, as {camera}/load_{state}.tif; * for anything.")
    ] = None,
    camera: Annotated[str | None, typer.Option(help="Camera, where the names do not say it: C1.")] = None,
    reference: Annotated[
        str | None, typer.Option(help="State that displacements start from; the first if not given.")
    ] = None,
    rig: Annotated[str, typer.Option(help="Rig of a campaign that is to be made.")] = "camera",
    specimen: Annotated[str | None, typer.Option(help="Specimen of a campaign that is to be made.")] = None,
    recorded_at: Annotated[
        str | None,
        typer.Option(
            "--recorded-at", help="When, as 2026-05-04T10:00:00+02:00; the files' times if not given."
        ),
    ] = None,
    full_scale: Annotated[
        int | None, typer.Option("--full-scale", help="Grey level at which the camera saturates.", min=1)
    ] = None,
    gain: Annotated[
        float | None, typer.Option(help="Noise variance a grey level of signal.", min=0.0)
    ] = None,
    read_noise: Annotated[
        float | None, typer.Option("--read-noise", help="Noise in the dark, in grey levels.", min=0.0)
    ] = None,
    raw: Annotated[
        str | None, typer.Option(help="Raw files: columns x rows x bits, as 1280x1024x12.")
    ] = None,
    add_states: Annotated[
        bool, typer.Option("--add-states", help="Give the campaign states that it does not have yet.")
    ] = False,
    newer: Annotated[
        bool, typer.Option("--newer", help="Enter a state that has another image as its newest.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Read and check everything, and change nothing.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", "-y", help="Do not ask whether the pattern is right.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Import images of a camera alone, one a state: TIFF, PNG, BMP, JPEG, PNM or raw.

    They are what displacement and strain in the image are found from. Each state is taken as a whole or not
    at all; what is in the archive already is not entered again.

    Example: sms import images coupon -c coupon --pattern 'oht_cfrp_{state}.tiff'; sms job submit
    correlate-images strain-images -c coupon
    """
    listing = list_folder(folder)
    at = time_given(recorded_at)
    settings = _Camera(None if raw is None else RawFormat.parse(raw), full_scale, gain, read_noise)
    names = [name for name in listing.files if is_image(name)]
    if not names:
        raise InvalidInput(
            f"{folder} has no image among {len(listing.files)} files: give the folder of the images"
        )
    text = pattern or guess_image_pattern(names)
    arrangement = arrange_images(listing, NamePattern.parse(text), camera, reference)
    if not arrangement.tuples:
        raise InvalidInput(f"no file of {folder} fits the pattern '{text}': give another --pattern")
    with bootstrap.services(home) as services:
        existing = existing_campaign(services, campaign)
        wanted = _wanted(existing, campaign, rig, specimen, arrangement, add_states)
        _preview(text, arrangement)
        if pattern is None and not (yes or dry_run):
            confirm("Is this right?")
        inspected = _inspect_all(listing, arrangement, settings)
        good = [one for one in inspected if not one.found.faults]
        if good and not dry_run:
            _prepare(services, existing, wanted)
        enter = _Entering(services, campaign, listing, settings, at, newer, dry_run)
        outcome = enter.all_of(inspected)
    tell(
        outcome,
        arrangement.left_out,
        as_json=as_json,
        dry_run=dry_run,
        campaign=campaign,
        then="correlate-images strain-images",
    )


def _wanted(
    existing: Campaign | None,
    name: str,
    rig: str,
    specimen: str | None,
    arrangement: Arrangement,
    add_states: bool,
) -> Campaign:
    """Return the campaign as it has to be; raise where what there is contradicts the files."""
    labels = arrangement.states
    if existing is None:
        return Campaign(
            name=name,
            specimen=Specimen(specimen or name),
            rig=rig,
            states=tuple(LoadState(t.state) for t in _first_of_each(arrangement)) or (LoadState("S00"),),
            pairs=arrangement.pairs,
        )
    unknown = [p for p in arrangement.pairs if p not in existing.pairs]
    if unknown:
        raise InvalidInput(
            f"campaign {name} has no camera {', '.join(unknown)} by itself; it has "
            f"{', '.join(existing.pairs)}"
        )
    wanted = with_states(existing, labels)
    added = [s.label for s in wanted.states[len(existing.states) :]]
    if added and not add_states:
        raise InvalidInput(
            f"campaign {name} has no state {', '.join(added[:5])}: say --add-states to add {len(added)}"
        )
    return wanted


def _first_of_each(arrangement: Arrangement) -> list[Any]:
    """Return one tuple of each state whose label can be one."""
    found: dict[str, Any] = {}
    for one in arrangement.tuples:
        if not any("cannot be the name" in fault for fault in one.faults):
            found.setdefault(one.state, one)
    return list(found.values())


def _preview(text: str, arrangement: Arrangement) -> None:
    output.say(f"pattern   {text}")
    output.say(f"reference {arrangement.states[0]}")
    for one in arrangement.tuples[:TOLD]:
        output.say(f"  {one.white}  state {one.state}, camera {one.pair}")
    if len(arrangement.tuples) > TOLD:
        output.say(f"  and {len(arrangement.tuples) - TOLD} more")


def _inspect_all(listing: Listing, arrangement: Arrangement, camera: _Camera) -> list[Inspected]:
    """Read every file once, before anything is written."""
    with output.progress_bar() as bar:
        step = bar.add_task("reading", total=len(arrangement.tuples))
        return of_one_size(
            [
                inspect(listing.folder, one, camera.raw, camera.full_scale, lambda: bar.advance(step))
                for one in arrangement.tuples
            ]
        )


def _prepare(services: Services, existing: Campaign | None, wanted: Campaign) -> None:
    now = datetime.now(UTC)
    if existing is None:
        register_campaign(services.catalogue, services.archive, wanted, None, now)
    elif wanted != existing:
        amend_campaign(services.catalogue, services.archive, existing, wanted, now)


@dataclass(frozen=True)
class _Entering:
    """Enters images one after the other."""

    services: Services
    campaign: str
    listing: Listing
    settings: _Camera
    recorded_at: datetime | None
    newer: bool
    dry_run: bool

    def all_of(self, inspected: list[Inspected]) -> Outcome:
        """Enter all that have no fault, and say what became of each."""
        good = [one for one in inspected if not one.found.faults]
        remarks = list(dict.fromkeys(r for one in good for r in one.remarks))
        camera = self._camera(good, remarks) if good else None
        rows = []
        with output.progress_bar() as bar:
            step = bar.add_task("importing", total=len(inspected))
            for one in inspected:
                if one.found.faults or camera is None:
                    rows.append(row_of(one, "refused", "; ".join(one.found.faults)))
                else:
                    rows.append(self._one(one, camera))
                bar.advance(step)
        return Outcome(rows, remarks)

    def _camera(self, good: list[Inspected], remarks: list[str]) -> ImageCamera:
        given = self.settings
        facts = [about for one in good for about in one.facts.values()]
        full_scale = given.full_scale or full_scale_of(facts, given.raw, remarks)
        gain, read_noise = given.gain, given.read_noise
        if gain is None or read_noise is None:
            usual = usual_noise(full_scale, remarks)
            gain = usual.gain if gain is None else gain
            read_noise = usual.read_noise if read_noise is None else read_noise
        return ImageCamera(full_scale, gain, read_noise)

    def _one(self, one: Inspected, camera: ImageCamera) -> dict[str, Any]:
        subject = Subject(self.campaign, one.found.state, one.found.pair)
        digest = image_hash(one, self.settings.given())
        known = known_of(self.services.catalogue, self.services.archive, subject, digest)
        if known.status == "there":
            return row_of(one, "already there", known.path)
        if self.dry_run:
            differs = known.status == "other" and not self.newer
            detail = "it has another image already: say --newer" if differs else ""
            return row_of(one, "refused" if differs else "would be imported", detail)
        at = self.recorded_at or one.recorded_at
        try:
            done = import_measurement(
                self.services.catalogue,
                self.services.archive,
                subject,
                image_measurement(self.listing.folder, one, self.settings.raw, camera, at),
                digest,
                {
                    "folder": str(self.listing.folder),
                    "time_from": "given" if self.recorded_at else "files",
                    "remarks": list(one.remarks),
                    "files": [
                        {"name": name, "sha256": about.sha256, "shows": "image"}
                        for name, about in one.facts.items()
                    ],
                },
                datetime.now(UTC),
                newer=self.newer,
            )
        except (Conflict, InvalidInput) as error:
            return row_of(one, "refused", str(error))
        return row_of(one, "imported", done.path)
