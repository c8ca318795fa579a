"""Options that several imports of images take, each declared once."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from sms_jobs.cli import completion

CampaignName: TypeAlias = Annotated[
    str, typer.Option("--campaign", "-c", help="Campaign.", autocompletion=completion.campaign_names)
]
Only: TypeAlias = Annotated[
    str | None, typer.Option(help="Only files whose path below the folder has this form, as 'load_*'.")
]
Cameras: TypeAlias = Annotated[
    str | None, typer.Option("--cameras", help="Cameras by what the names call them: 'left=C1 right=C2'.")
]
SpecimenName: TypeAlias = Annotated[
    str | None, typer.Option("--specimen", help="Specimen of a campaign that is to be made.")
]
RecordedAt: TypeAlias = Annotated[
    str | None,
    typer.Option("--recorded-at", help="When, as 2026-05-04T10:00:00+02:00; the files' times if not given."),
]
FullScale: TypeAlias = Annotated[
    int | None, typer.Option("--full-scale", help="Grey level at which the camera saturates.", min=1)
]
Gain: TypeAlias = Annotated[
    float | None, typer.Option("--gain", help="Noise variance a grey level of signal.", min=0.0)
]
ReadNoise: TypeAlias = Annotated[
    float | None, typer.Option("--read-noise", help="Noise in the dark, in grey levels.", min=0.0)
]
Raw: TypeAlias = Annotated[
    str | None, typer.Option("--raw", help="Raw files: columns x rows x bits, as 1280x1024x12.")
]
AddStates: TypeAlias = Annotated[
    bool, typer.Option("--add-states", help="Give the campaign states that it does not have yet.")
]
Newer: TypeAlias = Annotated[
    bool, typer.Option("--newer", help="Enter what differs from a measurement that is there as the newest.")
]
DryRun: TypeAlias = Annotated[
    bool, typer.Option("--dry-run", help="Read and check everything, and change nothing.")
]
Yes: TypeAlias = Annotated[
    bool, typer.Option("--yes", "-y", help="Do not ask whether what was guessed is right.")
]
PitchSigma: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--pitch-relative-sigma",
        help="How well the pitch is known: its relative standard deviation. Unknown, the scale is nominal.",
        min=1e-9,
        max=0.1,
    ),
]
Flatness: TypeAlias = Annotated[
    float | None,
    typer.Option(
        "--flatness-mm",
        help="How flat the board is: the standard deviation of its bow and twist; 1/500 of it if unknown.",
        min=0.0,
        max=1e3,
    ),
]
Folder: TypeAlias = Annotated[
    Path, typer.Argument(help="Folder of the images; its sub-folders belong to it.")
]
LoneCamera: TypeAlias = Annotated[
    str | None, typer.Option("--camera", help="Camera, where the names do not say it: C1.")
]
