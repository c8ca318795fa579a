"""`sms import images`: images of a camera without a projector become the states of a campaign."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.importing.images import Arranged, Camera, Task, arrange_images, enter
from sms_jobs.cli import output
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
from sms_jobs.cli.import_outcomes import MOST_SHOWN, confirm, tell_outcome, time_given
from sms_jobs.cli.output import Home, Json


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
    at = time_given(recorded_at)
    task = Task(
        folder,
        campaign,
        only=only,
        pattern=pattern,
        cameras=cameras,
        camera=camera,
        reference=reference,
        rig=rig,
        specimen=specimen,
        add_states=add_states,
        made_by=Camera(raw, full_scale, gain, read_noise),
    )
    with bootstrap.services(home) as services:
        found = arrange_images(services, task)
        _preview(found)
        if pattern is None and not (yes or dry_run):
            confirm("Is this right?")
        with output.followed(output.progress_bar()) as tell:
            outcome = enter(services, found, recorded_at=at, newer=newer, dry_run=dry_run, tell=tell)
    tell_outcome(outcome, as_json=as_json, dry_run=dry_run, campaign=campaign, then="pipeline")


def _preview(found: Arranged) -> None:
    arrangement = found.arrangement
    output.say(f"pattern   {found.pattern}")
    output.say(f"reference {arrangement.states[0]}")
    for one in arrangement.tuples[:MOST_SHOWN]:
        output.say(f"  {one.white}  state {one.state}, camera {one.view}")
    if len(arrangement.tuples) > MOST_SHOWN:
        output.say(f"  and {len(arrangement.tuples) - MOST_SHOWN} more")
