"""Tables of comma-separated values, as strangers write them: read within limits, or refused."""

from __future__ import annotations

import csv
from collections.abc import Iterable

from sms_jobs.errors import InvalidInput


def csv_cells(
    lines: Iterable[str], source: str, delimiter: str = ",", *, skip_spaces: bool = False
) -> list[list[str]]:
    """Return the cells of every row; raise `InvalidInput` for what is no table, or has endless cells."""
    try:
        return list(csv.reader(lines, delimiter=delimiter, skipinitialspace=skip_spaces))
    except (csv.Error, TypeError, ValueError) as error:
        raise InvalidInput(
            f"{source} cannot be read as a table ({error}): correct it, or its delimiter"
        ) from None


def csv_rows(
    lines: Iterable[str], source: str, *, skip_spaces: bool = False
) -> tuple[list[str], list[dict[str, str]]]:
    """Return the names of the columns and the rows by them, empty rows left out and missing cells empty."""
    header, *rows = csv_cells(lines, source, skip_spaces=skip_spaces) or [[]]
    return header, [dict.fromkeys(header, "") | dict(zip(header, row, strict=False)) for row in rows if row]
