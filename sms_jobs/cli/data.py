"""`sms data`: find, look at and take out what the archive holds."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.tree import Tree

from sms_jobs import bootstrap
from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.catalogue import family, search
from sms_jobs.catalogue.finding import restricted
from sms_jobs.catalogue.query_language import parse
from sms_jobs.cli import (
    advice,
    completion,
    exporting,
    field_comparison,
    found_files,
    outline,
    output,
    pins,
    portable_data,
    saved_queries,
    state_comparison,
    surface_fields,
    writing,
)
from sms_jobs.cli.found_files import After, As, Columns, Force, Format, Limit, Out, Wanted
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.figures import plot_record
from sms_jobs.kinds.kind import MEASUREMENT
from sms_jobs.records.files import Ancestor
from sms_jobs.records.measurement import Measurement

app = typer.Typer(help="Measurements and results in the archive.", no_args_is_help=True)
app.add_typer(saved_queries.app, name="query")
app.command("export")(exporting.export)
app.command("formats")(exporting.formats)
app.command("pin")(pins.pin)
app.command("unpin")(pins.unpin)
app.command("pins")(pins.pins)
app.command("outline")(outline.outline)
app.command("gauges")(surface_fields.gauges)
app.command("section")(surface_fields.section)
app.command("advise")(advice.advise)
app.command("compare")(field_comparison.compare)
app.command("compare-states")(state_comparison.compare_states)
app.command("pack")(portable_data.pack)
app.command("check")(portable_data.check)
app.command("unpack")(portable_data.unpack)
app.command("provenance")(portable_data.provenance)

File = Annotated[str, typer.Argument(help="Number or archive path of a file; see 'sms data find'.")]

_SHOWN_ALIKE = 8
"""Inputs of one source that a tree shows one by one; a calibration has a hundred."""


@app.command()
def find(
    query: Annotated[
        str | None,
        typer.Argument(help="What is wanted, in quotation marks: 'strain where load_kN > 1400'."),
    ] = None,
    kind: Annotated[
        str | None, typer.Option(help="measurement, calibration, or the kind of a result.")
    ] = None,
    campaign: Annotated[
        str | None,
        typer.Option(
            "--campaign", "-c", help="Only of this campaign.", autocompletion=completion.campaign_names
        ),
    ] = None,
    state: Annotated[str | None, typer.Option(help="Only of this state.")] = None,
    view: Annotated[str | None, typer.Option(help="Only of this view.")] = None,
    limit: Limit = 50,
    after: After = None,
    columns: Columns = None,
    form: As = Format.TABLE,
    out: Out = None,
    force: Force = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Find measurements, results and calibrations, the newest first; docs/query.md has the language.

    Example: sms data find 'strain where load_kN > 1400 and max_principal > 1e-3' -c wing-fatigue
    """
    asked = restricted(parse(query or ""), kind=kind, campaign=campaign, state=state, view=view)
    found_files.tell(home, lambda _: asked, Wanted(limit, after, columns, form, out, force, as_json))


@app.command()
def show(file: File, home: Home = None, as_json: Json = False) -> None:
    """Show a file: what it is about, its statistics, what was read while it was recorded, and its records.

    Example: sms data show 17
    """
    with bootstrap.services(home) as services:
        with services.catalogue.reading() as session:
            view = search.file_view(session, file)
            numbers = search.statistics(session, view.id)
            readings = search.readings(session, view.id)
        records: dict[str, Any] = {}
        if view.media_type == DATASET_MEDIA_TYPE:
            with services.archive.open(view) as dataset:
                records = dataset.describe()
        else:
            services.archive.verify_bytes(view)
        path = services.archive.location(view.path)
    if as_json:
        output.print_json(
            {"file": view, "path": path, "statistics": numbers, "readings": readings, "records": records}
        )
        return
    output.print_facts(
        {
            "file": view.id,
            "kind": view.source,
            "subject": view.subject,
            "path": path,
            "size": output.size(view.size_bytes),
            "recorded": view.recorded_at,
            "created": view.created_at,
            "content": f"sha256 {view.content_hash}",
            "job": view.job_id,
        }
        | numbers
        | {f"channel.{name}": value for name, value in readings.items()}
    )
    output.print_table(
        ["record", "field", "shape", "unit", "meaning"],
        [
            (name, field, " x ".join(map(str, about["shape"])), about["unit"], about["meaning"])
            for name, fields in records.items()
            for field, about in fields.items()
        ],
        empty="",
    )


