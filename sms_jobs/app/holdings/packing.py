"""What leaves the archive, and comes into another: packed campaigns, and where files come from."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sms_jobs.app import writing
from sms_jobs.app.progress import Step, Tell, nobody
from sms_jobs.app.rules import use_case
from sms_jobs.archive import Checker
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import search
from sms_jobs.errors import InvalidInput
from sms_jobs.formats.research_crate import CrateFile, as_text
from sms_jobs.jobs.portable import lineage_documents, packing, unpacking
from sms_jobs.jobs.portable.packing import PackOptions
from sms_jobs.jobs.portable.unpacking import CheckedFile
from sms_jobs.jobs.rebuilding.reindexing import Reindexing
from sms_jobs.kinds import kind_named
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT
from sms_jobs.records.people import Right
from sms_jobs.records.shown.files import CalibrationView
from sms_jobs.records.sizes import number_of


@dataclass(frozen=True)
class Packed:
    """How many files were packed, their size, and how many of them an earlier run had packed."""

    files: int
    size_bytes: int
    resumed: int


@use_case(Right.READ)
def pack(
    services: Services,
    campaign: str,
    to: Path,
    *,
    kinds: tuple[str, ...] = (),
    inputs: bool = True,
    without_plugins: bool = False,
    link: bool = False,
    tell: Tell = nobody,
) -> Packed:
    """Export a campaign with all that it depends on into a portable folder.

    Parameters
    ----------
    to
        Folder, empty or new, or one that an interrupted run has started.
    kinds
        Only results of these, and what they were computed from; empty for all.
    inputs
        Also what the files were computed from.
    without_plugins
        With gzip alone, for readers without HDF5 plugins.
    link
        Hard links in place of copies.
    tell
        Called with the bytes that are packed.

    Raises
    ------
    InvalidInput
        The options contradict each other, or the folder cannot be used.
    NotFound
        There is no such campaign or kind.
    """
    if link and without_plugins:
        raise InvalidInput(
            "`link` takes files unchanged, and `without_plugins` rewrites them; leave one of them out"
        )
    for name in kinds:
        if name not in (MEASUREMENT, CALIBRATION):
            kind_named(name)
    options = PackOptions(campaign, tuple(sorted(set(kinds))), inputs, without_plugins, link)
    now = datetime.now(UTC)
    with services.catalogue.reading() as session:
        parts = packing.chosen(session, options, now)
    writing.new_folder(to)
    done = packing.begin(to, options, parts)
    files: list[CrateFile] = []
    total, brought = sum(part.size_bytes for part in parts), 0
    with Checker() as checker:
        for part in parts:
            before = packing.brought_before(part, done)
            files += before or packing.bring(services.archive, to, options, part, checker)
            brought += part.size_bytes
            tell(Step("packing", brought, total))
    packing.finish(services.catalogue, services.archive, to, options, files, now)
    return Packed(len(parts), sum(one.size_bytes for one in files), len(done))


@dataclass(frozen=True)
class CheckedFolder:
    """How many files a packed folder lists, the size of those that are there, and what is wrong."""

    files: int
    size_bytes: int
    faults: tuple[CheckedFile, ...]


def check(folder: Path, tell: Tell = nobody) -> CheckedFolder:
    """Read every file of a packed folder and compare it with its checksum; needs no home.

    Raises `InvalidInput` for a folder that nobody packed.
    """
    manifest = unpacking.manifest_of(folder)
    total, size = unpacking.size_of(folder, manifest), 0
    faults = []
    for one in unpacking.check(folder, manifest):
        size += one.size_bytes if one.path in manifest else 0
        tell(Step("checking", size, total))
        if one.fault is not None:
            faults.append(one)
    return CheckedFolder(len(manifest), size, tuple(faults))


@dataclass(frozen=True)
class Unpacked(Reindexing):
    """What became of the files of a packed folder that were new, and the calibrations among them."""

    calibrations: tuple[CalibrationView, ...]


@use_case(Right.COMPUTE)
def unpack(
    services: Services,
    folder: Path,
    checked: CheckedFolder,
    *,
    dry_run: bool = False,
    link: bool = False,
    tell: Tell = nobody,
) -> Unpacked:
    """Bring the files of a packed folder that was checked into this archive and its catalogue.

    Each is judged as reindexing does; what is refused is taken out again, and what is there is passed over.
    Raises `InvalidInput` where the folder had faults.
    """
    if checked.faults:
        raise InvalidInput(f"not as packed: {number_of(len(checked.faults), 'file')} of {folder}")
    placed = 0

    def tell_placed(count: int) -> None:
        nonlocal placed
        placed += count
        tell(Step("unpacking", placed, checked.size_bytes))

    done = tuple(
        unpacking.enter(
            services.catalogue,
            services.archive,
            folder,
            unpacking.manifest_of(folder),
            datetime.now(UTC),
            dry_run=dry_run,
            link=link,
            placed=tell_placed,
        )
    )
    with services.catalogue.reading() as session:
        brought = search.calibrations_of_files(session, [one.path for one in done])
    return Unpacked(done, tuple(brought))


@dataclass(frozen=True)
class Provenance:
    """Where files come from, as a W3C PROV document."""

    document: dict[str, Any]

    @property
    def text(self) -> str:
        """Return it as PROV-JSON."""
        return as_text(self.document)


@use_case(Right.READ)
def provenance(services: Services, what: str) -> Provenance:
    """Return where a file, or all files of a campaign, come from, back to what was measured.

    Raises `NotFound` where there is neither a file nor a campaign of that name.
    """
    with services.catalogue.reading() as session:
        paths = lineage_documents.paths_of(session, what)
    return Provenance(lineage_documents.document_of(services.catalogue, services.archive, paths))
