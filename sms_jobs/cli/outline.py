"""`sms data outline`: a mask image as the text that jobs take for a region of interest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sms_jobs.app.fields import textures
from sms_jobs.cli import output


def outline(
    mask: Annotated[
        Path, typer.Argument(help="Image of a camera's size; pixels brighter than half its brightest count.")
    ],
    above: Annotated[
        float | None,
        typer.Option(help="Pixels brighter than this count; half of the brightest if not given.", min=0.0),
    ] = None,
    least_px: Annotated[
        int, typer.Option("--least-px", help="Pieces and holes of fewer pixels are left out.", min=0)
    ] = 0,
) -> None:
    """Print the outlines of a mask image, for the region-of-interest of 'sms job submit correlate'.

    Example: sms job submit correlate -c panel --region-of-interest "$(sms data outline mask.png)"

    Example: sms data outline blacked.tif --above 0 --least-px 1000, of a picture with a black background
    """
    found = textures.outline(mask, above, least_px)
    output.say(
        f"outlines in {found.columns} x {found.rows} px, which must be the size of the camera's images"
    )
    output.print_text(found.text + "\n")
