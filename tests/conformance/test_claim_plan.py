"""A claim looks at one of ten thousand queued jobs, not at all of them."""

from __future__ import annotations

from typing import Any

from sqlalchemy import event
from support.jobs import claim, submit_pipeline

from sms_jobs.catalogue.database import Catalogue


def test_the_next_job_comes_from_an_index_in_the_order_of_claims(catalogue: Catalogue) -> None:
    submit_pipeline(catalogue)
    asked: list[tuple[str, Any]] = []

    def note(connection: Any, cursor: Any, text: str, values: Any, context: Any, many: bool) -> None:
        asked.append((text, values))

    event.listen(catalogue.engine, "before_cursor_execute", note)
    assert claim(catalogue) is not None
    event.remove(catalogue.engine, "before_cursor_execute", note)
    (text, values) = next(one for one in asked if one[0].startswith("UPDATE job"))
    with catalogue.writing() as session:
        connection = session.connection()
        if catalogue.dialect == "sqlite":
            plan = "\n".join(
                row[3] for row in connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {text}", values)
            )
        else:
            # Among a few jobs it would rather look at all of them.
            connection.exec_driver_sql("SET LOCAL enable_seqscan = off")
            connection.exec_driver_sql("SET LOCAL enable_bitmapscan = off")
            plan = "\n".join(row[0] for row in connection.exec_driver_sql(f"EXPLAIN {text}", values))
    assert "ix_job_next" in plan
    assert "TEMP B-TREE" not in plan
    assert "Sort" not in plan
