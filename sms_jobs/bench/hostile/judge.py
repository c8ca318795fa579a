"""What must never come of a command line, whatever is in it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from sms_jobs.bench.hostile.store import Books
from sms_jobs.bench.hostile.tries import Try
from sms_jobs.bench.hostile.values import SECRET

_CODES = frozenset({0, 2, 3, 4, 5, 6, 7, 124, 130})
_REFUSALS = frozenset({2, 3, 4, 7})
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f]")
_PASSED_OVER = ("logs", ".logs", "messages", "catalogue.sqlite", ".planning-")
"""Of the home; what commands may write although they were refused."""


@dataclass
class Watch:
    """What lay in the folder of a batch, and what its catalogue said, after the try before.

    Attributes
    ----------
    place
        Folder of the batch: home, things to read, and `out` to write to.
    books
        On the catalogue.
    """

    place: Path
    books: Books
    _state: object = None
    _files: dict[str, tuple[int, int]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._state, self._files = self.books.state(), _files(self.place)

    def changes(self) -> tuple[bool, list[str]]:
        """Say whether the catalogue has changed since it was last asked, and name the files that have."""
        state, files = self.books.state(), _files(self.place)
        other = sorted(
            name for name in files.keys() | self._files.keys() if files.get(name) != self._files.get(name)
        )
        changed = state != self._state
        self._state, self._files = state, files
        return changed, other

    def strangers(self) -> list[str]:
        """Return the files of the archive that the catalogue does not know."""
        root = self.place / "home" / "archive"
        found = {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}
        found = {name for name in found if not name.startswith(".logs/")}
        known = self.books.paths()
        return sorted(found - known - {f"{path}.provenance.json" for path in known})


def faults_of(one: Try, code: int | None, said: str, watch: Watch) -> Iterator[str]:
    """Yield, in words, what a try did that no command may do."""
    if code is None:
        yield "it does not end"
    elif code not in _CODES or (code == 130 and not one.endless and "interrupted" not in said):
        yield f"its exit code is {code}"
    interrupted = one.endless and "KeyboardInterrupt" in said and "Exception ignored in" in said
    if "internal error" in said or ("Traceback" in said and not interrupted):
        yield "it speaks of an internal error"
    if SECRET in said:
        yield "it tells a password"
    found = _CONTROL.search(said)
    if found is not None:
        yield f"it prints the control character {found[0]!r}"
    changed, files = watch.changes()
    if code in _REFUSALS or code is None or code == 1:
        if changed:
            yield "the catalogue is changed although it was refused"
        if files:
            yield f"files are changed although it was refused: {', '.join(files[:3])}"
    if any(name.startswith("home/archive/") for name in files):
        strangers = watch.strangers()
        if strangers:
            yield f"the catalogue does not know {', '.join(strangers[:3])}"


def _files(place: Path) -> dict[str, tuple[int, int]]:
    """Return size and time of change of every file that is judged."""
    found: dict[str, tuple[int, int]] = {}
    pending = [""]
    while pending:
        inside = pending.pop()
        with os.scandir(place / inside) as entries:
            for entry in entries:
                name = f"{inside}/{entry.name}".lstrip("/")
                if entry.name.startswith(_PASSED_OVER):
                    continue
                if entry.is_dir(follow_symlinks=False):
                    if not name.startswith("home/archive/"):
                        found[name] = (0, 0)
                    pending.append(name)
                else:
                    about = entry.stat(follow_symlinks=False)
                    found[name] = (about.st_size, about.st_mtime_ns)
    return found
