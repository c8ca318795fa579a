"""`sms data export` and `sms data formats`: results in the files of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from sms_jobs import bootstrap
from sms_jobs.app.fields import exporting
from sms_jobs.app.fields.exporting import Chosen, ExportOptions
from sms_jobs.cli import completion, output
from sms_jobs.cli.options import Force
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput

File = Annotated[
    str | None,
    typer.Argument(
        help="Number or archive path of a file; see 'sms data find'. Or choose by --kind.", show_default=False
    ),
]
Out = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="File to write, or a folder; here if not given.", show_default=False),
]


def formats(as_json: Json = False) -> None:
    """List the formats of 'sms data export --as' and of the job kind export.

    Example: sms data formats
    """
    found = exporting.formats()
    if as_json:
        output.print_json_list({"format": f.name, "suffix": f.suffix, "summary": f.summary} for f in found)
        return
    rows = [(f.name, f"*{f.suffix}", f.summary) for f in found]
    output.print_table(["format", "file", "what it holds"], rows, empty="")


def export(
    file: File = None,
    form: Annotated[
        str | None,
        typer.Option(
            "--as",
            help="Format to write, see 'sms data formats'; the suffix of --out decides if not given.",
            show_default=False,
        ),
    ] = None,
    out: Out = None,
    record: Annotated[
        str | None,
        typer.Option(help="Record in the file; its mesh, or all that the format can hold if not given."),
    ] = None,
    fields: Annotated[
        str | None,
        typer.Option(help="Only these values, with commas between; all if not given.", show_default=False),
    ] = None,
    kind: Annotated[
        str | None, typer.Option(help="Instead of a file: the newest result of this kind of each subject.")
    ] = None,
    campaign: Annotated[
        str | None,
        typer.Option(
            "--campaign", "-c", help="With --kind: of it.", autocompletion=completion.campaign_names
        ),
    ] = None,
    state: Annotated[str | None, typer.Option(help="With --kind: only of this state.")] = None,
    view: Annotated[str | None, typer.Option(help="With --kind: only of this view.")] = None,
    frame: Annotated[
        Literal["world", "specimen"],
        typer.Option(help="Along whose axes shape and displacement are; see 'sms campaign frame'."),
    ] = "world",
    force: Force = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Write a result for other programs, or copy a sealed file, e.g. a report, out of the archive.

    Without --as the suffix of --out says the format; without either, or with the suffix of the sealed file,
    that is copied as it is.

    Example: sms data export 42 --as ply --fields "deviation,sigma of deviation" -o deviation.ply

    Example: sms data export --kind merge -c wing --as vtu -o for-paraview/

    Example: sms data export 42 -o shape.csv --frame specimen, with x along the specimen and z out of it
    """
    chosen = Chosen(file, kind, campaign, state, view)
    options = ExportOptions(form, record, _split(fields), force, frame)
    with bootstrap.services(home) as services:
        written = exporting.export(services, chosen, out, options)
    if as_json:
        output.print_json({"files": written})
        return
    for path in written:
        output.say(f"wrote {path}")


def _split(fields: str | None) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in (fields or "").split(",")))
    if fields is not None and not all(names):
        raise InvalidInput(f"--fields '{fields}' has an empty name; write them like \"deviation,texture\"")
    return names if fields is not None else ()
