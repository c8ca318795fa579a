"""Tables with named columns as CSV and Parquet, for spreadsheets and other programs."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, TextIO

from sms_jobs.errors import ConfigurationError


def write_csv(stream: TextIO, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> int:
    """Write a header and rows, and return how many; times in ISO 8601, nothing where nothing is known."""
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    count = 0
    for row in rows:
        writer.writerow([cell.isoformat() if isinstance(cell, datetime) else cell for cell in row])
        count += 1
    return count


def write_parquet(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> int:
    """Write typed columns, compressed by Zstandard, and return how many rows.

    Raises
    ------
    ConfigurationError
        The package that writes Parquet is not installed.
    """
    try:
        # Optional, and heavier than most of what the program needs (ADR 7).
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise ConfigurationError(
            "Parquet files need a package that is not installed: run \"pip install 'sms-jobs[parquet]'\", "
            "or choose the `format` csv"
        ) from error
    table = list(rows)
    cells = [[row[place] for row in table] for place in range(len(columns))]
    schema = pyarrow.schema(
        [(name, _column_type(c, pyarrow)) for name, c in zip(columns, cells, strict=True)]
    )
    typed = [
        [_as_type(cell, kind, pyarrow) for cell in c] for c, kind in zip(cells, schema.types, strict=True)
    ]
    parquet.write_table(pyarrow.table(typed, schema=schema), path, compression="zstd")
    return len(table)


def _column_type(cells: Sequence[Any], pyarrow: Any) -> Any:
    """Return the type that holds all cells; a float where nothing is known."""
    kinds = {type(cell) for cell in cells if cell is not None}
    if kinds <= {int} and kinds:
        return pyarrow.int64()
    if kinds <= {int, float}:
        return pyarrow.float64()
    if kinds == {bool}:
        return pyarrow.bool_()
    if kinds == {datetime}:
        return pyarrow.timestamp("us", tz="UTC")
    return pyarrow.string()


def _as_type(cell: Any, kind: Any, pyarrow: Any) -> Any:
    if cell is None or not pyarrow.types.is_string(kind):
        return cell
    return cell.isoformat() if isinstance(cell, datetime) else str(cell)
