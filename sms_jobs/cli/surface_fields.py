"""`sms data gauges` and `sms data section`: numbers at places of a surface, from stored results."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from math import hypot
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns, family, search
from sms_jobs.cli import completion, output, writing
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.records.fields import Surface
from sms_jobs.records.files import Ancestor, FileView
from sms_jobs.records.gauges import GaugeReadings

if TYPE_CHECKING:
    from sms_jobs.formats.gauge_descriptions import GaugeReading
    from sms_jobs.formats.profiles import GaugeRow

_MICROSTRAIN = 1e6
_MOST_STATES = 100_000

Force = Annotated[bool, typer.Option("--force", help="Replace a file that is there.")]
Out = Annotated[
    Path | None, typer.Option("--out", "-o", help="File to write: .csv for numbers, .png for a picture.")
]

_MOST_PIECES = 100_000


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
    # Other commands of this group load without what this one computes with.
    from sms_jobs.formats.gauge_descriptions import read_gauge_file
    from sms_jobs.formats.profiles import compared, draw_gauges

    given = None if readings is None else read_gauge_file(readings)
    with bootstrap.services(home) as services:
        virtual = _virtual(services, campaign, view)
        real = _entered(services, campaign, {row.gauge for row in virtual}) if given is None else given
    rows = compared(virtual, real)
    if out is not None:
        _write(out, force, _table_of(rows), lambda: draw_gauges(rows))
    if as_json:
        output.print_json({"campaign": campaign, "gauges": rows})
        return
    output.print_table(
        ["state", "view", "gauge", "virtual [µε]", "sigma [µε]", "pixels", "real [µε]", "difference [µε]"],
        [(r.state, r.view, r.gauge, *_rounded(r), _in(r.real), _in(r.difference)) for r in rows],
        empty=f"no virtual gauges of campaign {campaign}",
    )
    differences = [r.difference for r in rows if r.difference is not None]
    if differences:
        rms = _MICROSTRAIN * float(np.sqrt(np.mean(np.square(differences))))
        output.say(f"rms difference of {len(differences)} readings: {rms:.1f} microstrain")


def _rounded(row: GaugeRow) -> tuple[str | None, str | None, int]:
    return _in(row.virtual), _in(row.sigma), row.pixels


def _in(strain: float | None) -> str | None:
    return None if strain is None else f"{_MICROSTRAIN * strain:.1f}"


def _virtual(services: Services, campaign: str, view: str | None) -> list[GaugeRow]:
    """Return the newest readings of every state and view, in order."""
    from sms_jobs.formats.profiles import GaugeRow

    with services.catalogue.reading() as session:
        files = search.find_files(session, source="gauges", campaign=campaign, view=view, limit=_MOST_STATES)
    newest: dict[str, FileView] = {}
    for file in files:
        newest.setdefault(file.subject, file)
    if not newest:
        raise NotFound(
            f"campaign {campaign} has no virtual gauges; 'sms job submit gauges -c {campaign} "
            '--gauge "G1 x=0 y=0 length=20"\' reads one in the middle'
        )
    rows = []
    for subject, file in sorted(newest.items()):
        with services.archive.open(file) as dataset:
            found = dataset.read("gauges", GaugeReadings)
        _, state, seen_by = subject.split("/")
        for name, strain, sigma, pixels in zip(
            found.names, found.strain, found.sigma, found.pixels, strict=True
        ):
            known = bool(np.isfinite(strain))
            rows.append(
                GaugeRow(
                    state,
                    seen_by,
                    name,
                    float(strain) if known else None,
                    float(sigma) if known else None,
                    int(pixels),
                )
            )
    return rows


def _entered(services: Services, campaign: str, names: set[str]) -> tuple[GaugeReading, ...]:
    """Return what the states of a campaign say of real gauges of some names."""
    from sms_jobs.formats.gauge_descriptions import GaugeReading

    with services.catalogue.reading() as session:
        states = campaigns.definition(campaigns.campaign_row(session, campaign)).states
    return tuple(
        GaugeReading(state.label, name, value)
        for state in states
        for name, value in state.channels.items()
        if name in names
    )


def _table_of(rows: Sequence[GaugeRow]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(
        ["state", "view", "gauge", "virtual_microstrain", "sigma_microstrain", "pixels", "real_microstrain"]
    )
    for r in rows:
        writer.writerow([r.state, r.view, r.gauge, *_rounded(r), _in(r.real)])
    return text.getvalue()


def section(
    file: Annotated[str, typer.Argument(help="Number or archive path of a file; see 'sms data find'.")],
    start: Annotated[
        str, typer.Option("--from", help="Start of the line, X,Y in mm; of a camera alone column,row in px.")
    ],
    end: Annotated[str, typer.Option("--to", help="End of the line, as --from.")],
    record: Annotated[str | None, typer.Option(help="Record in the file; the first if not given.")] = None,
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
    from sms_jobs.formats.profiles import draw_profile, named_field
    from sms_jobs.metrology.deformation.gauges import profile_along

    ends = (_point(start, "--from"), _point(end, "--to"))
    if ends[0] == ends[1]:
        raise InvalidInput(f"the section begins and ends at {start}; give two different points")
    pieces = hypot(ends[1][0] - ends[0][0], ends[1][1] - ends[0][1]) / step
    if not pieces <= _MOST_PIECES:
        raise InvalidInput(
            f"the section from {start} to {end} has {pieces:.3g} pieces of {step:g} mm, and may have "
            f"{_MOST_PIECES}: make it shorter, or --step larger"
        )
    with bootstrap.services(home) as services:
        with services.catalogue.reading() as session:
            view = search.file_view(session, file)
            parents = family.ancestry(session, view).inputs
        with services.archive.open(view) as dataset:
            name = record or dataset.names[0]
            read: Any = dataset.read(name, dataset.record_class(name))
            values = named_field(read, field)
            own = dataset.read("surface", Surface).position if "surface" in dataset.names else values.position
        flat = view.in_plane
        if flat:
            own = _pixels(values.values.shape[-2:])
        elif own is None:
            own = _shape_of(services, parents, file)
    profile = profile_along(own, values.values, *ends, step_mm=step, width_mm=width)
    columns = ["distance_mm", "X_mm", "Y_mm", "Z_mm", *values.columns, "pixels"]
    rows = [
        [*map(_plain, (d, *place, *each)), int(count)]
        for d, place, each, count in zip(
            profile.distance, profile.position, profile.value.T, profile.pixels, strict=True
        )
    ]
    if flat:
        # No third coordinate.
        columns = ["distance_px", "column_px", "row_px", *columns[4:]]
        rows = [[*row[:3], *row[4:]] for row in rows]
    if out is not None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows([columns, *rows])
        unit = "px" if flat else "mm"
        _write(out, force, text.getvalue(), lambda: draw_profile(profile, values, unit))
    if as_json:
        output.print_json({"file": view.id, "columns": columns, "rows": rows})
    elif out is None:
        output.print_table(columns, rows, empty="")


def _pixels(shape: tuple[int, ...]) -> np.ndarray[Any, Any]:
    """Return column and row of every pixel as if they were positions, (3, rows, columns)."""
    row, column = np.mgrid[0 : shape[0], 0 : shape[1]].astype(np.float64)
    return np.stack([column, row, np.zeros(shape)])


def _shape_of(services: Services, parents: Sequence[Ancestor], file: str) -> np.ndarray[Any, Any]:
    """Return where the pixels of a result are, by the shape that it was made from."""
    shape = next((p.file for p in parents if p.role == "reference"), None)
    if shape is None:
        raise InvalidInput(f"file {file} does not say where its pixels are; choose a result of a view")
    with services.archive.open(shape) as dataset:
        return dataset.read("surface", Surface).position


def _plain(value: float) -> float | None:
    return float(f"{value:.7g}") if np.isfinite(value) else None


def _point(text: str, option: str) -> tuple[float, float]:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InvalidInput(
            f"{option} {text} is not a point; write two numbers in mm, or px of a camera alone, like -50,20"
        ) from error
    return x, y


def _write(out: Path, force: bool, table: str, picture: Any) -> None:
    endings = (".csv", ".png")
    writing.check_new_file(out, force, endings)
    writing.write_file(out, table if out.suffix == ".csv" else picture(), force, endings)
    output.say(f"wrote {out}")
