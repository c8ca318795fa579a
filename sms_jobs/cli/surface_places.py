"""`sms data gauges` and `sms data section`: numbers at places of a surface, from stored results."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app import writing
from sms_jobs.app.fields import surface_fields
from sms_jobs.app.fields.surface_fields import Gauges, Section
from sms_jobs.app.fields.surface_fields import microstrain as _in
from sms_jobs.cli import completion, output
from sms_jobs.cli.options import Force, Record, StoredFile
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.records.sizes import number_of

Out = Annotated[
    Path | None, typer.Option("--out", "-o", help="File to write: .csv for numbers, .png for a picture.")
]


def gauges(
    campaign: Annotated[
        str, typer.Option("--campaign", "-c", help="Campaign.", autocompletion=completion.campaign_names)
    ],
    readings: Annotated[
        Path | None,
        typer.Option(
            help="CSV file of real gauges: columns state, gauge and microstrain; without it, the channels of "
            "the states that have the names of gauges, as 'sms import gauges' enters them."
        ),
    ] = None,
    view: Annotated[str | None, typer.Option(help="Only of this view.")] = None,
    out: Out = None,
    force: Force = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show what virtual strain gauges read, state by state, beside real ones.

    First: sms job submit gauges -c panel --gauge "G1 x=0 y=20 length=20; G2 x=0 y=20 length=20 angle=90"

    Example: sms import gauges strain_gauges.csv -c panel --map SG1=G1 --map SG2=G2 --time-column Time;
    sms data gauges -c panel --out gauges.png
    """
    with bootstrap.services(home) as services:
        found = surface_fields.gauges(services, campaign, readings=readings, view=view)
    if out is not None:
        _write(out, force, found)
    if as_json:
        output.print_json({"campaign": campaign, "gauges": found.rows, "left_out": found.left_out})
        return
    output.print_table(
        ["state", "view", "gauge", "virtual [µε]", "sigma [µε]", "pixels", "real [µε]", "difference [µε]"],
        [
            (r.state, r.view, r.gauge, _in(r.virtual), _in(r.sigma), r.pixels, _in(r.real), _in(r.difference))
            for r in found.rows
        ],
        empty=f"no virtual gauges of campaign {campaign}",
    )
    output.say_left_out(found.left_out)
    for (name, of_view), states in found.unread.items():
        more = f" and {len(states) - 1} more" if len(states) > 1 else ""
        output.say(
            f"gauge {name} reads nothing in {of_view} at {states[0]}{more}: it lies off the specimen, or "
            "fewer than twelve valid points lie under it"
        )
    if found.rms_difference is not None:
        count, rms = found.rms_difference
        output.say(f"rms difference of {number_of(count, 'reading')}: {_in(rms)} microstrain")


def section(
    file: StoredFile,
    start: Annotated[
        str, typer.Option("--from", help="Start of the line, X,Y in mm; of a camera alone column,row in px.")
    ],
    end: Annotated[str, typer.Option("--to", help="End of the line, as --from.")],
    record: Record = None,
    field: Annotated[str | None, typer.Option(help="Field; the first image if not given.")] = None,
    step: Annotated[
        float, typer.Option(help="Distance of the points of the profile, mm or px.", min=1e-3)
    ] = 2.0,
    width: Annotated[
        float, typer.Option(help="Width of the strip that is averaged, mm or px.", min=1e-3)
    ] = 4.0,
    out: Out = None,
    force: Force = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show a field along a line on the surface, which is seen along the world's Z axis, or in the image.

    Example: sms data section 17 --from -100,0 --to 100,0 --field strain --out profile.png
    """
    ends = (_point(start, "--from"), _point(end, "--to"))
    with bootstrap.services(home) as services:
        found = surface_fields.section(
            services, file, ends, record=record, field=field, step=step, width=width
        )
    if out is not None:
        _write(out, force, found)
    if as_json:
        output.print_json(
            {"file": found.file, "columns": found.columns, "units": found.units, "rows": found.rows}
        )
    elif out is None:
        output.print_table(found.headings, found.rows, empty="")


def _point(text: str, option: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InvalidInput(
            f"{option} {text} is not a point; write two numbers in mm, or px of a camera alone, like -50,20"
        ) from error
    return x, y


def _write(out: Path, force: bool, found: Gauges | Section) -> None:
    endings = (".csv", ".png")
    writing.check_new_file(out, force, endings)
    writing.write_file(out, found.table() if out.suffix == ".csv" else found.drawn(), force, endings)
    output.say(f"wrote {out}")
