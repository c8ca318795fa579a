"""`sms import`: what was measured elsewhere, from folders of images and tables of readings."""

from __future__ import annotations

import typer

from sms_jobs.cli import (
    calibration_files,
    importing_boards,
    importing_frames,
    importing_images,
    importing_points,
    importing_readings,
    importing_surface,
)

app = typer.Typer(
    help="Bring in what was made elsewhere: frames, images, readings, calibrations, surfaces.",
    no_args_is_help=True,
)
app.command("frames")(importing_frames.frames)
app.command("images")(importing_images.images)
app.command("boards")(importing_boards.boards)
app.command("points")(importing_points.points)
app.command("channels")(importing_readings.channels)
app.command("gauges")(importing_readings.gauges)
app.command("calibration")(calibration_files.import_)
app.command("surface")(importing_surface.surface)