@app.command()
def tree(
    file: File,
    whole: Annotated[bool, typer.Option("--all", help="Show every input, however many are alike.")] = False,
    down: Annotated[
        bool, typer.Option("--down", help="Show what was computed from it, and from that, instead.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show what a file was computed from, back to what was measured; or all that was computed from it.

    Example: sms data tree 17; sms data tree 3 --down
    """
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        view = search.file_view(session, file)
        related = family.descent(session, view) if down else family.ancestry(session, view)
    if as_json:
        name = "outputs" if down else "inputs"
        output.print_json({"file": view, name: related.inputs, "more": related.more})
        return
    root = Tree(f"{view.source} {view.subject} ({view.id})")
    _grow(root, related.inputs, whole)
    output.answer.print(root)
    if related.more:
        output.say(f"the tree ends at {family.MOST} entries; ask for that of a file in it")


@app.command()
def plot(
    file: File,
    out: Annotated[Path, typer.Option("--out", "-o", help="PNG file to write.")],
    record: Annotated[str | None, typer.Option(help="Record in the file; the first if not given.")] = None,
    field: Annotated[
        str | None, typer.Option(help="Field of the record; the first image if not given.")
    ] = None,
    component: Annotated[
        str | None, typer.Option(help="Component, e.g. Z or xx; the magnitude of a vector if not given.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
    home: Home = None,
) -> None:
    """Draw an image field with colour bar and unit as PNG; of a camera alone, over its reference image.

    Example: sms data plot 17 --field strain --component xx --out strain.png
    """
    writing.check_new_file(out, force)
    with bootstrap.services(home) as services:
        with services.catalogue.reading() as session:
            view = search.file_view(session, file)
            inputs = family.ancestry(session, view).inputs
        if view.media_type != DATASET_MEDIA_TYPE:
            raise InvalidInput(f"file {file} is a {view.media_type} document, which cannot be plotted")
        with services.archive.open(view) as dataset:
            name = record or dataset.names[0]
            read: Any = dataset.read(name, dataset.record_class(name))
        behind = None
        if view.in_plane:
            behind = _reference_image(services, inputs)
    png = plot_record(read, field, component, behind=behind)
    writing.write_file(out, png, force)
    output.say(f"wrote {out}")


def _reference_image(services: bootstrap.Services, inputs: Iterable[Ancestor]) -> Any:
    """Return the texture that a result in an image started from; None where it is not in the archive."""
    for one in inputs:
        if one.role == "reference" and one.file.source == MEASUREMENT:
            with services.archive.open(one.file) as dataset:
                return dataset.read("measurement", Measurement).texture
        found = _reference_image(services, one.inputs)
        if found is not None:
            return found
    return None


def _grow(node: Tree, inputs: tuple[Ancestor, ...], whole: bool) -> None:
    """Add inputs to a tree; of many from one source only the first, unless the whole is wanted."""
    by_source: dict[str, list[Ancestor]] = {}
    for ancestor in inputs:
        by_source.setdefault(ancestor.file.source, []).append(ancestor)
    for source, alike in by_source.items():
        shown = alike if whole or len(alike) <= _SHOWN_ALIKE else alike[:1]
        for ancestor in shown:
            more = "; its inputs are shown elsewhere" if ancestor.told else ""
            if ancestor.more:
                more = f"; there is more, see 'sms data tree {ancestor.file.id}'"
            child = node.add(
                f"{ancestor.role}: {ancestor.file.source} {ancestor.file.subject} ({ancestor.file.id}){more}"
            )
            _grow(child, ancestor.inputs, whole)
        if len(shown) < len(alike):
            node.add(f"and {len(alike) - 1} more of {source}; --all shows them")
