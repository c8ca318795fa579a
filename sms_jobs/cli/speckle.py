"""`sms speckle`: patterns for specimens."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from sms_jobs.app import writing
from sms_jobs.app.fields import textures
from sms_jobs.cli import output
from sms_jobs.cli.options import Force

app = typer.Typer(help="Speckle patterns for specimens.", no_args_is_help=True)


@app.callback()
def _group() -> None:
    """Keep `print` a command of a group."""


@app.command("print")
def print_(
    width_mm: Annotated[float, typer.Option(help="Width of the printed area, mm.", min=1.0)],
    height_mm: Annotated[float, typer.Option(help="Height of the printed area, mm.", min=1.0)],
    speckle_mm: Annotated[
        float, typer.Option(help="Mean width of a speckle, mm: five pixels of the camera or so.", min=0.01)
    ],
    out: Annotated[Path, typer.Option("--output", "-o", help="PDF or PNG file to write.")],
    dpi: Annotated[int, typer.Option(help="Dots an inch of the printer.", min=50, max=4800)] = 600,
    seed: Annotated[int, typer.Option(help="Another seed gives another pattern.", min=0)] = 1,
    mirrored: Annotated[
        bool, typer.Option("--mirrored", help="Exchange left and right, for transfer paper.")
    ] = False,
    pattern: Annotated[
        Literal["dots", "laser"],
        typer.Option(help="Round black dots, or laser speckle, whose width is that at half maximum."),
    ] = "dots",
    force: Force = False,
) -> None:
    """Write a speckle pattern of exact physical size; print it at 100 %, without fitting to the page.

    Example: sms speckle print --width-mm 200 --height-mm 100 --speckle-mm 1.2 --output speckle.pdf --mirrored
    """
    endings = (".pdf", ".png")
    writing.check_new_file(out, force, endings)
    content = textures.speckle(
        out.suffix,
        width_mm=width_mm,
        height_mm=height_mm,
        speckle_mm=speckle_mm,
        dpi=dpi,
        seed=seed,
        mirrored=mirrored,
        pattern=pattern,
    )
    writing.write_file(out, content, force, endings)
    output.say(f"wrote {out}: {width_mm:g} mm x {height_mm:g} mm at {dpi} dpi")
