"""The conditions of a campaign as tables: in a report, and for spreadsheets."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from html import escape
from pathlib import Path

from sms_jobs.formats.report.html import Markup, paragraph, table
from sms_jobs.records.shown.conditions import Condition

_WORDS = (
    "What the Good Practices Guide of the International Digital Image Correlation Society asks of a "
    "publication, as far as the archive knows it. Noise is the spatial standard deviation between two states "
    "that follow each other at the same load, bias the mean. What moved between them, a drift or a "
    "specimen that creeps, is part of both; an error that both states share is in neither. The stated "
    "deviation is the root mean square of what the results say of themselves: camera noise and misfit, not "
    "the calibration."
)


def conditions_markup(found: Sequence[Condition]) -> list[Markup]:
    """Return a table for each group, in order."""
    parts = [paragraph(_WORDS, faint=True)]
    for group in dict.fromkeys(one.group for one in found):
        parts.append(Markup(f"<h3>{escape(group)}</h3>"))
        rows = [[one.name, one.about, one.value] for one in found if one.group == group]
        parts.append(table(["what", "of", "value"], rows))
    return parts


def conditions_csv(found: Sequence[Condition], path: Path) -> None:
    """Write a row for each condition; raises `OSError` where that cannot be done."""
    with path.open("w", encoding="utf-8", newline="") as out:
        writer = csv.writer(out)
        writer.writerow(["group", "what", "of", "value"])
        writer.writerows([one.group, one.name, one.about, one.value] for one in found)
