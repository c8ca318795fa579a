"""What a file was computed from, and what was computed from it, as a tree of limited size."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

from sqlalchemy import select
from sqlalchemy.orm import InstrumentedAttribute, Session

from sms_jobs.catalogue.parts import parts
from sms_jobs.catalogue.search import views_with
from sms_jobs.catalogue.tables.files import FileRow, ProvenanceRow
from sms_jobs.catalogue.tables.queues import DependencyRow
from sms_jobs.records.shown.files import Ancestor, Family, FileView

GENERATIONS = 100
"""A tree goes no deeper; further down it is asked for from there."""
MOST = 5000
"""Entries of one tree."""


def ancestry(session: Session, file: FileView) -> Family:
    """Return what a file was computed from, and so on back to what was measured; each file's inputs once."""
    return _family(session, file.id, down=False)


def descent(session: Session, file: FileView) -> Family:
    """Return what was computed from a file, and so on to what nothing was made of; each file's outputs once.

    The role is what the file above was to this one.
    """
    return _family(session, file.id, down=True)


_Edge = tuple[int, str, int]
"""A file, the role of its neighbour, and that."""


def kin(session: Session, files: Iterable[int], *, down: bool) -> set[int]:
    """Return what was computed from some files, and from that, and so on; not `down`, what they were."""
    known, other = _ends(down)
    found: set[int] = set()
    front = set(files)
    while front:
        met: set[int] = set()
        for some in parts(sorted(front)):
            met.update(session.scalars(select(other).where(known.in_(some))))
        front = met - found
        found |= front
    return found


def input_hashes(session: Session, job_id: str) -> dict[str, str]:
    """Return the content hash of each input of a job, by role."""
    rows = session.execute(
        select(DependencyRow.role, FileRow.content_hash)
        .join(FileRow, FileRow.id == DependencyRow.file_id)
        .where(DependencyRow.job_id == job_id)
    )
    return dict(rows.all())


def _family(session: Session, root: int, *, down: bool) -> Family:
    edges: list[_Edge] = []
    below: defaultdict[int, list[_Edge]] = defaultdict(list)
    # Generation by generation: a file's inputs are shown where it is nearest to the root.
    shown_at: dict[int, _Edge] = {}
    order, level = [root], [root]
    for _ in range(GENERATIONS):
        found = _edges(session, level, MOST + 1 - len(edges), down)
        edges += found
        for edge in found[: MOST + len(found) - len(edges)]:
            below[edge[0]].append(edge)
            shown_at.setdefault(edge[2], edge)
        level = [edge[2] for edge in found if shown_at.get(edge[2]) == edge]
        order += level
        if not level or len(edges) > MOST:
            break
    # The last generation is not followed, and the last entries may be left out.
    more = _with_edges(session, [*level, *{edge[0] for edge in edges[MOST:]}], down) if level else set()
    views = {view.id: view for view, _ in views_with(session, list(shown_at), ())}
    built: dict[int, tuple[Ancestor, ...]] = {}
    for file_id in reversed(order):
        built[file_id] = tuple(
            Ancestor(role, views[there], built[there], repeated=False, more=there in more)
            if shown_at[there] == (file_id, role, there)
            else Ancestor(role, views[there], (), repeated=True, more=False)
            for _, role, there in below[file_id]
        )
    return Family(built[root], root in more)


def _ends(down: bool) -> tuple[InstrumentedAttribute[int], InstrumentedAttribute[int]]:
    edge = ProvenanceRow
    return (edge.input_id, edge.output_id) if down else (edge.output_id, edge.input_id)


def _edges(session: Session, files: Sequence[int], most: int, down: bool) -> list[_Edge]:
    here, there = _ends(down)
    order = (here, there) if down else (here, ProvenanceRow.role)
    found: list[_Edge] = []
    for some in parts(files):
        query = select(here, ProvenanceRow.role, there).where(here.in_(some)).order_by(*order)
        found += [(a, role, b) for a, role, b in session.execute(query.limit(most - len(found)))]
    return found


def _with_edges(session: Session, files: Sequence[int], down: bool) -> set[int]:
    here, _ = _ends(down)
    return {
        file_id
        for some in parts(files)
        for file_id in session.scalars(select(here).where(here.in_(some)).distinct())
    }
