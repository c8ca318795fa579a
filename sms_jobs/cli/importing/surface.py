"""`sms import surface`: the surface of a CAD program that a campaign is compared with."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.importing.surface import import_surface
from sms_jobs.cli import completion, output
from sms_jobs.cli.output import Home, Json


def surface(
    file: Annotated[Path, typer.Argument(help="STL, PLY or OBJ file.")],
    campaign: Annotated[
        str,
        typer.Option(
            "--campaign", "-c", help="Campaign that it belongs to.", autocompletion=completion.campaign_names
        ),
    ],
    unit: Annotated[str, typer.Option(help="Unit of the file: mm, cm, m, um or inch.")] = "mm",
    turn_over: Annotated[
        bool, typer.Option("--turn-over", help="Its triangles face inwards: turn them over.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Store the surface that a campaign's shapes are compared with.

    The newest one counts; earlier ones stay, with what was compared with them.

    Example: sms import surface panel.stl -c wing; sms job submit deviate -c wing --upper-mm 0.2
    """
    with bootstrap.services(home) as services:
        found = import_surface(services, campaign, file, unit=unit, turn_over=turn_over)
    if as_json:
        output.print_json(
            {
                "file": found.file,
                "new": found.new,
                "triangles": found.triangles,
                "size_mm": found.size_mm,
                "filename": found.filename,
                "file_sha256": found.sha256,
            }
        )
        return
    extent = " x ".join(f"{v:.4g}" for v in found.size_mm)
    word = "stored as" if found.new else "is already"
    output.say(f"{found.filename}, {found.triangles:,} triangles, {extent} mm, {word} file {found.file}")
