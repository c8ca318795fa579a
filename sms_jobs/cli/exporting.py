"""`sms data export` and `sms data formats`: results in the files of other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sms_jobs import bootstrap
from sms_jobs.archive import DATASET_MEDIA_TYPE
from sms_jobs.archive.repacking import repack
from sms_jobs.catalogue import search
from sms_jobs.cli import completion, output, writing
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.records.fields import Mesh, PhaseMaps
from sms_jobs.records.files import FileView
from sms_jobs.records.quantity import quantities

if TYPE_CHECKING:
    from sms_jobs.archive.dataset import ArchivedDataset
    from sms_jobs.formats.exporters import Exporter

_MOST_FILES = 10_000
_PLAIN_HDF5 = "hdf5"
_ABOUT_PLAIN_HDF5 = "HDF5 with gzip alone, the whole file, for readers without plugins"

_NO_DATASET = "file {number} is a {media_type} document and is copied as it is; leave out --as"

File = Annotated[
    str | None,
    typer.Argument(
        help="Number or archive path of a file; see 'sms data find'. Or choose by --kind.", show_default=False
    ),
]
Out = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="File to write, or a folder; here if not given.", show_default=False),
]


@dataclass(frozen=True)
class _Wanted:
    """What is to be written, and how."""

    form: str | None
    record: str | None
    fields: tuple[str, ...]
    force: bool


def formats(as_json: Json = False) -> None:
    """List the formats of 'sms data export --as' and of the job kind export.

    Example: sms data formats
    """
    from sms_jobs.formats.exporters import all_exporters

    rows = [(e.name, f"*{e.suffix}", e.summary) for e in all_exporters().values()]
    rows = sorted([*rows, (_PLAIN_HDF5, "*.h5", _ABOUT_PLAIN_HDF5)])
    if as_json:
        output.print_json_list({"format": n, "suffix": s[1:], "summary": t} for n, s, t in rows)
        return
    output.print_table(["format", "file", "what it holds"], rows, empty="")


def export(
    file: File = None,
    form: Annotated[
        str | None,
        typer.Option(
            "--as",
            help="Format to write, see 'sms data formats'; the suffix of --out decides if not given.",
            show_default=False,
        ),
    ] = None,
    out: Out = None,
    record: Annotated[
        str | None,
        typer.Option(help="Record in the file; its mesh, or all that the format can hold if not given."),
    ] = None,
    fields: Annotated[
        str | None,
        typer.Option(help="Only these values, with commas between; all if not given.", show_default=False),
    ] = None,
    kind: Annotated[
        str | None, typer.Option(help="Instead of a file: the newest result of this kind of each subject.")
    ] = None,
    campaign: Annotated[
        str | None,
        typer.Option(
            "--campaign", "-c", help="With --kind: of it.", autocompletion=completion.campaign_names
        ),
    ] = None,
    state: Annotated[str | None, typer.Option(help="With --kind: only of this state.")] = None,
    view: Annotated[str | None, typer.Option(help="With --kind: only of this view.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there.")] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Write a result for other programs, or copy a sealed file, e.g. a report, out of the archive.

    Without --as, and with no suffix of --out that names a format, the sealed file itself is copied.

    Example: sms data export 42 --as ply --fields "deviation,sigma of deviation" -o deviation.ply

    Example: sms data export --kind merge -c wing --as vtu -o for-paraview/
    """
    wanted = _Wanted(form, record, _split(fields), force)
    with bootstrap.services(home) as services:
        views = _views(services, file, kind, campaign, state, view)
        if len(views) > 1 and out is not None and not out.is_dir():
            raise InvalidInput(f"{len(views)} files are to be written and {out} is no folder; make it first")
        written = [path for view in views for path in _export(services, view, out, wanted)]
    if as_json:
        output.print_json({"files": written})
        return
    for path in written:
        output.say(f"wrote {path}")


def _split(fields: str | None) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in (fields or "").split(",")))
    if fields is not None and not all(names):
        raise InvalidInput(f"--fields '{fields}' has an empty name; write them like \"deviation,texture\"")
    return names if fields is not None else ()


def _views(
    services: bootstrap.Services,
    file: str | None,
    kind: str | None,
    campaign: str | None,
    state: str | None,
    view: str | None,
) -> list[FileView]:
    """Return the file that was named, or the newest of a kind of each subject."""
    if (file is None) == (kind is None):
        raise InvalidInput("name one file, as in 'sms data export 42', or choose by --kind and --campaign")
    with services.catalogue.reading() as session:
        if file is not None:
            if (campaign, state, view) != (None, None, None):
                raise InvalidInput("--campaign, --state and --view choose with --kind, not beside a file")
            return [search.file_view(session, file)]
        if campaign is None:
            raise InvalidInput("--kind needs --campaign: of which campaign is the result wanted?")
        found = search.find_files(
            session, source=kind, campaign=campaign, state=state, view=view, limit=_MOST_FILES
        )
    datasets = [one for one in found if one.media_type == DATASET_MEDIA_TYPE]
    newest: dict[str, list[FileView]] = {}
    for one in sorted(datasets or found, key=lambda one: one.id, reverse=True):
        alike = newest.setdefault(one.subject, [])
        # Of documents, all that the newest job made.
        if not alike or (not datasets and alike[0].job_id == one.job_id):
            alike.append(one)
    if not newest:
        raise NotFound(
            f"campaign {campaign} has no such result of kind {kind}; 'sms data find -c {campaign}' shows all"
        )
    return [view for subject in sorted(newest) for view in sorted(newest[subject], key=lambda v: v.path)]


