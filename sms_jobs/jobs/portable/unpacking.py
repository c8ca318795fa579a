"""Reads a portable folder that somebody brought: checked against its checksums, then entered file by file.

Nothing in it is trusted: paths are confined, files are read within limits, and what does not pass the
judgement of reindexing is taken out of the archive again.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal, TypeAlias

from sqlalchemy import select

from sms_jobs.archive import Archive, Checker, FolderStore, Found, layout
from sms_jobs.catalogue.database import Catalogue
from sms_jobs.catalogue.tables.files import FileRow
from sms_jobs.errors import InvalidInput
from sms_jobs.formats import research_crate as crate
from sms_jobs.jobs.archiving.repository import Repository
from sms_jobs.jobs.portable.decisions import decisions, seal_missing
from sms_jobs.jobs.rebuilding import reindexing
from sms_jobs.jobs.rebuilding.reindexing import Reindexed
from sms_jobs.kinds.kind import CALIBRATION

Fault: TypeAlias = Literal["missing", "altered", "unlisted", "no-file"]

_LARGEST_MANIFEST_BYTES = 256 << 20


@dataclass(frozen=True)
class CheckedFile:
    """A file of a portable folder.

    Attributes
    ----------
    path
        Relative to the folder.
    size_bytes
        Of what was read.
    fault
        None when it is as the manifest says. missing: it is not there. altered: its checksum is another.
        unlisted: the manifest does not list it. no-file: it is a link, or something that cannot be read.
    """

    path: str
    size_bytes: int
    fault: Fault | None


def manifest_of(folder: Path) -> dict[str, str]:
    """Return the checksums of a portable folder, by path.

    Raises
    ------
    InvalidInput
        It is none, or its export was not finished.
    """
    file = folder / crate.MANIFEST
    if not (folder / crate.DECLARATION).is_file() or not file.is_file():
        raise InvalidInput(
            f"{folder} is no exported folder with a {crate.MANIFEST}; make one with "
            "'sms data pack', and let that come to its end"
        )
    return crate.read_manifest(_text(file))


def _tags_of(folder: Path) -> dict[str, str]:
    """Return the checksums of what describes a portable folder; a bag need not have them."""
    file = folder / crate.TAG_MANIFEST
    return crate.read_tag_manifest(_text(file)) if file.is_file() else {}


def _text(file: Path) -> str:
    if file.stat().st_size > _LARGEST_MANIFEST_BYTES:
        raise InvalidInput(f"{file} has more than {_LARGEST_MANIFEST_BYTES >> 20} MiB; export it in parts")
    try:
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise InvalidInput(f"{file} is not UTF-8 text; export it again") from error


def size_of(folder: Path, manifest: Mapping[str, str]) -> int:
    """Return how many bytes `check` will read."""
    return sum((folder / path).stat().st_size for path in manifest if (folder / path).is_file())


def check(folder: Path, manifest: Mapping[str, str]) -> Iterator[CheckedFile]:
    """Read every file of a portable folder and compare it with the manifest.

    What describes the folder, such as its `bag-info.txt`, is compared with the tag manifest, if it has one.
    """
    root = folder.resolve()
    for path, sha256 in sorted([*_tags_of(folder).items(), *manifest.items()]):
        file = folder / path
        if not os.path.lexists(file):
            yield CheckedFile(path, 0, "missing")
        elif file.is_symlink() or not file.is_file() or not file.resolve().is_relative_to(root):
            yield CheckedFile(path, 0, "no-file")
        else:
            with file.open("rb") as stream:
                found = hashlib.file_digest(stream, "sha256").hexdigest()
            yield CheckedFile(path, file.stat().st_size, None if found == sha256 else "altered")
    for inside, _, names in os.walk(folder / crate.PAYLOAD):
        for name in sorted(names):
            path = (Path(inside) / name).relative_to(folder).as_posix()
            if path not in manifest:
                yield CheckedFile(path, 0, "unlisted")


def enter(
    catalogue: Catalogue,
    archive: Archive,
    folder: Path,
    manifest: Mapping[str, str],
    now: datetime,
    *,
    dry_run: bool = False,
    link: bool = False,
    placed: Callable[[int], object] = lambda size: None,
    checker: Checker | None = None,
) -> Iterator[Reindexed]:
    """Bring the files of a checked folder into an archive and its catalogue; tell of each what became of it.

    What the catalogue knows is passed over, so that an import that was interrupted goes on. A file that is
    refused is taken out of the archive again. Decisions about calibrations count for the campaigns that come
    along and are new; others are passed over.

    Parameters
    ----------
    dry_run
        Say what would be done, and change nothing.
    link
        Let files be the folder's by hard links, on one file system.
    placed
        Called with the size of each file that has come into the archive.
    checker
        That reads the files; one of its own if not given.

    Raises
    ------
    InvalidInput
        Hard links are asked for and cannot be made.
    StorageFull
        The disk of the archive is full; repeated, it goes on.
    """
    brought = Archive(FolderStore(folder / crate.PAYLOAD))
    listed = {path.removeprefix(f"{crate.PAYLOAD}/") for path in manifest}
    with nullcontext(checker) if checker else Checker() as reader:
        decided = decisions(catalogue, brought, listed, reader)
        coming = {one.path for one in decided}

        def passed_over(path: str) -> bool:
            if path not in listed or (layout.is_decision(path) and path not in coming):
                return True
            return _known_calibration(catalogue, brought, path, reader)

        if dry_run:
            paths = [p for p in reindexing.unknown_files(catalogue, brought) if not passed_over(p)]
            yield from reindexing.reindex(catalogue, brought, paths, dry_run=True, checker=reader)
            return
        # Decisions first: they are not made any more once the campaigns are known.
        mine = {path for path in coming if path is not None and not archive.has(path)}
        for path in sorted(mine):
            archive.adopt(path, brought, link=link)
        names = {layout.campaign_of(path) for path in brought.files() if path in listed}
        new = seal_missing(catalogue, archive, decided, names, now)
        mine |= new
        for path in reindexing.unknown_files(catalogue, brought):
            if passed_over(path):
                continue
            if not archive.has(path):
                for part in _parts(path):
                    if part in listed:
                        archive.adopt(part, brought, link=link)
                mine.add(path)
            new.add(path)
            placed(brought.size(path) or 0)
        paths = [path for path in reindexing.unknown_files(catalogue, archive) if path in new]
        for one in reindexing.reindex(catalogue, archive, paths, checker=reader):
            if not one.entered and one.path in mine:
                Repository(catalogue, archive).withdraw(one.path)
            yield one


def _parts(path: str) -> tuple[str, ...]:
    """Return the files that one file of the archive is: a document has its provenance before it."""
    return (path,) if layout.is_dataset(path) else (layout.sidecar(path), path)


def _known_calibration(catalogue: Catalogue, brought: Archive, path: str, checker: Checker) -> bool:
    """Say whether the catalogue has the calibration of a file, from another file."""
    if layout.part(path, "kind") != CALIBRATION:
        return False
    found = reindexing.examined(brought, checker, path)
    if not isinstance(found, Found):
        return False
    same = select(FileRow.id).where(
        FileRow.source == CALIBRATION, FileRow.content_hash == found.sealed.content_hash
    )
    with catalogue.reading() as session:
        return session.scalar(same) is not None
