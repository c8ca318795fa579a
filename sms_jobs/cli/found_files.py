"""`sms data find`, and what `states` and `query run` share with it: options, and how files are told."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from itertools import chain
from pathlib import Path
from typing import Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.app import writing
from sms_jobs.app.holdings import finding
from sms_jobs.app.holdings.finding import OF_FILE, Question
from sms_jobs.app.row_tables import write_csv, write_parquet
from sms_jobs.cli import completion, output
from sms_jobs.cli.options import Force
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.records.shown.files import Found, Page
from sms_jobs.records.shown.portion import Portion


class Format(StrEnum):
    """How found files are shown."""

    TABLE = "table"
    JSON = "json"
    LINES = "lines"
    CSV = "csv"
    PARQUET = "parquet"


OfCampaign = Annotated[
    str | None,
    typer.Option("--campaign", "-c", help="Only of this campaign.", autocompletion=completion.campaign_names),
]
OfState = Annotated[str | None, typer.Option(help="Only of this state.")]
OfView = Annotated[str | None, typer.Option(help="Only of this view.")]
Limit = Annotated[int, typer.Option(help="At most so many.", min=1, max=100_000)]
After = Annotated[
    int | None, typer.Option(help="Go on after this one: the 'next' of the page before.", min=1)
]
Columns = Annotated[
    str | None,
    typer.Option(help="What to tell of each file, with commas between: file,subject,load_kN,param.method."),
]
As = Annotated[
    Format | None,
    typer.Option(
        "--format",
        help="table; json with the key of the next page; lines of JSON; csv; parquet (a file). By the suffix "
        "of --out if not given, else table.",
        show_default=False,
    ),
]
Out = Annotated[
    Path | None, typer.Option("--out", "-o", help="File to write, .csv or .parquet; else the screen.")
]

_NO_FILE = "there is no such file"
_SHOWN = ("file", "kind", "subject", "type", "size", "created")
_WRITTEN = ("file", "kind", "subject", "path", "size_bytes", "content_hash", "created", "job")


@dataclass(frozen=True)
class FindOptions:
    """Which of the files or states that meet a query are shown, and how."""

    portion: Portion
    form: Format | None
    out: Path | None
    force: bool
    as_json: bool


def find(
    query: Annotated[
        str | None,
        typer.Argument(help="What to find, in quotation marks: 'strain where load_kN > 1400'."),
    ] = None,
    kind: Annotated[
        str | None, typer.Option(help="measurement, calibration, or the kind of a result.")
    ] = None,
    campaign: OfCampaign = None,
    state: OfState = None,
    view: OfView = None,
    limit: Limit = 50,
    after: After = None,
    columns: Columns = None,
    form: As = None,
    out: Out = None,
    force: Force = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Find measurements, results and calibrations, the newest first; docs/query.md has the language.

    Example: sms data find 'strain where load_kN > 1400 and max_principal > 1e-3' -c wing-fatigue
    """
    asked = finding.question(query or "", kind=kind, campaign=campaign, state=state, view=view)
    portion = finding.portion(columns, after, limit)
    any_at_all = query or after or any(one is not None for one in (kind, campaign, state, view))
    empty = (
        _NO_FILE if any_at_all else "there is no file yet; 'sms campaign create' and 'sms import' make some"
    )
    tell(home, lambda _: asked, FindOptions(portion, form, out, force, as_json), empty)


def tell(
    home: Path | None,
    ask: Callable[[bootstrap.Services], Question],
    options: FindOptions,
    empty: str = _NO_FILE,
) -> None:
    """Find files and print or write them; `empty` is said where there are none."""
    form = form_of(options)
    with bootstrap.services(home) as services:
        pages = finding.find(services, ask(services), options.portion)
        first = next(pages)
        _tell(first, chain([first], pages), form, options, empty)


def _tell(first: Page, pages: Iterator[Page], form: Format, options: FindOptions, empty: str) -> None:
    last, names = first.next, options.portion.columns

    def files() -> Iterator[Found]:
        nonlocal last
        for page in pages:
            last = page.next
            yield from page.rows

    if options.as_json:
        output.print_json_list(_object(one, names) for one in files())
    elif form is Format.JSON:
        objects = [_object(one, names) for one in files()]
        output.print_json({"files": objects, "next": last})
        return
    elif form is Format.LINES:
        for one in files():
            output.print_line(_object(one, names))
        output.print_json({"next": last})
        return
    elif form is Format.TABLE:
        columns = names or [*_SHOWN, *(c for c in first.columns if c not in _SHOWN)]
        output.print_table(columns, (_row(one, columns) for one in files()), empty=empty)
    else:
        columns = names or [*_WRITTEN, *(c for c in first.columns if c not in _WRITTEN)]
        write(form, options, columns, (_row(one, columns) for one in files()), "files")
    if last is not None:
        output.say(f"there are more; go on with --after {last}")


def write(
    form: Format, options: FindOptions, columns: Sequence[str], rows: Iterable[Sequence[Any]], what: str
) -> None:
    """Write a table as CSV or Parquet into the file that is named, or CSV on the screen."""
    if options.out is None:
        text = io.StringIO(newline="")
        write_csv(text, columns, rows)
        output.print_text(text.getvalue())
        return
    with writing.new_file(options.out, options.force) as part:
        if form is Format.PARQUET:
            count = write_parquet(part, columns, rows)
        else:
            with part.open("w", encoding="utf-8", newline="") as stream:
                count = write_csv(stream, columns, rows)
    output.say(f"wrote {count} {what} into {options.out}")


def form_of(options: FindOptions) -> Format:
    """Return how the answer is told; refuse what does not go together, before anything is looked for."""
    if options.out is not None:
        return _form_of_file(options, options.out)
    form = options.form or Format.TABLE
    if options.as_json and form is not Format.TABLE:
        raise InvalidInput(f"--json and --format {form.value} exclude each other; give one of them")
    if form is Format.PARQUET:
        raise InvalidInput("a Parquet file cannot be shown on a screen; say where to write it with --out")
    return form


def _form_of_file(options: FindOptions, out: Path) -> Format:
    """Return the format of a file: the one that is asked for, else that of its suffix."""
    written = {".csv": Format.CSV, ".parquet": Format.PARQUET}
    if options.as_json or options.form not in (None, *written.values()):
        raise InvalidInput("--out writes --format csv or --format parquet; the rest goes to the screen")
    endings = tuple(s for s, form in written.items() if options.form in (None, form))
    writing.check_new_file(out, options.force, endings)
    return written[out.suffix]


def _value(one: Found, name: str) -> Any:
    return one.values[name] if name in one.values else OF_FILE[name](one.file)


def _row(one: Found, columns: Sequence[str]) -> list[Any]:
    return [_value(one, name) for name in columns]


def _object(one: Found, names: Sequence[str] | None) -> dict[str, Any]:
    if names is not None:
        return {name: _value(one, name) for name in names}
    return asdict(one.file) | ({"values": one.values} if one.values else {})
