"""Who did what: shown, written to a file, and proved to be as it was written."""

from __future__ import annotations

import json
import re
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sms_jobs.app.row_tables import write_csv
from sms_jobs.app.rules import use_case
from sms_jobs.app.writing import new_file
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import audit, sealing
from sms_jobs.errors import InvalidInput
from sms_jobs.records.people import Right
from sms_jobs.records.shown.people import Link

FORMATS = (".csv", ".jsonl")
"""Endings of the files that the audit is written to."""
_HEAD = re.compile(r"(\d{1,18}):([0-9a-f]{64})")


@dataclass(frozen=True)
class Head:
    """Number and digest of a link, to be kept where nobody who can change the catalogue can change it."""

    number: int
    digest: str

    def __str__(self) -> str:
        return f"{self.number}:{self.digest}"

    @classmethod
    def parse(cls, text: str) -> Head:
        """Read what `str` has written; raise `InvalidInput` for anything else."""
        found = _HEAD.fullmatch(text.strip())
        if found is None:
            raise InvalidInput(f"'{text[:100]}' is no NUMBER:DIGEST, as 'sms audit head' prints it")
        return cls(int(found[1]), found[2])


@dataclass(frozen=True)
class Verified:
    """How many links and events of jobs were compared, and where they are not as they were written."""

    links: int
    events: int
    breaks: tuple[str, ...]


@use_case(Right.ADMINISTER)
def list_links(
    services: Services,
    *,
    who: str | None = None,
    action: str | None = None,
    since: datetime | None = None,
    limit: int = 50,
    after: int | None = None,
) -> list[Link]:
    """Return what was done, the newest first.

    Parameters
    ----------
    who
        Only by this person, account or schedule.
    action
        Only this use case, as `jobs.cancel`, or all of a group, as `jobs`.
    since
        Only from then on.
    after
        Number of the last link that is known already.
    """
    with services.catalogue.reading() as session:
        return audit.listed(session, who=who, action=action, since=since, limit=limit, after=after)


@use_case(Right.ADMINISTER)
def export(services: Services, out: Path, *, force: bool = False) -> int:
    """Write the whole audit, the oldest first, as CSV or as lines of JSON; return how many links.

    Raises
    ------
    InvalidInput
        The file ends in neither of `FORMATS`, or cannot be written.
    Conflict
        It is there, and `force` is not given.
    """
    with (
        services.catalogue.reading() as session,
        new_file(out, force, FORMATS) as part,
        part.open("w", encoding="utf-8", newline="") as stream,
    ):
        rows = (_plain(link) for link in audit.all_links(session))
        if out.suffix == ".csv":
            return write_csv(stream, [field.name for field in fields(Link)], map(_cells, rows))
        return sum(stream.write(json.dumps(row, ensure_ascii=False) + "\n") > 0 for row in rows)


@use_case(Right.READ)
def head(services: Services) -> Head:
    """Return the last link; number 0 and zeros where nothing was done yet."""
    with services.catalogue.reading() as session:
        return Head(*audit.head(session))


@use_case(Right.COMPUTE)
def verify(services: Services, kept: Head | None = None) -> Verified:
    """Seal what has happened to jobs, and prove that all is as it was written.

    Parameters
    ----------
    kept
        A link that was the last once; it has to be there still.
    """
    if services.catalogue.may_write:
        sealing.seal(services.catalogue, datetime.now(UTC))
    with services.catalogue.reading() as session:
        links, events = audit.extent(session)
        found = audit.breaks(session, None if kept is None else (kept.number, kept.digest))
        return Verified(links, events, tuple(found))


def _plain(link: Link) -> dict[str, Any]:
    return asdict(link) | {"at": link.at.isoformat()}


def _cells(row: dict[str, Any]) -> list[Any]:
    """Return a link as cells, none of which a spreadsheet takes for a formula."""
    told = [json.dumps(v, ensure_ascii=False) if isinstance(v, dict) else v for v in row.values()]
    return [f"'{t}" if isinstance(t, str) and t.startswith(("=", "+", "-", "@")) else t for t in told]
