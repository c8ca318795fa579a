"""The files of a folder, and what their names say."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.records.views import CAMERA_PATTERN, FRINGES_PATTERN, PROJECTOR_PATTERN

MOST_FILES = 200_000
DEEPEST = 8

_PLACEHOLDER = re.compile(r"\{([^{}]*)\}|(\*)")
_PARTS = {
    "state": r"[^/]+?",
    "view": FRINGES_PATTERN,
    "camera": CAMERA_PATTERN,
    "projector": PROJECTOR_PATTERN,
    "orientation": r"-?\d+(?:\.\d+)?|[A-Za-z]+",
    "density": r"\d{1,6}(?:\.\d+)?",
    "step": r"\d{1,6}(?:\.\d+)?",
    "number": r"\d{1,9}",
}
PLACEHOLDERS = tuple(_PARTS)


@dataclass(frozen=True)
class LeftOut:
    """A file that is not taken, and why."""

    name: str
    why: str


@dataclass(frozen=True)
class Listing:
    """The regular files below a folder, as relative paths in natural order, and what is left out."""

    folder: Path
    files: tuple[str, ...]
    left_out: tuple[LeftOut, ...]


def natural(name: str) -> tuple[tuple[int, int, str], ...]:
    """Return a key that sorts frame_2 before frame_10."""
    return tuple(
        (1, int(part), "") if part.isdecimal() else (0, 0, part) for part in re.split(r"(\d+)", name) if part
    )


def list_folder(folder: Path, only: str | None = None) -> Listing:
    """Return the files below a folder; links that leave it are left out, hidden files are not looked at.

    With `only`, a form such as `calseq*`, those alone whose relative path has it; * stands for anything.

    Raises
    ------
    NotFound
        There is no such folder.
    InvalidInput
        It is none, cannot be read, or holds more files or deeper folders than are taken at once.
    """
    try:
        if not folder.exists():
            raise NotFound(f"there is no folder {folder}")
    except OSError as error:  # its name is too long, or what is above it may not be looked into
        raise InvalidInput(f"the folder {folder} cannot be read: {error.strerror}") from error
    if not folder.is_dir():
        raise InvalidInput(f"{folder} is no folder: give the folder that the files are in")
    root = folder.resolve()
    files: list[str] = []
    left_out: list[LeftOut] = []
    for name, why in _entries(root, root, 0):
        if only is not None and not fnmatchcase(name, only):
            continue
        if why is None:
            files.append(name)
        else:
            left_out.append(LeftOut(name, why))
        if len(files) > MOST_FILES:
            raise InvalidInput(
                f"{folder} has more than {MOST_FILES} files: import its sub-folders one after the other"
            )
    if only is not None and not files:
        raise InvalidInput(f"no file of {folder} has a path of the form '{printable(only)}': correct `only`")
    return Listing(root, tuple(sorted(files, key=natural)), tuple(left_out))


def _entries(root: Path, folder: Path, depth: int) -> Iterator[tuple[str, str | None]]:
    """Yield every file below a folder as (relative name, why it is left out or None)."""
    if depth > DEEPEST:
        yield folder.relative_to(root).as_posix(), f"is more than {DEEPEST} folders deep"
        return
    try:
        with os.scandir(folder) as scan:
            entries = sorted(scan, key=lambda e: e.name)
    except OSError as error:
        raise InvalidInput(f"{folder} cannot be read: {error.strerror}") from error
    for entry in entries:
        if entry.name.startswith("."):
            continue
        path = Path(entry.path)
        name = path.relative_to(root).as_posix()
        if entry.is_symlink() and not _stays(root, path):
            yield printable(name), "is a link that leaves the folder, or leads nowhere"
        elif entry.is_dir():
            if entry.is_symlink():
                yield printable(name), "is a link to a folder"
            else:
                yield from _entries(root, path, depth + 1)
        elif not entry.is_file():
            yield printable(name), "is no regular file"
        elif not name.isprintable() or name != printable(name):
            yield printable(name), "has a name that cannot be printed"
        else:
            yield name, None


def _stays(root: Path, path: Path) -> bool:
    try:
        return path.resolve(strict=True).is_relative_to(root)
    except (OSError, RuntimeError):
        return False


def printable(name: str) -> str:
    """Return a file name with what cannot be printed or encoded escaped."""
    safe = name.encode("utf-8", "backslashreplace").decode()
    return "".join(c if c.isprintable() else f"\\x{ord(c):02x}" for c in safe)


@dataclass(frozen=True)
class NamePattern:
    """What the names of files say, as in `{state}/{view}/frame_{number}.bmp`."""

    text: str
    expression: re.Pattern[str]
    names: tuple[str, ...]

    @classmethod
    def parse(cls, text: str, cameras: Collection[str] = ()) -> NamePattern:
        """Read a pattern of placeholders and `*`; raise `InvalidInput` for one that cannot be.

        `cameras` is what the names call cameras, where that is not C1, C2, ...
        """
        if text.startswith(("/", "\\")) or ".." in text.split("/") or re.match(r"[A-Za-z]:", text):
            raise InvalidInput(
                f"the pattern '{printable(text)}' leaves the folder: write it relative to it, without .."
            )
        if len(text) > 300 or "\0" in text or not text:
            raise InvalidInput("a pattern of file names has 1 to 300 characters")
        names: list[str] = []
        parts, end = [], 0
        for found in _PLACEHOLDER.finditer(text):
            parts.append(re.escape(text[end : found.start()]))
            end = found.end()
            if found[2]:
                parts.append("[^/]*")
                continue
            name = found[1].partition(":")[0]
            if name not in _PARTS:
                raise InvalidInput(
                    f"the pattern '{printable(text)}' has {{{printable(name)}}}; known are "
                    + ", ".join(f"{{{one}}}" for one in PLACEHOLDERS)
                )
            if name in names:
                raise InvalidInput(f"the pattern '{printable(text)}' has {{{name}}} twice: write * for one")
            names.append(name)
            foreign = "|".join(map(re.escape, cameras)) if name == "camera" else ""
            parts.append(f"(?P<{name}>{foreign or _PARTS[name]})")
        parts.append(re.escape(text[end:]))
        rest = "".join(text[a:b] for a, b in _between(text))
        if "{" in rest or "}" in rest:
            raise InvalidInput(f"the pattern '{printable(text)}' has a brace without its other half")
        if text.count("*") > 3:
            raise InvalidInput(f"the pattern '{printable(text)}' has more than 3 stars")
        return cls(text, re.compile("".join(parts)), tuple(names))

    def match(self, name: str) -> dict[str, str] | None:
        """Return what a relative path says, by placeholder; None where it is of another form."""
        found = self.expression.fullmatch(name)
        return None if found is None else found.groupdict()


def _between(text: str) -> Iterator[tuple[int, int]]:
    """Yield where the text between placeholders is."""
    end = 0
    for found in _PLACEHOLDER.finditer(text):
        yield end, found.start()
        end = found.end()
    yield end, len(text)
