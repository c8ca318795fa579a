"""`sms import surface`: the surface of a CAD program that a campaign is compared with."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from sms_jobs import bootstrap
from sms_jobs.cli import completion, output
from sms_jobs.cli.output import Home, Json
from sms_jobs.jobs.surfaces import register_surface


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
    # Which imports kernels, and every other command would wait for them.
    from sms_jobs.formats.reference_surfaces import read_reference_surface

    found = read_reference_surface(file, unit, turn_over)
    with bootstrap.services(home) as services:
        number, new = register_surface(
            services.catalogue, services.archive, campaign, found, datetime.now(UTC)
        )
    low, high = found.vertices.min(axis=0), found.vertices.max(axis=0)
    if as_json:
        size = [float(v) for v in high - low]
        told = {"file": number, "new": new, "triangles": len(found.faces), "size_mm": size}
        output.print_json(told | {"filename": found.filename, "file_sha256": found.file_sha256})
        return
    extent = " x ".join(f"{v:.4g}" for v in np.asarray(high - low))
    word = "stored as" if new else "is already"
    output.say(f"{found.filename}, {len(found.faces):,} triangles, {extent} mm, {word} file {number}")
