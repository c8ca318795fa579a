"""Results after which others of the same kind and subject have come."""

from __future__ import annotations

from collections.abc import Collection
from itertools import product
from typing import Any, cast

from sqlalchemy import Select, Table, bindparam, select, union_all
from sqlalchemy.orm import Session

from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.tables.files import FileRow

# Every job that could be reused asks this: making the statement takes longer than running it.
_FILE = cast(Table, FileRow.__table__)
_NEWER = _FILE.alias()


def _newer(of_state: bool, of_view: bool) -> Select[Any]:
    """Select what other jobs made after some; null is equal to nothing, hence four of these."""
    alike = (_NEWER.c.campaign_id, _NEWER.c.source, _NEWER.c.media_type)
    query = select(_FILE.c.job_id, _NEWER.c.id).where(
        _FILE.c.job_id.in_(bindparam("jobs", expanding=True)),
        *(column == _FILE.c[column.name] for column in alike),
        _NEWER.c.id > _FILE.c.id,
        _NEWER.c.content_hash != _FILE.c.content_hash,
        _NEWER.c.job_id.is_distinct_from(_FILE.c.job_id),
    )
    for column, has in ((_NEWER.c.state_id, of_state), (_NEWER.c.view, of_view)):
        same = _FILE.c[column.name]
        query = query.where(column == same if has else column.is_(None) & same.is_(None))
    return query


_NEWER_THAN_THEIRS = union_all(*(_newer(*has) for has in product((True, False), repeat=2)))


def replaced(session: Session, job_ids: Collection[str]) -> set[str]:
    """Return those of some jobs after whose results others of the same kinds and subjects have come.

    Whoever asks for the newest gets those others. A result that is asked for again is computed again then, so
    that it is the newest: reused, it would be shown as done and the others would be read. What lies along
    another frame of the specimen than the campaign has is never read as the newest, and does not count.
    """
    found = {
        (row.job_id, row.id)
        for some in parts(sorted(job_ids))
        for row in session.execute(_NEWER_THAN_THEIRS, {"jobs": some})
    }
    if not found:
        return set()
    from sms_jobs.jobs.results.turned import is_turned_file

    return {job_id for job_id, number in sorted(found) if not is_turned_file(session, number)}
