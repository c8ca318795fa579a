"""The Python interface: a home in a notebook, with fields as xarray and tables as pandas.

It calls the use cases of `sms_jobs.app`, here or at a server, and computes nothing itself. xarray and pandas
are those of the extra `notebook`; they are imported where they are needed.
"""

from __future__ import annotations

import os
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, get_args

from sms_jobs.app.holdings.reading import StoredRecord
from sms_jobs.app.specimens.frame_choice import Choice, Place
from sms_jobs.app.specimens.specimen_axes import in_specimen_frame
from sms_jobs.app.specimens.specimen_frames import FrameOf
from sms_jobs.app.work.new_jobs import Submitted, Work
from sms_jobs.app.work.waiting import Waited
from sms_jobs.errors import ConfigurationError, InvalidInput
from sms_jobs.lab.datasets import MISSING, dataset_of
from sms_jobs.lab.recording_plans import RecordingPlans
from sms_jobs.lab.source import Home, Source
from sms_jobs.records.shown.files import FileView, Found
from sms_jobs.records.shown.runs import Difference
from sms_jobs.records.shown.states import table_of

if TYPE_CHECKING:
    import pandas
    import xarray

Frame = Literal["world", "specimen"]
_OF_EVERY_FILE = ("file", "kind", "subject", "created")


def open_home(home: str | os.PathLike[str] | None) -> Lab:
    """Open a home of this machine; see `sms_jobs.open`."""
    return Lab(Home(home))


def connect(url: str, token: str | None) -> Lab:
    """Open a home that a server offers; see `sms_jobs.connect`."""
    # Not loaded by those who open a home of their own.
    from sms_jobs.lab.server import Server

    return Lab(Server(url, token))


@dataclass(frozen=True)
class FoundFiles:
    """Files that were found, the newest first, each with what was asked about it."""

    columns: tuple[str, ...]
    rows: tuple[Found, ...]

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[FileView]:
        return (one.file for one in self.rows)

    def table(self) -> pandas.DataFrame:
        """Return a row for each file: number, kind, subject, when it was made, and what was asked.

        Raises `ConfigurationError` where pandas is not installed.
        """
        rows = [
            {
                "file": f.file.id,
                "kind": f.file.source,
                "subject": f.file.subject,
                "created": f.file.created_at,
            }
            | f.values
            for f in self.rows
        ]
        return _frames().DataFrame(rows, columns=list(dict.fromkeys([*_OF_EVERY_FILE, *self.columns])))


def _frames() -> Any:
    try:
        import pandas
    except ImportError as error:
        raise ConfigurationError(MISSING.format(package="pandas")) from error
    return pandas


def _check_question(query: str, columns: Sequence[str] | None, limit: int) -> None:
    """Raise `InvalidInput` where a notebook asks what no command line could."""
    if not isinstance(query, str):
        raise InvalidInput(f"a query is a text like 'strain where load_N > 0', not {query!r}")
    _check_list("columns", columns)
    if limit < 1:
        raise InvalidInput(f"`limit` is 1 or more, not {limit}")


def _check_list(name: str, several: Sequence[str] | None) -> None:
    if isinstance(several, str):
        raise InvalidInput(f"`{name}` are a list of names: give ['{several}'], not '{several}'")


def _check_job(job: object, kinds: tuple[type, ...], wanted: str) -> None:
    if not isinstance(job, kinds) or not job:
        raise InvalidInput(f"a job is {wanted}, not {job!r}")


