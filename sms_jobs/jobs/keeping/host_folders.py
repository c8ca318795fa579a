"""Copies of what lies on a host and in no archive: the files of its rigs, and frames not yet archived.

Nothing is on record of these files. What a copy held when it was made is noted beside the copies, so that
whichever of the two changes by itself is found.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from sms_jobs.archive.sealing import copy_file, sha256_of, sync

NOTES = "copied.json"


@dataclass(frozen=True)
class Note:
    """What a file was when it was copied."""

    size_bytes: int
    changed_ns: int
    sha256: str


@dataclass(frozen=True)
class Copied:
    """What became of one file: `finding` says what is wrong with it, or is empty."""

    path: str
    copied: bool
    finding: str = ""


def copy_folders(
    sources: Mapping[str, Path], target: Path, read_again: Callable[[str], bool]
) -> Iterator[Copied]:
    """Bring the copies of some folders up to date; what is gone from them stays until `forget_gone`.

    Parameters
    ----------
    sources
        Folders by the name of their copy.
    target
        Where the copies go.
    read_again
        Whether a file that was copied before, and has not changed since, is read again on both sides.
    """
    notes = _read_notes(target)
    for name, source in sources.items():
        for file in sorted(source.rglob("*")):
            if not file.is_file() or file.is_symlink():
                continue
            path = f"{name}/{file.relative_to(source).as_posix()}"
            try:
                note, done = _bring(path, file, target / path, notes.get(path), read_again(path))
            except FileNotFoundError:
                continue  # its frames have been archived meanwhile
            notes[path] = note
            yield done
    _write_notes(target, notes)


def _bring(path: str, file: Path, copy: Path, previous: Note | None, again: bool) -> tuple[Note, Copied]:
    status, finding = file.stat(), ""
    unchanged = (status.st_size, status.st_mtime_ns) == (
        (previous.size_bytes, previous.changed_ns) if previous else None
    )
    if previous and unchanged and copy.is_file() and copy.stat().st_size == previous.size_bytes:
        if not again:
            return previous, Copied(path, False)
        whole = sha256_of(copy) == previous.sha256
        if sha256_of(file) != previous.sha256:
            kept = "good" if whole else "damaged too"
            return previous, Copied(path, False, f"{file} has changed by itself; its copy {copy} is {kept}")
        if whole:
            return previous, Copied(path, False)
        finding = f"the copy {copy} had changed by itself and is replaced"
    # Of what is being written just now, the copy has what was there.
    copy_file(file, copy)
    return Note(copy.stat().st_size, status.st_mtime_ns, sha256_of(copy)), Copied(path, True, finding)


def forget_gone(sources: Mapping[str, Path], target: Path) -> None:
    """Remove the copies of files that are no longer there: their frames are in the archive."""
    notes = _read_notes(target)
    for path in list(notes):
        name, _, inner = path.partition("/")
        if name in sources and not (sources[name] / inner).exists():
            (target / path).unlink(missing_ok=True)
            del notes[path]
    _write_notes(target, notes)


def restore_folders(source: Path, target: Path) -> Iterator[Copied]:
    """Copy what was kept of a host into a home, and compare it with what was noted."""
    for path, note in _read_notes(source).items():
        copy = source / path
        if not copy.is_file():
            yield Copied(path, False, f"{path} is not in {source}")
            continue
        copy_file(copy, target / path)
        good = sha256_of(target / path) == note.sha256
        yield Copied(
            path, True, "" if good else f"{copy} is not what was copied; look at it before it is used"
        )


def _read_notes(folder: Path) -> dict[str, Note]:
    file = folder / NOTES
    notes = json.loads(file.read_bytes()) if file.is_file() else {}
    return {path: Note(**note) for path, note in notes.items()}


def _write_notes(folder: Path, notes: Mapping[str, Note]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    growing = folder / f".{NOTES}.tmp"
    growing.write_text(
        json.dumps({path: asdict(note) for path, note in sorted(notes.items())}), encoding="utf-8"
    )
    sync(growing)
    growing.replace(folder / NOTES)
    sync(folder)
