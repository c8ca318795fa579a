"""The one way in which a file is written that a person names: whole, or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sms_jobs.archive.place import says_full, says_too_large
from sms_jobs.errors import Conflict, InvalidInput, StorageFull


def check_new_file(out: Path, force: bool, endings: tuple[str, ...] = ()) -> None:
    """Refuse, before any work, what cannot become a file.

    Raises
    ------
    InvalidInput
        It ends otherwise than in `endings`, is a folder or device, or its folder is not there.
    Conflict
        There is such a file, and nobody has said that it may be replaced.
    """
    if endings and out.suffix not in endings:
        raise InvalidInput(f"'{out}' must end in {' or '.join(endings)}")
    try:
        # A link that leads nowhere is there too: it would be replaced.
        there = os.path.lexists(out)
        if there and not out.is_file():
            raise InvalidInput(f"{out} is a folder or a device, not a file; give the name of a file")
        if not out.parent.is_dir():
            raise InvalidInput(f"the folder {out.parent} does not exist; make it first")
        _part_of(out).lstat()
    except FileNotFoundError:
        pass
    except OSError as error:
        raise _refused(out, error) from error
    except ValueError as error:
        raise InvalidInput(f"'{out}' cannot be the name of a file: {error}") from error
    if there and not force:
        raise Conflict(f"{out} already exists; give another name, or set `force` to replace it")


@contextmanager
def new_file(out: Path, force: bool, endings: tuple[str, ...] = ()) -> Iterator[Path]:
    """Give a file beside `out` to write to, which becomes `out` at the end; on an error nothing is left.

    It ends as `out` does, for writers that go by that. Raises as `check_new_file` does, and `StorageFull`.
    """
    check_new_file(out, force, endings)
    part = _part_of(out)
    try:
        yield part
        part.replace(out)
    except OSError as error:
        if says_full(error):
            raise StorageFull(f"the disk has no room for {out}; free some, or write elsewhere") from error
        if says_too_large(error):
            raise _refused(out, error) from error
        if error.filename is None or Path(os.fsdecode(error.filename)).name != part.name:
            raise
        raise _refused(out, error) from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def write_file(out: Path, content: bytes | str, force: bool, endings: tuple[str, ...] = ()) -> None:
    """Write a file as `new_file` does; text in UTF-8."""
    with new_file(out, force, endings) as part:
        part.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


def new_folder(out: Path) -> None:
    """Make a folder to write to, where it is not there; raise `InvalidInput` if it cannot be made."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInput(
            f"the folder {out} cannot be made: {error.strerror}; give the name of a folder"
        ) from error
    except ValueError as error:
        raise InvalidInput(f"'{out}' cannot be the name of a folder: {error}") from error


def _part_of(out: Path) -> Path:
    return out.with_name(f".{out.stem}.{os.getpid()}.part{out.suffix}")


def _refused(out: Path, error: OSError) -> InvalidInput:
    return InvalidInput(f"{out} cannot be written: {error.strerror}; write elsewhere")
