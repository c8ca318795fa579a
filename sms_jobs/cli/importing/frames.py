"""`sms import frames`: folders of fringe frames become the measurements of a campaign."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.app.importing.frames import Arranged, Task, arrange_frames, enter, guess
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
    steps: Annotated[
        str | None, typer.Option(help="Phase steps of all densities, or of each: '4', '3 1 1'.")
    ] = None,
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
    task = Task(
        folder,
        campaign,
        only=only,
        rig=rig,
        specimen=specimen,
        plan=plan,
        layout=layout,
        given=given,
        recorded_at=time_given(recorded_at),
        add_states=add_states,
        newer=newer,
    )
    with bootstrap.services(home) as services:
        guessed = guess(services, task)
        if print_layout:
            output.print_text(guessed.layout_text)
            return
        arranged = arrange_frames(services, guessed)
        _preview(arranged)
        if not (yes or dry_run or layout is not None):
            confirm("Is this right?")
        with bars.followed(bars.progress_bar()) as tell:
            outcome = enter(services, arranged, dry_run=dry_run, tell=tell)
    tell_outcome(outcome, as_json=as_json, dry_run=dry_run, campaign=campaign, then="pipeline")


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
    output.say(f"tuples    {count}, of {each} frames each, from {len(found.guessed.listing.files)} files")
    example = found.example
    if example is not None:
        output.say(f"frames of {example.state}/{example.view}:")
        frames = example.frames
        for name, what in (
            frames if len(frames) <= 2 * MOST_SHOWN else [*frames[:MOST_SHOWN], ("...", ""), *frames[-3:]]
        ):
            output.say(f"  {name}  {what}")
