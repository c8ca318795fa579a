"""Trees of provenance have a limited size, however long a chain is; the same on both deployments."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
from sqlalchemy import insert
from support.jobs import NOW
from support.statements import heard

from sms_jobs.catalogue import family, search
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow, ProvenanceRow
from sms_jobs.records.shown.files import Ancestor, Family

Edge = tuple[int, str, int]
"""Output, role, input."""


def enter(catalogue: Catalogue, files: int, edges: Sequence[Edge]) -> None:
    with catalogue.writing() as session:
        session.execute(
            insert(FileRow),
            [
                {
                    "id": n,
                    "source": "correlate",
                    "path": f"{n}.h5",
                    "content_hash": "",
                    "size_bytes": 1,
                    "media_type": "application/x-hdf5",
                    "created_at": NOW,
                }
                for n in range(1, files + 1)
            ],
        )
        session.execute(
            insert(ProvenanceRow), [{"output_id": o, "role": r, "input_id": i} for o, r, i in edges]
        )


def tree(catalogue: Catalogue, file: int, *, down: bool = False) -> Family:
    with catalogue.reading() as session:
        view = search.file_view(session, str(file))
        return (family.descent if down else family.ancestry)(session, view)


def shown(some: Sequence[Ancestor]) -> list[object]:
    """Return the numbers in a tree, nested; one whose inputs are shown elsewhere with a minus."""
    return [
        -a.file.id if a.repeated else (a.file.id, shown(a.inputs)) if a.inputs else a.file.id for a in some
    ]


def test_each_file_is_followed_once_where_it_is_nearest(catalogue: Catalogue) -> None:
    enter(catalogue, 5, [(5, "a", 4), (5, "b", 3), (4, "a", 3), (4, "b", 1), (3, "a", 2), (2, "a", 1)])
    assert shown(tree(catalogue, 5).inputs) == [(4, [-3, 1]), (3, [(2, [-1])])]
    assert shown(tree(catalogue, 1, down=True).inputs) == [(2, [(3, [-4, -5])]), (4, [5])]
    assert [a.role for a in tree(catalogue, 5).inputs] == ["a", "b"]
    assert tree(catalogue, 1).inputs == ()


def test_a_long_chain_ends_and_says_that_there_is_more(catalogue: Catalogue) -> None:
    length = 2000
    enter(catalogue, length, [(n + 1, "before", n) for n in range(1, length)])
    with heard(catalogue) as found:
        some = tree(catalogue, length)
    assert len(found.statements) <= 2 * family.GENERATIONS  # of 2000 files
    depth, level = 0, some.inputs
    while level:
        depth, last, level = depth + 1, level[0], level[0].inputs
    assert (depth, last.more, some.more) == (family.GENERATIONS, True, False)
    assert last.file.id == length - depth
    # From there it goes on.
    assert tree(catalogue, last.file.id).inputs[0].file.id == last.file.id - 1
    assert not tree(catalogue, 50).inputs[0].more


def test_of_very_many_descendants_some_are_shown(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    enter(catalogue, 901, [(n, "calibration", 1) for n in range(2, 902)])
    assert len(tree(catalogue, 1, down=True).inputs) == 900
    monkeypatch.setattr(family, "MOST", 600)
    some = tree(catalogue, 1, down=True)
    assert (len(some.inputs), some.more) == (600, True)
