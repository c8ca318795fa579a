"""`sms import frames`: folders of fringe frames become the measurements of a campaign."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from sms_jobs import bootstrap
from sms_jobs.cli import bars, output
from sms_jobs.cli.importing.options import (
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
from sms_jobs.cli.importing.outcomes import MOST_SHOWN, confirm, tell_outcome, time_given
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.records.sizes import number_of

if TYPE_CHECKING:
    from sms_jobs.app.importing.frames import Arranged, Task

Folder: TypeAlias = Annotated[
    Path, typer.Argument(help="Folder of the frames; its sub-folders belong to it.")
]
LayoutFile: TypeAlias = Annotated[Path | None, typer.Option(help="Layout file (TOML); see docs/import.md.")]
Pattern: TypeAlias = Annotated[
    str | None,
    typer.Option(help="File names, as {state}/{view}/frame_{number}.bmp; * for anything."),
]
State: TypeAlias = Annotated[str | None, typer.Option(help="State, where the names do not say it.")]
View: TypeAlias = Annotated[str | None, typer.Option(help="View, as C1P1, where the names do not say it.")]
Densities: TypeAlias = Annotated[
    str | None, typer.Option(help="Fringes across the projector, in order of recording: '16 1'.")
]
Steps: TypeAlias = Annotated[
    str | None, typer.Option(help="Phase steps of all densities, or of each: '4', '3 1 1'.")
]
Orientations: TypeAlias = Annotated[
    str | None, typer.Option(help="Directions in which the phase grows, in degrees: '0 90'.")
]
Shown: TypeAlias = Annotated[
    str | None,
    typer.Option("--frames", help="What is recorded, in order: 'fringes gray white'; see docs/import.md."),
]
Order: TypeAlias = Annotated[
    str | None, typer.Option(help="Of fringe frames, the slowest first: 'orientation density step'.")
]
GrayBits: TypeAlias = Annotated[
    int | None, typer.Option("--gray-bits", help="Gray-code patterns an orientation.")
]
Direction: TypeAlias = Annotated[
    int | None, typer.Option(help="1 if a step adds 2 pi / steps to the phase, -1 if it takes it off.")
]
Origin: TypeAlias = Annotated[
    str | None, typer.Option(help="Where the first step has the phase --offset-deg: middle or edge.")
]
OffsetDeg: TypeAlias = Annotated[
    float | None,
    typer.Option("--offset-deg", help="Phase of the first step there: 0 for a cosine, -90 for a sine."),
]
NewRig: TypeAlias = Annotated[str | None, typer.Option(help="Rig of a campaign that is to be made.")]
NewPlan: TypeAlias = Annotated[
    Path | None, typer.Option(help="Test plan of a campaign that is to be made, instead of --rig.")
]
PrintLayout: TypeAlias = Annotated[
    bool, typer.Option("--print-layout", help="Print the layout to correct and give back, and end.")
]


def frames(
    folder: Folder,
    campaign: CampaignName,
    layout: LayoutFile = None,
    pattern: Pattern = None,
    state: State = None,
    view: View = None,
    densities: Densities = None,
    steps: Steps = None,
    orientations: Orientations = None,
    shown: Shown = None,
    order: Order = None,
    gray_bits: GrayBits = None,
    direction: Direction = None,
    origin: Origin = None,
    offset_deg: OffsetDeg = None,
    full_scale: FullScale = None,
    gain: Gain = None,
    read_noise: ReadNoise = None,
    raw: Raw = None,
    only: Only = None,
    rig: NewRig = None,
    specimen: SpecimenName = None,
    plan: NewPlan = None,
    recorded_at: RecordedAt = None,
    add_states: AddStates = False,
    newer: Newer = False,
    print_layout: PrintLayout = False,
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
    given: dict[str, Any] = {
        "pattern": pattern,
        "state": state,
        "view": view,
        "frames": shown,
        "order": order,
        "sequence.densities": _numbers(densities, "--densities", _whole_or_not),
        "sequence.steps": _steps(steps),
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
    from sms_jobs.app.importing.frames import Task

    task = Task(
        folder,
        campaign,
        only=only,
        rig=rig,
        specimen=specimen,
        plan=plan,
        layout=layout,
        layout_values=given,
        recorded_at=time_given(recorded_at),
        add_states=add_states,
        newer=newer,
    )
    _import(home, task, print_layout=print_layout, ask=not (yes or layout), dry_run=dry_run, as_json=as_json)


def _import(
    home: Path | None, task: Task, *, print_layout: bool, ask: bool, dry_run: bool, as_json: bool
) -> None:
    """Show what the files are taken for, ask whether that is right, and enter them."""
    from sms_jobs.app.importing.frames import arrange_frames, enter, guess

    with bootstrap.services(home) as services:
        guessed = guess(services, task)
        if print_layout:
            output.print_text(guessed.layout_text)
            return
        arranged = arrange_frames(services, guessed)
        _preview(arranged)
        if ask and not dry_run:
            confirm("Is this right?")
        with bars.followed(bars.progress_bar()) as tell:
            outcome = enter(services, arranged, dry_run=dry_run, tell=tell)
    tell_outcome(outcome, as_json=as_json, dry_run=dry_run, campaign=task.campaign, then="pipeline")


def _whole_or_not(text: str) -> int | float:
    return int(text) if text.isdecimal() else float(text)


def _steps(text: str | None) -> int | tuple[int, ...] | None:
    """Return one number for all densities, or one for each."""
    steps = _numbers(text, "--steps", int)
    return steps[0] if steps is not None and len(steps) == 1 else steps


def _numbers(text: str | None, option: str, kind: Callable[[str], int | float]) -> tuple[Any, ...] | None:
    if text is None:
        return None
    try:
        return tuple(kind(part) for part in text.replace(",", " ").split())
    except ValueError:
        raise InvalidInput(f"{option} should be numbers with spaces between, not '{text}'") from None


def _preview(found: Arranged) -> None:
    """Show on stderr what the files are taken for."""
    for remark in found.guessed.guess.remarks:
        output.say(remark)
    count, each = len(found.arrangement.tuples), len(found.layout.roles)
    output.say(f"pattern   {found.layout.pattern.text}")
    output.say(f"fringes   {found.fringes}")
    files = number_of(len(found.guessed.listing.files), "file")
    output.say(f"tuples    {count}, of {number_of(each, 'frame')} each, from {files}")
    example = found.example
    if example is not None:
        output.say(f"frames of {example.state}/{example.view}:")
        frames = example.frames
        for name, what in (
            frames if len(frames) <= 2 * MOST_SHOWN else [*frames[:MOST_SHOWN], ("...", ""), *frames[-3:]]
        ):
            output.say(f"  {name}  {what}")
