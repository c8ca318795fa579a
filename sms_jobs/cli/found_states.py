"""`sms data states`: the load states that meet a query, across campaigns."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.app.holdings import finding
from sms_jobs.app.holdings.finding_states import find_states
from sms_jobs.cli import found_files, output
from sms_jobs.cli.found_files import (
    After,
    As,
    FindOptions,
    Format,
    Limit,
    OfCampaign,
    OfState,
    OfView,
    Out,
)
from sms_jobs.cli.options import Force
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.shown.states import MET_BY, FoundState, StatePage, table_of
from sms_jobs.records.views import place_of_view

_MARKED = "{} *"


def states(
    query: Annotated[
        str | None,
        typer.Argument(help="What to find, in quotation marks: 'load > 50 kN and time in 2026-05'."),
    ] = None,
    kind: Annotated[
        str | None, typer.Option(help="Only with a result of this kind; statistics are those of it.")
    ] = None,
    campaign: OfCampaign = None,
    state: OfState = None,
    view: OfView = None,
    limit: Limit = 50,
    after: After = None,
    columns: Annotated[
        str | None,
        typer.Option(
            help="What to tell of each state, with commas between: campaign,state,load_kN,temp_c,merge.faces."
        ),
    ] = None,
    form: As = None,
    out: Out = None,
    force: Force = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Find load states by what is known of them and what their results tell; docs/query.md has the language.

    Example: sms data states 'load > 50 kN and strain.valid_fraction < 0.8 and time in 2026-05'
    """
    asked = finding.question(query or "", kind=kind, campaign=campaign, state=state, view=view)
    options = FindOptions(finding.portion(columns, after, limit), form, out, force, as_json)
    form = found_files.form_of(options)
    with bootstrap.services(home) as services:
        pages = list(find_states(services, asked, options.portion))
    _tell(pages, form, options)


def _tell(pages: Sequence[StatePage], form: Format, options: FindOptions) -> None:
    columns, by_view, last = pages[0].columns, pages[0].by_view, pages[-1].next
    found = [one for page in pages for one in page.rows]
    if options.as_json:
        output.print_json_list(map(_object, found))
    elif form is Format.JSON:
        output.print_json({"states": [_object(one) for one in found], "next": last})
        return
    elif form is Format.LINES:
        for one in found:
            output.print_line(_object(one))
        output.print_json({"next": last})
        return
    elif form is Format.TABLE:
        titles, rows = _shown(columns, by_view, found)
        output.print_table(titles, rows, empty="there is no such state")
        if any(_marked(one, view) for one in found for view in one.views):
            output.say("of the views those with a * meet the query")
    else:
        titles, cells = table_of(columns, by_view, found)
        found_files.write(form, options, titles, cells, "states")
    if last is not None:
        output.say(f"there are more; go on with --after {last}")


def _object(one: FoundState) -> dict[str, Any]:
    told = dict(one.values) | {"views": one.views}
    return told if one.met_by is None else told | {MET_BY: one.met_by}


def _shown(
    columns: Sequence[str], by_view: Sequence[str], states: Sequence[FoundState]
) -> tuple[list[str], list[list[str]]]:
    """Return titles and rows for people: of a state what its views tell stands below each other."""
    whole = [name for name in columns if name not in by_view]
    with_views = bool(by_view) or any(one.met_by is not None for one in states)
    titles = [*whole, *(["view"] if with_views else []), *by_view]

    def row(one: FoundState) -> list[str]:
        cells = [output.shown(one.values[name]) for name in whole]
        views = sorted({*one.views, *(one.met_by or ())}, key=place_of_view)
        if with_views:
            cells.append("\n".join(_MARKED.format(view) if _marked(one, view) else view for view in views))
        of_views = ((output.shown(one.views.get(view, {}).get(name)) for view in views) for name in by_view)
        return [*cells, *("\n".join(lines) for lines in of_views)]

    return titles, [row(one) for one in states]


def _marked(state: FoundState, view: str) -> bool:
    """Say whether a view is to be told from others of its state by that it meets the query."""
    met = state.met_by or ()
    return view in met and any(other not in met for other in state.views)
