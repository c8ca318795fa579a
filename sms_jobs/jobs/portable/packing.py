"""Makes a portable folder of a campaign's files and all that they were computed from.

The folder is a BagIt bag with an RO-Crate in it: `sms data unpack`, or `sms archive reindex` on its `data`,
read it in another home. A file is in it under its name only when it is whole and was read again; what an
interrupted export has done is kept in a journal, and the next one goes on from there.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

import sms_jobs
from sms_jobs.archive import Archive, Checker, layout
from sms_jobs.archive.folder import inside
from sms_jobs.archive.place import says_full, says_too_large
from sms_jobs.archive.repacking import repack
from sms_jobs.archive.sealing import make_folders, sha256_of, sync
from sms_jobs.catalogue import campaigns
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.calibrations import AcceptanceRow, CalibrationRow
from sms_jobs.catalogue.tables.campaigns import CampaignRow
from sms_jobs.catalogue.tables.files import FileRow, ProvenanceRow
from sms_jobs.catalogue.valid_calibrations import ValidCalibrations
from sms_jobs.errors import ArchiveCorrupt, Conflict, InvalidInput, StorageFull
from sms_jobs.formats import research_crate as crate
from sms_jobs.formats.research_crate import CrateFile
from sms_jobs.jobs.archiving.indexing import CAMPAIGN
from sms_jobs.jobs.portable import lineage_documents
from sms_jobs.kinds.kind import CALIBRATION
from sms_jobs.records.subject import Subject

_BEGUN = ".export.json"
_JOURNAL = ".journal"
_AT_ONCE = 500
_READ_ONLY = 0o444
_SPARE_BYTES = 64 << 20


@dataclass(frozen=True)
class PackOptions:
    """What is exported, and how.

    Attributes
    ----------
    campaign
        Its name.
    kinds
        Only results of these and what they were computed from; everything when empty.
    inputs
        Whether what the chosen files were computed from comes along.
    without_plugins
        Write datasets anew so that every HDF5 library reads them; their content hashes stay.
    link
        Let files be the archive's own by hard links, on one file system.
    """

    campaign: str
    kinds: tuple[str, ...] = ()
    inputs: bool = True
    without_plugins: bool = False
    link: bool = False


@dataclass(frozen=True)
class Part:
    """A file of the archive that is exported."""

    path: str
    content_hash: str
    size_bytes: int
    media_type: str
    description: str
    created_at: datetime


def chosen(session: Session, options: PackOptions, now: datetime) -> list[Part]:
    """Return the files of an export, in the order in which the catalogue learnt of them.

    With the chosen files come the definitions of all campaigns that they belong to, the calibrations that
    are valid at the campaign's states, and, with `options.inputs`, all that the files were computed from.

    Raises
    ------
    NotFound
        There is no such campaign.
    InvalidInput
        It has no file of these kinds.
    """
    campaign = campaigns.campaign_row(session, options.campaign)
    query = select(FileRow.id).where(FileRow.campaign_id == campaign.id)
    if options.kinds:
        query = query.where(FileRow.source.in_(options.kinds))
    numbers = set(session.scalars(query))
    if not numbers:
        raise InvalidInput(
            f"campaign {options.campaign} has no file of kind {', '.join(options.kinds)}; see 'sms data find'"
        )
    if options.inputs:
        valid = ValidCalibrations(session, campaign.id, now)
        held = (valid.of(subject) for subject in _tuples(campaign))
        numbers |= {used.file_id for used in held if used is not None}
        numbers |= _inputs(session, numbers)
    rows = [row for some in _split(sorted(numbers)) for row in _rows(session, FileRow.id.in_(some))]
    owners = sorted({row.campaign_id for row in rows if row.campaign_id is not None})
    for some in _split(owners):
        rows += _rows(session, (FileRow.source == CAMPAIGN) & FileRow.campaign_id.in_(some))
    brought = [row.id for row in rows if row.source == CALIBRATION]
    rows += _acceptances(session, brought, owners)
    unique = {row.id: row for row in rows}
    return [_part(unique[number]) for number in sorted(unique)]


def _tuples(campaign: CampaignRow) -> list[Subject]:
    definition = campaigns.definition(campaign)
    return [
        Subject(definition.name, state.label, view)
        for state in definition.states
        for view in dict.fromkeys((*definition.views, *definition.recordings))
    ]


def _acceptances(session: Session, calibrations: Sequence[int], owners: Sequence[int]) -> list[FileRow]:
    """Return what says that calibrations among some files are used, for their rig or for these campaigns."""
    names = [session.get_one(CampaignRow, number).name for number in owners]
    query = (
        select(FileRow)
        .join(AcceptanceRow, AcceptanceRow.file_id == FileRow.id)
        .join(CalibrationRow, CalibrationRow.id == AcceptanceRow.calibration_id)
        .where(AcceptanceRow.in_use, CalibrationRow.file_id.in_(calibrations))
        .where(AcceptanceRow.campaign.in_(["", *names]))
    )
    return list(session.scalars(query))


def _split(numbers: Sequence[int]) -> Iterator[Sequence[int]]:
    for start in range(0, len(numbers), _AT_ONCE):
        yield numbers[start : start + _AT_ONCE]


def _rows(session: Session, condition: Any) -> list[FileRow]:
    return list(session.scalars(select(FileRow).where(condition)))


def _inputs(session: Session, numbers: Collection[int]) -> set[int]:
    """Return all that files were computed from, back to what was measured."""
    found: set[int] = set()
    level = set(numbers)
    while level:
        given: set[int] = set()
        for some in _split(sorted(level)):
            query = select(ProvenanceRow.input_id).where(ProvenanceRow.output_id.in_(some))
            given.update(session.scalars(query))
        level = given - found - set(numbers)
        found |= level
    return found


def _part(row: FileRow) -> Part:
    return Part(
        row.path,
        row.content_hash,
        row.size_bytes,
        row.media_type,
        f"{row.source} of {layout.folder_of(row.path)}",
        row.created_at,
    )


def begin(folder: Path, options: PackOptions, parts: Sequence[Part]) -> dict[str, CrateFile]:
    """Prepare a folder; return the files that an interrupted export has brought into it, by path.

    Raises
    ------
    Conflict
        There is something else in the folder, or an export of other files.
    StorageFull
        Its disk has too little room.
    """
    export = json.loads(json.dumps(asdict(options) | {"program": sms_jobs.__version__}))
    begun = folder / _BEGUN
    done: dict[str, CrateFile] = {}
    if begun.is_file():
        if json.loads(begun.read_bytes()) != export:
            raise Conflict(
                f"{folder} has an unfinished export with other options; repeat it with those, or give "
                "another folder"
            )
        done = _journal(folder)
    elif folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise Conflict(f"{folder} is not an empty folder; give one that is, or a name that does not exist")
    else:
        folder.mkdir(parents=True, exist_ok=True)
        begun.write_text(json.dumps(export), encoding="utf-8")
    coming = sum(part.size_bytes for part in parts if part.path not in done)
    # Without plugins it may be more; then the disk says so.
    free = shutil.disk_usage(folder).free
    if not options.link and free < coming + _SPARE_BYTES:
        raise StorageFull(
            f"{folder} has {free / 1e6:.0f} MB free and {coming / 1e6:.0f} MB are to come; free some space, "
            "or choose fewer kinds"
        )
    return done


def _journal(folder: Path) -> dict[str, CrateFile]:
    done: dict[str, CrateFile] = {}
    journal = folder / _JOURNAL
    for line in journal.read_text(encoding="utf-8").splitlines() if journal.is_file() else ():
        # The last line may be torn.
        with suppress(ValueError, KeyError, TypeError):
            entry = json.loads(line)
            made_at = None if entry["made_at"] is None else datetime.fromisoformat(entry["made_at"])
            one = CrateFile(**(entry | {"made_at": made_at}))
            file = folder / crate.PAYLOAD / one.path
            if file.is_file() and file.stat().st_size == one.size_bytes:
                done[one.path] = one
    return done


def brought_before(part: Part, done: Mapping[str, CrateFile]) -> list[CrateFile]:
    """Return what an interrupted export has brought of a part; empty unless it is all there."""
    document = not layout.is_dataset(part.path)
    needed = (layout.sidecar(part.path), part.path) if document else (part.path,)
    return [done[path] for path in needed] if all(path in done for path in needed) else []


def bring(
    archive: Archive, folder: Path, options: PackOptions, part: Part, checker: Checker
) -> Iterator[CrateFile]:
    """Bring one file, and a document's provenance with it, into the folder; read and compare them there.

    Raises
    ------
    ArchiveCorrupt
        It is not what the catalogue has on record.
    StorageFull
        The disk is full; what was brought before stays.
    """
    root = (folder / crate.PAYLOAD).resolve()
    document = not layout.is_dataset(part.path)
    if document:
        archive.verify_provenance(part.path, part.content_hash)
    for relative in (layout.sidecar(part.path), part.path) if document else (part.path,):
        beside = relative != part.path
        target = inside(root, str(Path(relative).parent)) / Path(relative).name
        target.unlink(missing_ok=True)
        try:
            make_folders(folder.resolve(), target.parent)
            temporary = target.with_name(f".{target.name}.part")
            temporary.unlink(missing_ok=True)
            _copy(archive, relative, temporary, options)
            if not document:
                checker.check(temporary, relative, part.content_hash)
            sha256 = sha256_of(temporary)
            if document and not beside and sha256 != part.content_hash:
                raise ArchiveCorrupt(f"{relative} is not what was sealed; see 'sms archive verify'")
            temporary.replace(target)
            sync(target.parent)
        except OSError as error:
            if says_full(error):
                raise StorageFull(
                    f"the disk of {folder} is full; free some space and export again"
                ) from error
            if says_too_large(error):
                raise StorageFull(
                    f"the disk of {folder} takes no file as large as {relative}; export to another disk"
                ) from error
            raise
        one = CrateFile(
            relative,
            sha256,
            target.stat().st_size,
            "application/json" if beside else part.media_type,
            f"provenance of {Path(part.path).name}" if beside else part.description,
            part.created_at,
        )
        with (folder / _JOURNAL).open("a", encoding="utf-8") as journal:
            journal.write(json.dumps(asdict(one), default=datetime.isoformat) + "\n")
        yield one


def _copy(archive: Archive, relative: str, target: Path, options: PackOptions) -> None:
    if not archive.has(relative):
        raise ArchiveCorrupt(f"{relative} is missing from the archive; restore it from a backup")
    if options.without_plugins and layout.is_dataset(relative):
        with archive.local(relative) as source:
            repack(source, target, relative)
    else:
        archive.copy_out(relative, target, link=options.link)
        if options.link:
            return
        sync(target)
    target.chmod(_READ_ONLY)


def finish(
    catalogue: Catalogue,
    archive: Archive,
    folder: Path,
    options: PackOptions,
    files: Sequence[CrateFile],
    now: datetime,
) -> None:
    """Write what makes the folder whole: what the files are, where they come from, and their checksums."""
    payload = folder / crate.PAYLOAD
    results = [one.path for one in files if layout.is_result(one.path)]
    _remove_others(payload, {one.path for one in files})
    provenance = crate.as_text(lineage_documents.document_of(catalogue, archive, results))
    about = [
        *files,
        _written(payload, crate.PROVENANCE, provenance, "where all these files come from, as W3C PROV-JSON"),
    ]
    name = f"Campaign {options.campaign}"
    description = (
        f"Sealed files of campaign {options.campaign} and what they were computed from, from an archive of "
        "sms_jobs; 'sms data unpack' reads this folder"
    )
    described = crate.metadata(name, description, now, sms_jobs.__version__, about)
    about.append(_written(payload, crate.METADATA, crate.as_text(described), "RO-Crate metadata"))
    hashes = {f"{crate.PAYLOAD}/{one.path}": one.sha256 for one in about}
    tags = {
        crate.DECLARATION: crate.DECLARED,
        crate.INFORMATION: crate.information(description, now, [one.size_bytes for one in about]),
        crate.MANIFEST: crate.manifest(hashes),
    }
    for file, text in tags.items():
        _written(folder, file, text, "")
    _written(
        folder,
        crate.TAG_MANIFEST,
        crate.manifest({n: hashlib.sha256(t.encode()).hexdigest() for n, t in tags.items()}),
        "",
    )
    for left in (_JOURNAL, _BEGUN):
        (folder / left).unlink(missing_ok=True)
    sync(folder)


def _remove_others(payload: Path, kept: Collection[str]) -> None:
    """Remove what an interrupted export has left half written."""
    for root, _, names in os.walk(payload):
        for name in names:
            path = Path(root) / name
            if path.relative_to(payload).as_posix() not in kept:
                path.unlink()


def _written(folder: Path, name: str, text: str, description: str) -> CrateFile:
    file = folder / name
    data = text.encode()
    file.write_bytes(data)
    sync(file)
    sha256 = hashlib.sha256(data).hexdigest()
    return CrateFile(name, sha256, len(data), "application/json", description)
