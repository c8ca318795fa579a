"""Results in the files of other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Literal

from sms_jobs.app import writing
from sms_jobs.app.rules import use_case
from sms_jobs.app.specimens import campaigns
from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.catalogue.campaigns import campaign_row, definition
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.formats.importers.folders import natural
from sms_jobs.records.people import Right
from sms_jobs.records.quantity import quantities
from sms_jobs.records.shown.files import FileView
from sms_jobs.records.subject import alike_but_for_case

if TYPE_CHECKING:
    from sms_jobs.archive.dataset import ArchivedDataset
    from sms_jobs.formats.exporters import Exporter

_MOST_FILES = 10_000
_PLAIN_HDF5 = "hdf5"
_ABOUT_PLAIN_HDF5 = "HDF5 with gzip alone, the whole file, for readers without plugins"

_NO_DATASET = "file {number} is a {media_type} document and is copied unchanged; leave the format out"


@dataclass(frozen=True)
class Format:
    """A format of results: its name, the ending of its files, and what it holds."""

    name: str
    suffix: str
    summary: str


def formats() -> list[Format]:
    """Return the formats that results are written in, by name."""
    from sms_jobs.formats.exporters import all_exporters

    found = [Format(e.name, e.suffix, e.summary) for e in all_exporters().values()]
    return sorted([*found, Format(_PLAIN_HDF5, ".h5", _ABOUT_PLAIN_HDF5)], key=lambda f: f.name)


@use_case(Right.READ)
def list_formats(services: Services) -> list[Format]:
    """Return the formats that results are written in, by name."""
    return formats()


@use_case(Right.READ)
def formats_of(services: Services, file: str) -> list[Format]:
    """Return the formats that something of a file can be written in, by name.

    Raises `NotFound` where there is no such file, and `InvalidInput` where it is a document.
    """
    from sms_jobs.formats.exporters import all_exporters

    with services.catalogue.reading() as session:
        view = search.file_view(session, file)
    if view.media_type != DATASET_MEDIA_TYPE:
        raise InvalidInput(_NO_DATASET.format(number=view.id, media_type=view.media_type))
    with services.archive.open(view) as dataset:
        fitting = {e.name for e in all_exporters().values() if _fitting(dataset, e)}
    return [one for one in formats() if one.name == _PLAIN_HDF5 or one.name in fitting]


@dataclass(frozen=True)
class Chosen:
    """Which files: one by its number or path, or the newest of a kind of each subject of a campaign."""

    file: str | None = None
    kind: str | None = None
    campaign: str | None = None
    state: str | None = None
    view: str | None = None


@dataclass(frozen=True)
class ExportOptions:
    """What is to be written, and how.

    Attributes
    ----------
    form
        Name of a format; by the ending of the file that is named if it is None. Where no file is named, or
        one that ends as the sealed file does, that is copied.
    record
        The mesh of the file, or all that the format can hold if it is None.
    fields
        Only these values; empty for all.
    force
        Whether files that are there are replaced.
    frame
        Along whose axes shape and displacement are written.
    """

    form: str | None = None
    record: str | None = None
    fields: tuple[str, ...] = ()
    force: bool = False
    frame: Literal["world", "specimen"] = "world"


@use_case(Right.READ)
def export(services: Services, chosen: Chosen, out: Path | None, options: ExportOptions) -> list[Path]:
    """Write results for other programs, or copy sealed files out of the archive; return what was written.

    Parameters
    ----------
    out
        File, or a folder for files with names of their own; None for the present one.

    Raises
    ------
    InvalidInput
        The choice, the format, the ending or the fields contradict each other or the file, or names of files
        differ only in case.
    NotFound
        There is no such file, campaign or result.
    Conflict
        A file is there already and is not to be replaced.
    ArchiveCorrupt
        A file is not as it was sealed.
    """
    views = _views(services, chosen, out)
    if len(views) > 1 and out is not None and not out.is_dir():
        raise InvalidInput(f"{len(views)} files are to be written and {out} is no folder; make it first")
    planned = [_planned(services, view, out, options, len(views) > 1) for view in views]
    alike = alike_but_for_case(str(target) for one in planned for target in one.targets)
    if alike is not None:
        raise InvalidInput(
            f"{alike[0]} and {alike[1]} differ only in case, and many disks take them for one file: export "
            "each `state` on its own, into folders of their own"
        )
    return [path for one in planned for path in _export(services, one, options)]


def _views(services: Services, chosen: Chosen, out: Path | None) -> list[FileView]:
    """Return the named file, or the newest of a kind of each subject; such as end like `out`, if any do."""
    file, kind, campaign = chosen.file, chosen.kind, chosen.campaign
    state, view = chosen.state, chosen.view
    if (file is None) == (kind is None):
        raise InvalidInput("name one file, as in 'sms data export 42', or give a `kind` and a `campaign`")
    with services.catalogue.reading() as session:
        if file is not None:
            if (campaign, state, view) != (None, None, None):
                raise InvalidInput(
                    "`campaign`, `state` and `view` go with a `kind`; leave them out when you name a file"
                )
            return [search.file_view(session, file)]
        if campaign is None:
            raise InvalidInput("a `kind` needs a `campaign`: add the campaign whose result is to be exported")
        if state is not None:
            definition(campaign_row(session, campaign)).state(state)
        found = search.find_files(
            session, source=kind, campaign=campaign, state=state, view=view, limit=_MOST_FILES
        )
    datasets = [one for one in found if one.media_type == DATASET_MEDIA_TYPE]
    ending = "" if out is None or out.is_dir() else out.suffix
    named = [one for one in found if ending and PurePosixPath(one.path).suffix == ending]
    newest: dict[str, list[FileView]] = {}
    for one in sorted(named or datasets or found, key=lambda one: one.id, reverse=True):
        alike = newest.setdefault(one.subject, [])
        # Of documents, all that the newest job made.
        if not alike or (one.media_type != DATASET_MEDIA_TYPE and alike[0].job_id == one.job_id):
            alike.append(one)
    if not newest:
        raise NotFound(
            f"campaign {campaign} has no such result of kind {kind}; 'sms data find -c {campaign}' shows all"
        )
    return [
        view
        for subject in sorted(newest, key=natural)
        for view in sorted(newest[subject], key=lambda v: natural(v.path))
    ]


@dataclass(frozen=True)
class _Planned:
    """What becomes of a file: in which format, of which of its records, and where each is written."""

    view: FileView
    form: str | None
    records: tuple[str, ...]
    targets: tuple[Path, ...]


def _planned(
    services: Services, view: FileView, out: Path | None, options: ExportOptions, several: bool
) -> _Planned:
    """Say what becomes of a file, alone or not; refuse what cannot be before anything is written."""
    from sms_jobs.formats.exporters import all_exporters

    form = _form(view, out, options)
    records: tuple[str, ...] = ("",)
    if form is None or form == _PLAIN_HDF5:
        if options.fields or options.record or options.frame != "world":
            raise InvalidInput(
                "`fields`, `record` and `frame` need a format: 'sms data formats' lists them"
                if form is None
                else "hdf5 takes the whole file; leave out `fields`, `record` and `frame`"
            )
        names = [f"{_stem(view)}.h5" if form else _sealed_name(view, several)]
    else:
        exporter = all_exporters()[form]
        with services.archive.open(view) as dataset:
            records = (options.record,) if options.record else tuple(_records(dataset, exporter))
        if len(records) > 1 and out is not None and not out.is_dir():
            raise InvalidInput(
                f"file {view.id} has the records {', '.join(records)}: choose one as `record`, or give a "
                "folder"
            )
        stems = [f"{_stem(view)}-{name}" for name in records] if len(records) > 1 else [_stem(view)]
        names = [stem + exporter.suffix for stem in stems]
    return _Planned(view, form, records, tuple(_target(out, name, options.force) for name in names))


def _export(services: Services, planned: _Planned, options: ExportOptions) -> tuple[Path, ...]:
    from sms_jobs.archive.repacking import repack
    from sms_jobs.formats.exporters import all_exporters
    from sms_jobs.formats.exporters.sources import source_for

    view = planned.view
    if planned.form is None or planned.form == _PLAIN_HDF5:
        services.archive.verify_bytes(view)
        with writing.new_file(planned.targets[0], options.force) as part:
            if planned.form is None:
                services.archive.copy_out(view.path, part)
            else:  # as it is, but with the filters that every HDF5 library has
                with services.archive.local(view.path) as sealed:
                    repack(sealed, part, view.path)
        return planned.targets
    exporter = all_exporters()[planned.form]
    with services.archive.open(view) as dataset:
        for name, target in zip(planned.records, planned.targets, strict=True):
            record: Any = dataset.read(name, dataset.record_class(name))
            if options.frame == "specimen":
                record = _turned(services, view, record)
            source = source_for(exporter, record, options.fields, _texture(dataset, record))
            with writing.new_file(target, options.force) as part:
                exporter.write(source, part)
    return planned.targets


def _sealed_name(view: FileView, several: bool) -> str:
    """Return the name of a sealed file; beside others it says what it is about, as its folders do."""
    name = PurePosixPath(view.path).name
    return f"{view.about.in_filename}-{name}" if several and view.about is not None else name


def _stem(view: FileView) -> str:
    """Return how a file begins that holds something of another: with what that is about, and its source."""
    return view.source if view.about is None else f"{view.about.in_filename}-{view.source}"


def _turned(services: Services, view: FileView, record: Any) -> Any:
    """Return a record along the axes of the specimen of its campaign."""
    from sms_jobs.app.specimens.specimen_axes import in_specimen_frame

    return in_specimen_frame(record, campaigns.definition(services, view.in_campaign().campaign))


def _form(view: FileView, out: Path | None, options: ExportOptions) -> str | None:
    """Return the name of the format that is written; None where the sealed file itself is copied.

    A file that is named has to end as files of the format do, and says which where none was asked for.
    """
    suffixes = {one.name: one.suffix for one in formats()}
    listed = ", ".join(f"{name} (*{suffix})" for name, suffix in suffixes.items())
    form, dataset = options.form, view.media_type == DATASET_MEDIA_TYPE
    if form is not None and form not in suffixes:
        raise InvalidInput(f"there is no export format '{form}'; choose one of {', '.join(suffixes)}")
    if form is not None and not dataset:
        raise InvalidInput(_NO_DATASET.format(number=view.id, media_type=view.media_type))
    if out is None or out.is_dir():
        return form
    if form is not None:
        # Of tecplot-block too the last ending is enough: programs go by that.
        ending = f".{suffixes[form].rpartition('.')[2]}"
        if out.suffix != ending:
            raise InvalidInput(f"'{out}' must end in {ending} to be a file of {form}; there are {listed}")
        return form
    sealed = PurePosixPath(view.path).suffix
    if out.suffix == sealed:
        return None
    if not dataset:
        raise InvalidInput(
            f"'{out}' must end in {sealed}: file {view.id} is a {view.media_type} document and is copied as "
            "it is"
        )
    fitting = [name for name, suffix in suffixes.items() if out.name.endswith(suffix)]
    if not fitting:
        raise InvalidInput(
            f"'{out}' ends as no format does, and is no folder that is there; end it as one of {listed}"
        )
    return max(fitting, key=lambda name: len(suffixes[name]))


def _records(dataset: ArchivedDataset, exporter: Exporter) -> list[str]:
    """Return which records of a file are written; where the format can hold none, the first tells why."""
    return _fitting(dataset, exporter) or [dataset.names[0]]


def _fitting(dataset: ArchivedDataset, exporter: Exporter) -> list[str]:
    """Return which records of a file a format can hold: its mesh, or all."""
    from sms_jobs.records.fields import Mesh

    fields_by_record = {name: quantities(dataset.record_class(name)) for name in dataset.names}
    meshes = [name for name in dataset.names if dataset.record_class(name) is Mesh]
    any_record = object in exporter.takes
    if meshes and (any_record or Mesh in exporter.takes):
        return meshes
    return [
        name for name, fields in fields_by_record.items() if (fields if any_record else "position" in fields)
    ]


def _texture(dataset: ArchivedDataset, record: Any) -> Any:
    """Return the mean brightness beside a cloud, 1 at its largest; None where the file has none."""
    import numpy as np

    from sms_jobs.kinds.products import PHASE
    from sms_jobs.records.fields import Mesh

    if not PHASE.is_in(dataset) or isinstance(record, Mesh) or not hasattr(record, "position"):
        return None
    mean = PHASE.read(dataset).mean_intensity
    return None if mean.shape != record.position.shape[1:] else mean / max(float(np.nanmax(mean)), 1e-9)


def _target(out: Path | None, name: str, force: bool) -> Path:
    """Return the file to write; refuse one that is there and a folder that is not."""
    path = Path(name) if out is None else out / name if out.is_dir() else out
    writing.check_new_file(path, force)
    return path
