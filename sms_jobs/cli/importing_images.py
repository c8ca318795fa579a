"""`sms import images`: images of a camera without a projector become the states of a campaign."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.cli import output
from sms_jobs.cli.image_entry import EnteredImages, GivenCamera, arranged, inspect_images, make_campaign
from sms_jobs.cli.import_options import (
    AddStates,
    Cameras,
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
from sms_jobs.cli.import_outcomes import TOLD, confirm, existing_campaign, tell, time_given
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.folders import list_folder
from sms_jobs.formats.importers.frames import Arrangement
from sms_jobs.formats.importers.image_files import RawFormat
from sms_jobs.formats.importers.image_sets import named_cameras
from sms_jobs.jobs.importing import with_states
from sms_jobs.records.campaign import Campaign, LoadState, Specimen


def images(
    folder: Annotated[Path, typer.Argument(help="Folder of the images; its sub-folders belong to it.")],
    campaign: CampaignName,
    pattern: Annotated[
        str | None, typer.Option(help="File names, as {camera}/load_{state}.tif; * for anything.")
    ] = None,
    cameras: Cameras = None,
    camera: Annotated[str | None, typer.Option(help="Camera, where the names do not say it: C1.")] = None,
    reference: Annotated[
        str | None, typer.Option(help="State that displacements start from; the first if not given.")
    ] = None,
    only: Only = None,
    rig: Annotated[str, typer.Option(help="Rig of a campaign that is to be made.")] = "camera",
    specimen: SpecimenName = None,
    recorded_at: RecordedAt = None,
    full_scale: FullScale = None,
    gain: Gain = None,
    read_noise: ReadNoise = None,
    raw: Raw = None,
    add_states: AddStates = False,
    newer: Newer = False,
    dry_run: DryRun = False,
    yes: Yes = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Import images of a camera alone, one a state: TIFF, PNG, BMP, JPEG, PNM or raw.

    They are what displacement and strain in the image are found from. Each state is taken as a whole or not
    at all; what is in the archive already is not entered again.

    Example: sms import images coupon -c coupon --pattern 'oht_cfrp_{state}.tiff'; sms job submit
    pipeline -c coupon
    """
    listing = list_folder(folder, only)
    at = time_given(recorded_at)
    settings = GivenCamera(None if raw is None else RawFormat.parse(raw), full_scale, gain, read_noise)
    named = named_cameras(cameras)
    text, arrangement = arranged(listing, pattern, camera, reference, named)
    with bootstrap.services(home) as services:
        existing = existing_campaign(services, campaign)
        wanted = _wanted(existing, campaign, rig, specimen, arrangement, add_states)
        _preview(text, arrangement)
        if pattern is None and not (yes or dry_run):
            confirm("Is this right?")
        inspected = inspect_images(listing, arrangement, settings)
        good = [one for one in inspected if not one.found.faults]
        if good and not dry_run:
            make_campaign(services, existing, wanted)
        enter = EnteredImages(services, campaign, listing, settings, at, newer, dry_run)
        outcome = enter.all_of(inspected)
    tell(
        outcome,
        arrangement.left_out,
        as_json=as_json,
        dry_run=dry_run,
        campaign=campaign,
        then="pipeline",
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
    wanted = with_states(existing, arrangement.labels)
    added = [s.label for s in wanted.states[len(existing.states) :]]
    if added and not add_states:
        raise InvalidInput(
            f"campaign {name} has no state {', '.join(added[:5])}: say --add-states to add {len(added)}"
        )
    return wanted


def _preview(text: str, arrangement: Arrangement) -> None:
    output.say(f"pattern   {text}")
    output.say(f"reference {arrangement.states[0]}")
    for one in arrangement.tuples[:TOLD]:
        output.say(f"  {one.white}  state {one.state}, camera {one.view}")
    if len(arrangement.tuples) > TOLD:
        output.say(f"  and {len(arrangement.tuples) - TOLD} more")
