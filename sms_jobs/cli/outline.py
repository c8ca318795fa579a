"""`sms data outline`: a mask image as the text that jobs take for a region of interest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def outline(
    mask: Annotated[
        Path, typer.Argument(help="Image of a camera's size; pixels brighter than half its brightest count.")
    ],
) -> None:
    """Print the outlines of a mask image, for the region-of-interest of 'sms job submit correlate'.

    Example: sms job submit correlate -c panel --region-of-interest "$(sms data outline mask.png)"
    """
    # OpenCV reads the image; no other command of data needs it.
    from sms_jobs.formats.masks import region_of_mask

    typer.echo(region_of_mask(mask))
