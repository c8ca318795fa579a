"""`sms data show`, `tree` and `plot`: what the archive holds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app import writing
from sms_jobs.app.holdings import files
from sms_jobs.cli import output
from sms_jobs.cli.options import Force, Record, StoredFile
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.shown.files import Ancestor, FileView
from sms_jobs.records.sizes import size

if TYPE_CHECKING:
    from rich.tree import Tree


_SHOWN_ALIKE = 8
"""Inputs of one source that a tree shows one by one; a calibration has a hundred."""


def show(file: StoredFile, home: Home = None, as_json: Json = False) -> None:
    """Show a file: what it is about, its statistics, what was read while it was recorded, and its records.

    Example: sms data show 17
    """
    with bootstrap.services(home) as services:
        found = files.describe(services, file)
    if as_json:
        output.print_json(
            {
                "file": found.file,
                "path": found.path,
                "statistics": found.statistics,
                "readings": found.readings,
                "records": found.records,
            }
        )
        return
    view = found.file
    output.print_facts(
        {
            "file": view.id,
            "kind": view.source,
            "subject": view.subject,
            "path": found.path,
            "size": size(view.size_bytes),
            "recorded": view.recorded_at,
            "created": view.created_at,
            "sha256": view.sha256 or "not known",
            "content": f"sha256 {view.content_hash}",
            "job": view.job_id,
        }
        | found.statistics
        | {f"channel.{name}": value for name, value in found.readings.items()}
    )
    output.print_table(
        ["record", "field", "shape", "unit", "meaning"],
        [
            (name, field, " x ".join(map(str, about["shape"])), about["unit"], about["meaning"])
            for name, fields in found.records.items()
            for field, about in fields.items()
        ],
        empty="",
    )


def tree(
    file: StoredFile,
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
    with bootstrap.services(home) as services:
        found = files.tree(services, file, down=down)
    if as_json:
        name = "outputs" if down else "inputs"
        output.print_json({"file": found.file, name: found.inputs, "more": found.more})
        return
    from rich.tree import Tree

    root = Tree(_named(found.file))
    _grow(root, found.inputs, whole)
    output.answer().print(root)
    if found.more:
        output.say(f"the tree ends at {files.MOST_RELATED} entries; ask for that of a file in it")


def plot(
    file: StoredFile,
    out: Annotated[Path, typer.Option("--out", "-o", help="PNG file to write.")],
    record: Record = None,
    field: Annotated[
        str | None, typer.Option(help="Field of the record; the first image if not given.")
    ] = None,
    component: Annotated[
        str | None, typer.Option(help="Component, e.g. Z or xx; the magnitude of a vector if not given.")
    ] = None,
    force: Force = False,
    home: Home = None,
) -> None:
    """Draw an image field with colour bar and unit as PNG; of a camera alone, over its reference image.

    Example: sms data plot 17 --field strain --component xx --out strain.png
    """
    writing.check_new_file(out, force, (".png",))
    with bootstrap.services(home) as services:
        png = files.picture(services, file, record=record, field=field, component=component)
    writing.write_file(out, png, force)
    output.say(f"wrote {out}")


def _named(file: FileView) -> str:
    """Return what a file is, of what, and its number; a calibration is of no subject."""
    return " ".join(part for part in (file.source, file.subject, f"({file.id})") if part)


def _grow(node: Tree, inputs: tuple[Ancestor, ...], whole: bool) -> None:
    """Add inputs to a tree; of many from one source only the first, unless the whole tree is asked for."""
    by_source: dict[str, list[Ancestor]] = {}
    for ancestor in inputs:
        by_source.setdefault(ancestor.file.source, []).append(ancestor)
    for source, alike in by_source.items():
        shown = alike if whole or len(alike) <= _SHOWN_ALIKE else alike[:1]
        for ancestor in shown:
            more = "; its inputs are shown elsewhere" if ancestor.repeated else ""
            if ancestor.more:
                more = f"; there is more, see 'sms data tree {ancestor.file.id}'"
            child = node.add(f"{ancestor.role}: {_named(ancestor.file)}{more}")
            _grow(child, ancestor.inputs, whole)
        if len(shown) < len(alike):
            node.add(f"and {len(alike) - 1} more of {source}; --all shows them")
