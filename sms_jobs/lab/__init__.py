"""The Python interface: a home in a notebook, with fields as xarray and tables as pandas.

It calls the use cases of `sms_jobs.app` and computes nothing itself. xarray and pandas are those of the extra
`notebook`; they are imported where they are needed.
"""

from __future__ import annotations

import json
import os
import weakref
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from sms_jobs import bootstrap
from sms_jobs.app import finding, jobs, reading, waiting
from sms_jobs.app.jobs import Submitted, Work
from sms_jobs.app.reading import StoredRecord
from sms_jobs.app.waiting import Waited
from sms_jobs.errors import ConfigurationError
from sms_jobs.records.quantity import Quantity, quantities, quantities_of
from sms_jobs.records.reasons import Reason
from sms_jobs.records.shown.files import FileView, Found

if TYPE_CHECKING:
    import pandas
    import xarray

_MISSING = "{package} is not installed: run \"pip install 'sms-jobs[notebook]'\""
_UNCERTAINTY = ("sigma", "covariance", "reason")
"""Arrays that say how well the others are known, or why they are not."""


_OF_EVERY_FILE = ("file", "kind", "subject", "created")


@dataclass(frozen=True)
class FoundFiles:
    """Files that were found, the newest first, each with what was asked about it."""

    columns: tuple[str, ...]
    found: tuple[Found, ...]

    def __len__(self) -> int:
        return len(self.found)

    def __iter__(self) -> Iterator[FileView]:
        return (one.file for one in self.found)

    def table(self) -> pandas.DataFrame:
        """Return a row for each file: number, kind, subject, when it was made, and what was asked.

        Raises `ConfigurationError` where pandas is not installed.
        """
        try:
            import pandas
        except ImportError as error:
            raise ConfigurationError(_MISSING.format(package="pandas")) from error
        rows = [
            {
                "file": f.file.id,
                "kind": f.file.source,
                "subject": f.file.subject,
                "created": f.file.created_at,
            }
            | f.values
            for f in self.found
        ]
        return pandas.DataFrame(rows, columns=list(dict.fromkeys([*_OF_EVERY_FILE, *self.columns])))


class Lab:
    """A home that is open; `close` it, or use it in a `with` statement.

    Parameters
    ----------
    home
        Its folder; the usual one if it is None.

    Raises
    ------
    ConfigurationError
        There is no home, or its catalogue is older than this version needs.
    """

    def __init__(self, home: str | os.PathLike[str] | None = None) -> None:
        stack = ExitStack()
        self._services = stack.enter_context(bootstrap.services(None if home is None else Path(home)))
        self.close = weakref.finalize(self, stack.close)

    def __repr__(self) -> str:
        return f"<sms_jobs home {self._services.settings.home}>"

    def __enter__(self) -> Lab:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def find(
        self, query: str = "", *, columns: Sequence[str] | None = None, limit: int = 10_000
    ) -> FoundFiles:
        """Find measurements, results and calibrations in the language of docs/query.md, the newest first.

        Parameters
        ----------
        columns
            What to tell of each file; what the query compares if it is None.
        limit
            At most so many files.

        Raises
        ------
        InvalidInput
            The query cannot be understood.
        NotFound
            It names a campaign or calibration that is not there.
        """
        pages = list(finding.find(self._services, finding.question(query), columns=columns, limit=limit))
        return FoundFiles(pages[0].columns, tuple(found for page in pages for found in page.found))

    def read(self, what_of: str | int, what: str | None = None) -> xarray.Dataset:
        """Read the newest record about a subject, or a record of a file, with units, sigma and provenance.

        Frames of measurements are left out: they are larger than memory.

        Parameters
        ----------
        what_of
            A subject as campaign/state/view, or the number of a file.
        what
            Name of a kind or of a record, such as strain, displacement or surface; None for the first record
            of a file.

        Returns
        -------
        One variable for each array of the record, as docs/python.md describes.

        Raises
        ------
        NotFound
            There is no such file, record or result.
        InvalidInput
            It is no subject, or a document.
        ArchiveCorrupt
            The file is not as it was sealed.
        ConfigurationError
            xarray is not installed.
        """
        if isinstance(what_of, int) or what is None:
            return _dataset(reading.of_file(self._services, str(what_of), what))
        return _dataset(reading.newest(self._services, what_of, what))

    def submit(
        self,
        kind: str,
        campaign: str,
        /,
        *,
        states: Sequence[str] = (),
        views: Sequence[str] = (),
        dry_run: bool = False,
        **parameters: Any,
    ) -> Submitted:
        """Submit jobs of a kind, or the "pipeline", for the tuples of a campaign, and say how long they take.

        Parameters
        ----------
        states, views
            Only these; all if they are empty.
        dry_run
            Submit nothing.
        parameters
            Of the kind by name, as gauge_length_mm=30; of the pipeline as **{"strain.gauge_length_mm": 30}.

        Raises
        ------
        NotFound
            There is no such campaign or kind, or something that it needs.
        InvalidInput
            A parameter, state or view is not one of them.
        """
        work = Work(campaign, (kind,), parameters, tuple(states), tuple(views))
        return jobs.submit(self._services, work, dry_run=dry_run)

    def wait(self, job: Submitted | str, timeout_s: float | None = None) -> Waited:
        """Wait for what was submitted, or for the job whose id begins so; a service has to run in the home.

        Returns how many ended in each state.

        Raises
        ------
        JobFailed
            One did not succeed.
        WaitTimedOut
            They have not ended in time; they go on.
        NotFound
            There is no such job.
        """
        some = job.jobs if isinstance(job, Submitted) else jobs.choose(self._services, [job], None)
        waited = waiting.wait_for(self._services, some, timeout_s)
        waited.require_success()
        return waited

    def explain(self, job: str) -> str:
        """Say why the job whose id begins so waits, ran, was reused, or is stale: a sentence a line.

        Raises `NotFound` where there is none.
        """
        return "\n".join(jobs.explain(self._services, job).sentences)