def _export(services: bootstrap.Services, view: FileView, out: Path | None, wanted: _Wanted) -> list[Path]:
    from sms_jobs.formats.exporters.sources import source_for

    if wanted.form == _PLAIN_HDF5:
        return [_repacked(services, view, out, wanted)]
    exporter = _exporter(view, out, wanted)
    if exporter is None:
        target = _target(out, PurePosixPath(view.path).name, wanted.force)
        services.archive.verify_bytes(view)
        with writing.new_file(target, wanted.force) as part:
            services.archive.copy_out(view.path, part)
        return [target]
    written = []
    with services.archive.open(view) as dataset:
        names = [wanted.record] if wanted.record else _records(dataset, exporter)
        if len(names) > 1 and out is not None and not out.is_dir():
            raise InvalidInput(
                f"file {view.id} has the records {', '.join(names)}: choose one with --record, or give a "
                "folder"
            )
        for name in names:
            record: Any = dataset.read(name, dataset.record_class(name))
            source = source_for(exporter, record, wanted.fields, _texture(dataset, record))
            stem = "-".join(
                [view.subject.replace("/", "-"), view.source, *([name] if len(names) > 1 else ())]
            )
            target = _target(out, f"{stem}{exporter.suffix}", wanted.force)
            with writing.new_file(target, wanted.force) as part:
                exporter.write(source, part)
            written.append(target)
    return written


def _repacked(services: bootstrap.Services, view: FileView, out: Path | None, wanted: _Wanted) -> Path:
    """Write a dataset as it is, but with the filters that every HDF5 library has."""
    if wanted.fields or wanted.record:
        raise InvalidInput("hdf5 takes the whole file; leave out --fields and --record")
    if view.media_type != DATASET_MEDIA_TYPE:
        raise InvalidInput(_NO_DATASET.format(number=view.id, media_type=view.media_type))
    target = _target(out, f"{view.subject.replace('/', '-')}-{view.source}.h5", wanted.force)
    services.archive.verify_bytes(view)
    with writing.new_file(target, wanted.force) as part, services.archive.local(view.path) as sealed:
        repack(sealed, part, view.path)
    return target


def _exporter(view: FileView, out: Path | None, wanted: _Wanted) -> Exporter | None:
    """Return what writes the file; None where the sealed file itself is wanted."""
    from sms_jobs.formats.exporters import all_exporters

    form = wanted.form
    if form is None and out is not None and not out.is_dir() and view.media_type == DATASET_MEDIA_TYPE:
        fitting = [e for e in all_exporters().values() if out.name.endswith(e.suffix)]
        form = max(fitting, key=lambda e: len(e.suffix)).name if fitting else None
    if form is None:
        if wanted.fields or wanted.record:
            raise InvalidInput("--fields and --record need a format: add --as, see 'sms data formats'")
        return None
    if form not in all_exporters():
        known = ", ".join(sorted([*all_exporters(), _PLAIN_HDF5]))
        raise InvalidInput(f"there is no export format '{form}'; choose one of {known}")
    exporter = all_exporters()[form]
    if view.media_type != DATASET_MEDIA_TYPE:
        raise InvalidInput(_NO_DATASET.format(number=view.id, media_type=view.media_type))
    return exporter


def _records(dataset: ArchivedDataset, exporter: Exporter) -> list[str]:
    """Return which records of a file are written: its mesh, or all that the format can hold."""
    known = {name: quantities(dataset.record_class(name)) for name in dataset.names}
    meshes = [name for name in dataset.names if dataset.record_class(name) is Mesh]
    any_record = object in exporter.takes
    if meshes and (any_record or Mesh in exporter.takes):
        return meshes
    fitting = [name for name, fields in known.items() if (fields if any_record else "position" in fields)]
    # If none fits, the first tells why.
    return fitting or [dataset.names[0]]


def _texture(dataset: ArchivedDataset, record: Any) -> Any:
    """Return the mean brightness beside a cloud, 1 at its largest; None where the file has none."""
    import numpy as np

    if "phase" not in dataset.names or isinstance(record, Mesh) or not hasattr(record, "position"):
        return None
    mean = dataset.read("phase", PhaseMaps).mean_intensity
    return None if mean.shape != record.position.shape[1:] else mean / max(float(np.nanmax(mean)), 1e-9)


def _target(out: Path | None, name: str, force: bool) -> Path:
    """Return the file to write; refuse one that is there and a folder that is not."""
    path = Path(name) if out is None else out / name if out.is_dir() else out
    writing.check_new_file(path, force)
    return path
