"""`sms import`: what was measured elsewhere, from folders of images and tables of readings."""

from __future__ import annotations

import typer

from sms_jobs.cli.calibration import files
from sms_jobs.cli.importing import boards, frames, images, points, readings, surface

app = typer.Typer(
    help="Bring in what was made elsewhere: frames, images, readings, calibrations, surfaces.",
    no_args_is_help=True,
)
app.command("frames")(frames.frames)
app.command("images")(images.images)
app.command("boards")(boards.boards)
app.command("points")(points.points)
app.command("channels")(readings.channels)
app.command("gauges")(readings.gauges)
app.command("calibration")(files.import_)
app.command("surface")(surface.surface)