def _dataset(stored: StoredRecord) -> xarray.Dataset:
    """Return a record as a dataset whose attributes say where it comes from."""
    try:
        import xarray
    except ImportError as error:
        raise ConfigurationError(_MISSING.format(package="xarray")) from error
    record = stored.record
    declared = {
        name: quantity
        for name, quantity in quantities_of(record).items()
        if isinstance(getattr(record, name), np.ndarray)
    }
    dimensions = _dimensions(declared)
    aside = [name for name in _UNCERTAINTY if name in declared]
    variables = {}
    for name, quantity in declared.items():
        attributes: dict[str, Any] = {"units": quantity.unit, "long_name": quantity.meaning}
        if quantity.unit == "bit":
            attributes |= _flags()
        if name not in aside and aside:
            attributes["ancillary_variables"] = " ".join(aside)
        variables[name] = (dimensions[name], getattr(record, name), attributes)
    labels = {
        dimensions[name][quantity.axes.index("component")]: list(quantity.components)
        for name, quantity in declared.items()
        if quantity.components
    }
    return xarray.Dataset(variables, labels, {**_scalars(record), **_provenance(stored)})


def _dimensions(declared: dict[str, Quantity]) -> dict[str, tuple[str, ...]]:
    """Return the axes of each array; components that differ are named by the first array with them."""
    kinds: dict[tuple[str, ...], str] = {}
    for name, quantity in declared.items():
        if "component" in quantity.axes:
            kinds.setdefault(quantity.components, name)
    alike = len(kinds) <= 1
    return {
        name: tuple(
            f"{kinds[quantity.components]}_component" if axis == "component" and not alike else axis
            for axis in quantity.axes
        )
        for name, quantity in declared.items()
    }


def _flags() -> dict[str, Any]:
    """Return what the bits of a reason mean, as the CF conventions write it."""
    bits = [reason for reason in Reason if reason]
    return {
        "flag_masks": np.array([reason.value for reason in bits], np.uint32),
        "flag_meanings": " ".join(str(reason.name).lower() for reason in bits),
    }


def _scalars(record: Any) -> dict[str, Any]:
    """Return what a record says besides its arrays; what is no number or text, as JSON."""
    arrays = quantities(type(record))
    given = {f.name: getattr(record, f.name) for f in fields(record) if f.name not in arrays}
    return {
        name: value if type(value) in (str, int, float) else _as_json(value)
        for name, value in given.items()
        if value is not None
    }


def _provenance(stored: StoredRecord) -> dict[str, Any]:
    file, made = stored.file, stored.provenance
    return {
        "subject": file.subject,
        "record": stored.name,
        "kind": made.kind,
        "kind_version": made.kind_version,
        "job": made.job_id,
        "parameters": _as_json(dict(made.parameters)),
        "inputs": _as_json([asdict(one) for one in made.inputs]),
        "created": made.created_at.isoformat(),
        "program_version": made.program_version,
        "file": file.id,
        "path": file.path,
        "content_hash": file.content_hash,
    }


def _as_json(value: Any) -> str:
    def plain(one: Any) -> Any:
        return asdict(one) if is_dataclass(one) and not isinstance(one, type) else str(one)

    return json.dumps(value, default=plain, ensure_ascii=False)
