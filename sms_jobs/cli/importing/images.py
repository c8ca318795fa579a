"""`sms import images`: images of one camera, or of several, become the states of a campaign."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, TypeAlias

import typer

from sms_jobs import bootstrap
from sms_jobs.cli import bars, output
from sms_jobs.cli.importing.options import (
    AddStates,
    Cameras,
    CampaignName,
    DryRun,
    Folder,
    FullScale,
    Gain,
    LoneCamera,
    Newer,
    Only,
    Raw,
    ReadNoise,
    RecordedAt,
    SpecimenName,
    Yes,
)
from sms_jobs.cli.importing.outcomes import MOST_SHOWN, confirm, tell_outcome, time_given
from sms_jobs.cli.output import Home, Json

if TYPE_CHECKING:
    from sms_jobs.app.importing.images import Arranged

Pattern: TypeAlias = Annotated[
    str | None, typer.Option(help="File names, as {camera}/load_{state}.tif; * for anything.")
]
Views: TypeAlias = Annotated[
    str | None, typer.Option(help="Which cameras measure together, as 'C1C2 C2C3'; all if not given.")
]
Alone: TypeAlias = Annotated[
    bool, typer.Option("--alone", help="Each camera measures alone, in the plane of its image.")
]
Reference: TypeAlias = Annotated[
    str | None, typer.Option(help="State that displacements start from; the first if not given.")
]
NewRig: TypeAlias = Annotated[
    str | None, typer.Option(help="Rig of a campaign that is to be made; camera if not given.")
]


def images(
    folder: Folder,
    campaign: CampaignName,
    pattern: Pattern = None,
    cameras: Cameras = None,
    camera: LoneCamera = None,
    views: Views = None,
    alone: Alone = False,
    reference: Reference = None,
    only: Only = None,
    rig: NewRig = None,
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
    """Import images, one a state and camera: TIFF, PNG, BMP, JPEG, PNM or raw.

    From those of one camera displacement and strain in the image are found. Several measure together, in the
    world: C1C2 has results over the pixels of C1, the first that --cameras names. A state that lacks an image
    of one of them is not taken; what is in the archive already is not entered again.

    Example: sms import images coupon -c coupon --pattern 'oht_cfrp_{state}.tiff'

    Example: sms import images panel -c panel --cameras 'left=C1 right=C2' --rig stereo
    """
    from sms_jobs.app.importing.image_entry import EntryOptions
    from sms_jobs.app.importing.images import Camera, Task, arrange_images, enter

    how = EntryOptions(time_given(recorded_at), newer, dry_run)
    task = Task(
        folder,
        campaign,
        only=only,
        pattern=pattern,
        cameras=cameras,
        camera=camera,
        views=views,
        alone=alone,
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
        with bars.followed(bars.progress_bar()) as tell:
            outcome = enter(services, found, how, tell)
    if as_json:
        outcome = replace(outcome, remarks=(*found.remarks, *outcome.remarks))
    tell_outcome(outcome, as_json=as_json, dry_run=dry_run, campaign=campaign, then="pipeline")


def _preview(found: Arranged) -> None:
    arrangement = found.arrangement
    output.say(f"pattern   {found.pattern}")
    output.say(f"views     {', '.join(found.definition.views)}")
    for remark in found.remarks:
        output.say(f"note: {remark}")
    output.say(f"reference {found.definition.reference.label}")
    for one in arrangement.tuples[:MOST_SHOWN]:
        output.say(f"  {one.white}  state {one.state}, camera {one.view}")
    if len(arrangement.tuples) > MOST_SHOWN:
        output.say(f"  and {len(arrangement.tuples) - MOST_SHOWN} more")
