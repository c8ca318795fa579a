"""Finds files by what is known of them, and keeps questions that are asked again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import Any

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.queries import files, saved
from sms_jobs.catalogue.queries.language import Query, parse
from sms_jobs.catalogue.queries.saved import SavedQuery
from sms_jobs.errors import InvalidInput
from sms_jobs.jobs.asking.found_states import vocabulary
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import FileView, Found, Page
from sms_jobs.records.sizes import size

OF_FILE: dict[str, Callable[[FileView], Any]] = {
    "file": lambda f: f.id,
    "kind": lambda f: f.source,
    "subject": lambda f: f.subject,
    "type": lambda f: PurePosixPath(f.path).suffix,
    "size": lambda f: size(f.size_bytes),
    "created": lambda f: f.created_at,
    "path": lambda f: f.path,
    "size_bytes": lambda f: f.size_bytes,
    "content_hash": lambda f: f.content_hash,
    "job": lambda f: f.job_id,
}
"""Columns that every file has."""
_PAGE = 1000
"""Files that are fetched at once, however many are asked for."""


@dataclass(frozen=True)
class Question:
    """What is asked of the files."""

    query: Query


def question(
    text: str = "",
    *,
    kind: str | None = None,
    campaign: str | None = None,
    state: str | None = None,
    view: str | None = None,
) -> Question:
    """Return a question in the language of docs/query.md, restricted to a kind, campaign, state or view.

    Raises `InvalidInput` for a text that is not of that language.
    """
    return Question(files.restricted(parse(text), kind=kind, campaign=campaign, state=state, view=view))


@use_case(Right.READ)
def saved_question(services: Services, name: str) -> Question:
    """Return a question that is kept under a name; raises `NotFound` where there is none."""
    with services.catalogue.reading() as session:
        return Question(parse(saved.text_of(session, name)))


@use_case(Right.READ)
def find(
    services: Services,
    asked: Question,
    *,
    columns: Sequence[str] | None = None,
    after: int | None = None,
    limit: int = 50,
) -> Iterator[Page]:
    """Yield the files that meet a question, the newest first, page by page; at least one page.

    Parameters
    ----------
    columns
        What to tell of each file: names of the query language, or of `OF_FILE`; what the question compares
        if it is None.
    after
        `Page.next` of the last page that is known already.
    limit
        Of all pages together.

    Raises
    ------
    InvalidInput
        A name is not known, or it is compared with what it cannot be compared with.
    NotFound
        There is no such campaign or calibration.
    """
    names = vocabulary()
    extra = None if columns is None else [name for name in columns if name not in OF_FILE]
    while True:
        with services.catalogue.reading() as session:
            page = files.find_page(
                session, asked.query, names, columns=extra, after=after, limit=min(limit, _PAGE)
            )
        yield page if columns is None else _with_columns(page, columns)
        limit, after = limit - len(page.found), page.next
        if limit <= 0 or after is None:
            return


def column_names(text: str) -> list[str]:
    """Return the names of columns that are written with commas between; `InvalidInput` for an empty one."""
    names = list(dict.fromkeys(name.strip() for name in text.split(",")))
    if not all(names):
        raise InvalidInput(f"--columns '{text}' has an empty name; write them like file,subject,load_kN")
    return names


def _with_columns(page: Page, columns: Sequence[str]) -> Page:
    """Return a page that tells of each file what was asked for, in that order."""
    found = (
        Found(one.file, {n: OF_FILE[n](one.file) if n in OF_FILE else one.values[n] for n in columns})
        for one in page.found
    )
    return Page(tuple(columns), tuple(found), page.next)


@use_case(Right.COMPUTE)
def save_query(services: Services, name: str, text: str, *, replace: bool = False) -> SavedQuery:
    """Keep a query under a name, if it can be asked.

    Raises
    ------
    InvalidInput
        It cannot, or the name cannot be used.
    Conflict
        There is a query of that name, which is not to be replaced.
    """
    with services.catalogue.writing() as session:
        return saved.save(session, name, text, datetime.now(UTC), vocabulary(), replace=replace)


@use_case(Right.READ)
def queries(services: Services) -> list[SavedQuery]:
    """Return the queries that are kept, by name."""
    with services.catalogue.reading() as session:
        return saved.saved(session)


@use_case(Right.COMPUTE)
def remove_query(services: Services, name: str) -> None:
    """Forget a query; raises `NotFound` where there is none of that name."""
    with services.catalogue.writing() as session:
        saved.remove(session, name)