class Lab:
    """A home that is open, here or at a server; `close` it, or use it in a `with` statement.

    Parameters
    ----------
    source
        What it asks.
    """

    def __init__(self, source: Source) -> None:
        self._open = source
        self.close = weakref.finalize(self, source.close)

    @property
    def _source(self) -> Source:
        if not self.close.alive:
            raise InvalidInput(f"the {self._open.name} was closed in this program: open it again")
        return self._open

    def __repr__(self) -> str:
        return f"<sms_jobs {self._open.name}>"

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
        _check_question(query, columns, limit)
        pages = list(self._source.find(query, columns, limit))
        return FoundFiles(pages[0].columns, tuple(found for page in pages for found in page.rows))

    def states(
        self, query: str = "", *, columns: Sequence[str] | None = None, limit: int = 100_000
    ) -> pandas.DataFrame:
        """Find load states in the language of docs/query.md, across campaigns.

        Parameters
        ----------
        columns
            What to tell of each state; campaign, state, load, time and what the query compares if it is None.
        limit
            At most so many states.

        Returns
        -------
        A row for each state. What results of views tell has a column for each view, such as
        `strain.valid_fraction C1P2`; `met_by` has the views that meet a question about views. Where there
        are more states, `attrs["next"]` is the number of the last; else it is None.

        Raises
        ------
        InvalidInput
            The query cannot be understood.
        NotFound
            It names a campaign that is not there.
        ConfigurationError
            pandas is not installed.
        """
        frames = _frames()
        _check_question(query, columns, limit)
        pages = list(self._source.states(query, columns, limit))
        found = [one for page in pages for one in page.rows]
        titles, rows = table_of(pages[0].columns, pages[0].by_view, found)
        table: pandas.DataFrame = frames.DataFrame(list(rows), columns=titles)
        table.attrs["next"] = pages[-1].next
        return table

    def read(
        self,
        what_of: str | int,
        what: str | None = None,
        *,
        frame: Frame = "world",
    ) -> xarray.Dataset:
        """Read the newest record about a subject, or a record of a file, with units, sigma and provenance.

        Frames of measurements are left out: they are larger than memory.

        Parameters
        ----------
        what_of
            A subject as campaign/state/view, or the number of a file.
        what
            Name of a kind or of a record, such as strain, displacement or surface; None for the first record
            of a file.
        frame
            Along whose axes shape and displacement are: X, Y, Z of the world or x, y, z of the specimen.

        Returns
        -------
        One variable for each array of the record, as docs/python.md describes.

        Raises
        ------
        NotFound
            There is no such file, record or result.
        InvalidInput
            It is no subject, or a document, or it cannot be along the specimen's axes.
        ArchiveCorrupt
            The file is not as it was sealed.
        ConfigurationError
            xarray is not installed.
        """
        if frame not in get_args(Frame):
            raise InvalidInput(f"`frame` is 'world' or 'specimen', not {frame!r}")
        if isinstance(what_of, int) or what is None:
            stored = self._source.of_file(str(what_of), what)
        else:
            stored = self._source.newest(what_of, what)
        return dataset_of(stored if frame == "world" else self._along_specimen(stored))

    def _along_specimen(self, stored: StoredRecord) -> StoredRecord:
        """Return a record along the axes of the specimen of its campaign."""
        campaign = self._source.definition(stored.file.in_campaign().campaign)
        return replace(stored, record=in_specimen_frame(stored.record, campaign))

    def add_view(self, campaign: str, view: str) -> tuple[str, ...]:
        """Let a campaign be measured by one more view from now on, as `sms campaign add-view` does.

        Returns the states that were recorded without it: where there are any, it measures shape alone.

        Raises
        ------
        NotFound
            There is no such campaign, or no rig is connected that could tell of a camera alone.
        Conflict
            It has that view, and no further frames of it, or something of it is being recorded.
        InvalidInput
            It is a calibration session, or rig or calibration have no such sensor.
        """
        return self._source.add_view(campaign, view)

    def frame(self, campaign: str) -> FrameOf:
        """Return the specimen's frame of a campaign; raises `NotFound` where there is none of that name."""
        return self._source.frame(campaign)

    def find_frame(
        self,
        campaign: str,
        x: Place,
        *,
        origin: Place | None = None,
        plane: Place | None = None,
        fit: str = "",
        view: str | None = None,
        markers: bool = False,
    ) -> FrameOf:
        """Find the specimen's own frame, as `sms campaign frame` does, and keep it from now on.

        Parameters
        ----------
        x, origin, plane
            A point of the x axis, the origin and one of the xy plane: (column, row) in px of the reference
            image, or (X, Y, Z) of the world in mm. Without an origin it is the middle of the region.
        fit
            In place of a third point: a region whose plane is the xy plane, as "rectangle 100 100 900 700".
        view
            Whose image it is; the first that measures shape if it is None.
        markers
            Whether the pixels lie in round marks, whose middles are taken.

        Raises
        ------
        NotFound
            There is no such campaign, or the reference surface of the view has not been computed.
        InvalidInput
            The points or the region tell no frame, or it is a calibration session.
        """
        return self._source.find_frame(campaign, Choice(x, origin, plane, fit, view, markers))

    def drop_frame(self, campaign: str) -> FrameOf:
        """Take the specimen's frame away again; raises `NotFound` where the campaign has none."""
        return self._source.drop_frame(campaign)

    @property
    def recordings(self) -> RecordingPlans:
        """The plans of recordings, as `sms acquire plan` has them."""
        return RecordingPlans(self._source)

    def submit(
        self,
        kind: str,
        campaign: str,
        /,
        *,
        states: Sequence[str] | None = None,
        views: Sequence[str] | None = None,
        run: str | None = None,
        dry_run: bool = False,
        **parameters: Any,
    ) -> Submitted:
        """Submit jobs of a kind, or the "pipeline", for the tuples of a campaign, and say how long they take.

        States whose jobs lack something are left out; `refused` of the answer tells which and why.

        Parameters
        ----------
        states, views
            Only these; all if it is None.
        run
            Name of the run that the results belong to, if any.
        dry_run
            Submit nothing.
        parameters
            Of the kind by name, as gauge_length_mm=30; of the pipeline as **{"strain.gauge_length_mm": 30}.

        Raises
        ------
        NotFound
            There is no such campaign or kind, or something that it needs.
        InvalidInput
            A parameter, state or view is not one of them or has no effect on the kind, or the run
            cannot have that name.
        Conflict
            The run is kept as it is.
        """
        for name, one in {"kind": kind, "campaign": campaign}.items():
            if not isinstance(one, str):
                raise InvalidInput(f"the {name} is one name, not {one!r}: submit one after the other")
        for name, several in {"states": states, "views": views}.items():
            _check_list(name, several)
            if several is not None and not len(several):
                raise InvalidInput(f"`{name}` is empty, and nothing to submit; leave it out for all")
        work = Work(campaign, (kind,), parameters, tuple(states or ()), tuple(views or ()), run=run)
        return self._source.submit(work, dry_run)

    def compare_runs(self, before: str, after: str) -> pandas.DataFrame:
        """Compare two runs: by how much displacement, strain and gauges differ, after minus before.

        Returns
        -------
        A row for each quantity of each subject: over how many points, rms, median and largest difference in
        its `unit`, `sigma` as stated of the difference, and `beyond`, the part of the points that changed by
        more than twice that. `attrs["changes"]` has what was not the same when they were computed, `asked`
        where that was asked for.

        Raises
        ------
        NotFound
            There is no such run.
        InvalidInput
            They are one run, or have no result of the same kind and subject.
        ConfigurationError
            pandas is not installed.
        """
        frames = _frames()
        found = self._source.compare_runs(before, after)
        names = [field.name for field in fields(Difference)]
        table: pandas.DataFrame = frames.DataFrame(map(asdict, found.differences), columns=names)
        table.attrs["changes"] = [asdict(change) for change in found.changes]
        return table

    def wait(self, job: Submitted | str, timeout_s: float | None = None) -> Waited:
        """Wait for what was submitted, or for the job whose id begins so; a service has to run in the home.

        Returns how many ended in each state, and what they remark about their data.

        Raises
        ------
        JobFailed
            One did not succeed.
        WaitTimedOut
            They have not ended in time; they go on.
        NotFound
            There is no such job.
        """
        _check_job(job, (Submitted, str), "what `submit` has returned, or the beginning of a job's id")
        waited = self._source.wait(job, timeout_s)
        waited.require_success()
        return waited

    def explain(self, job: str) -> str:
        """Say why the job whose id begins so waits, ran, was reused, or is stale: a sentence a line.

        Raises `NotFound` where there is none.
        """
        _check_job(job, (str,), "the beginning of a job's id")
        return "\n".join(self._source.explain(job).sentences)
