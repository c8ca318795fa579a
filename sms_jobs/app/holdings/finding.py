"""Finds files by what is known of them, and keeps questions that are asked again."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import PurePosixPath
from typing import Any, TypeVar

from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.queries import files, saved
from sms_jobs.catalogue.queries.language import Query, parse
from sms_jobs.catalogue.queries.saved import SavedQuery
from sms_jobs.errors import InvalidInput
from sms_jobs.jobs.asking.found_states import vocabulary
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import FileView, Found, Page
from sms_jobs.records.shown.portion import FIRST, Portion
from sms_jobs.records.shown.states import StatePage
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
"""Files or states that are fetched at once, however many are asked for."""

SomePage = TypeVar("SomePage", Page, StatePage)


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
def find(services: Services, asked: Question, told: Portion = FIRST) -> Iterator[Page]:
    """Yield the files that meet a question, the newest first, page by page; at least one page.

    Parameters
    ----------
    told
        Of all pages together. Columns may be of `OF_FILE` as well; without any, files tell what the question
        compares.

    Raises
    ------
    InvalidInput
        A name is not known, or it is compared with what it cannot be compared with.
    NotFound
        There is no such campaign, calibration, or state that the question is restricted to.
    """
    names, columns = vocabulary(), told.columns
    extra = None if columns is None else [name for name in columns if name not in OF_FILE]

    def page(part: Portion) -> Page:
        with services.catalogue.reading() as session:
            found = files.find_page(session, asked.query, names, part)
        return found if columns is None else _with_columns(found, columns)

    return in_pages(replace(told, columns=extra), page)


def in_pages(told: Portion, page: Callable[[Portion], SomePage]) -> Iterator[SomePage]:
    """Yield page after page until a portion is whole or there is no more; at least one page."""
    while True:
        found = page(replace(told, limit=min(told.limit, _PAGE)))
        yield found
        told = replace(told, limit=told.limit - len(found.rows), after=found.next)
        if told.limit <= 0 or told.after is None:
            return


def portion(columns: str | None, after: int | None, limit: int) -> Portion:
    """Return a portion whose columns are written with commas between; `InvalidInput` for an empty name."""
    return Portion(None if columns is None else _names(columns), after, limit)


def _names(text: str) -> list[str]:
    names = list(dict.fromkeys(name.strip() for name in text.split(",")))
    if not all(names):
        raise InvalidInput(f"`columns` '{text}' contain an empty name; write them like file,subject,load_kN")
    return names


def _with_columns(page: Page, columns: Sequence[str]) -> Page:
    """Return a page that shows of each file what was asked for, in that order."""
    found = (
        Found(one.file, {n: OF_FILE[n](one.file) if n in OF_FILE else one.values[n] for n in columns})
        for one in page.rows
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
