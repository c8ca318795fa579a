"""`sms calibration`: the calibrations of rigs."""

from __future__ import annotations

from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.catalogue import search
from sms_jobs.cli import calibration_files, output
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.sensors import Calibration

app = typer.Typer(help="Calibrations of rigs.", no_args_is_help=True)
app.command("export")(calibration_files.export)
app.command("import")(calibration_files.import_)


@app.command("list")
def list_(
    rig: Annotated[str | None, typer.Option(help="Only of this rig.")] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show calibrations, the one that became valid last first.

    Example: sms calibration list --rig hall-3
    """
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        views = search.list_calibrations(session, rig)
    if as_json:
        output.print_json_list(views)
        return
    output.print_table(
        ["calibration", "rig", "valid from", "sensors", "origin"],
        [(v.id, v.rig, v.valid_from, " ".join(v.sensors), v.origin) for v in views],
        empty="there is no calibration yet",
    )


@app.command()
def show(number: int, home: Home = None, as_json: Json = False) -> None:
    """Show the parameters of every sensor of a calibration.

    Example: sms calibration show 1
    """
    with bootstrap.services(home) as services:
        with services.catalogue.reading() as session:
            view = search.calibration_view(session, number)
        with services.archive.open(view.path) as dataset:
            calibration = dataset.read("calibration", Calibration)
    if as_json:
        output.print_json(
            {"calibration": view, "sensors": calibration.rig.sensors, "volume": calibration.volume}
        )
        return
    output.print_facts(
        {
            "calibration": view.id,
            "rig": view.rig,
            "valid from": view.valid_from,
            "origin": view.origin,
            "volume diagonal [mm]": calibration.volume.diagonal_mm,
            "file": view.path,
        }
    )
    output.print_table(
        ["sensor", "px", "fx, fy [px]", "cx, cy [px]", "k1, k2, p1, p2, k3", "pin-hole [mm]"],
        [
            (
                s.name,
                f"{s.columns} x {s.rows}",
                f"{s.intrinsics.fx:.2f}, {s.intrinsics.fy:.2f}",
                f"{s.intrinsics.cx:.2f}, {s.intrinsics.cy:.2f}",
                ", ".join(f"{k:g}" for k in s.intrinsics.distortion()),
                ", ".join(f"{x:.2f}" for x in s.pose.centre()),
            )
            for s in calibration.rig.sensors
        ],
        empty="",
    )
