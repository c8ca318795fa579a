"""What the archive needs of a place: bytes under names, whole or not at all.

A store knows nothing of what it keeps. Every promise that is made here is tried on every store by
`tests/conformance/stores.py`.
"""

from __future__ import annotations

import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path
from typing import TypeAlias

from sms_jobs.errors import InvalidInput

LocalFile: TypeAlias = Path
"""A file on a disk of this machine; where it lies means nothing, and holds for a `with` at most."""


@dataclass(frozen=True)
class Capabilities:
    """What only some stores can do.

    Attributes
    ----------
    hard_links
        Local files can be linked: what `local` gives, to elsewhere; a file from elsewhere, to what `create`
        gives. Bytes are then kept once.
    """

    hard_links: bool = False


@dataclass(frozen=True)
class Room:
    """How much room there is: left, and altogether, in bytes."""

    free_bytes: int
    whole_bytes: int


def require_name(name: str) -> str:
    """Return a name; raise `InvalidInput` for one that is empty, absolute or climbs."""
    if not name or "\0" in name or name.startswith("/") or ".." in name.split("/"):
        raise InvalidInput(f"'{name}' is not a path inside the archive")
    return name


class Store(ABC):
    """Files under names that are relative and have forward slashes.

    A name that is none, or that leads out of the store, is `InvalidInput` for every method. Any number of
    processes may use one store. What lies under a name is always whole, and never changes but by `replace`.
    """

    @property
    @abstractmethod
    def where(self) -> str:
        """The store, as messages name it."""

    @property
    @abstractmethod
    def capabilities(self) -> Capabilities:
        """What it can do that others cannot."""

    @abstractmethod
    def create(self, name: str, writer: str) -> AbstractContextManager[LocalFile]:
        """Give a file to write; when the block ends well, all of it is under the name, at once and for good.

        It is then on the disk and read-only. Of a block that fails nothing is left. A writer that is killed
        leaves a file of the name `layout.temporary_name` at most, which tells the writer.

        Raises
        ------
        Conflict
            There is a file of that name, which stays as it is.
        StorageFull, StorageUnusable
            It cannot be kept, and that is the fault of the place.
        """

    @abstractmethod
    def replace(self, name: str, file: LocalFile, check: Callable[[LocalFile], object]) -> None:
        """Put a copy of a file under a name, at once, in the place of what may be there.

        What `check` raises of the copy, and any `OSError`, leave what was there.
        """

    @abstractmethod
    def size(self, name: str) -> int | None:
        """Return the size of a file in bytes; None where there is none that can be read."""

    @abstractmethod
    def exists(self, name: str) -> bool:
        """Say whether a name is taken, be it by something that cannot be read."""

    @abstractmethod
    def open(self, name: str) -> BufferedIOBase:
        """Return a file for reading from any place in it; raise `FileNotFoundError` where there is none."""

    def local(self, name: str) -> AbstractContextManager[LocalFile]:
        """Give a path at which the bytes lie meanwhile; where there is no such file, there is none at it.

        For libraries that want a path. Nothing may be written to it. It is a copy, unless a store has better.
        """
        return _copied(self, name)

    @abstractmethod
    def names(self, folder: str = "") -> Iterator[str]:
        """Yield every name in a folder and below it, in no order; none in folders that begin with a dot."""

    @abstractmethod
    def move(self, name: str, to: str) -> None:
        """Give a file another name, at once; raise `Conflict` where that is taken."""

    @abstractmethod
    def delete(self, *names: str) -> None:
        """Remove files of one folder; what is not there need not be removed."""

    @abstractmethod
    def probe(self, folder: str = "") -> None:
        """Keep a file for a moment in a folder, or where it will be, to find out whether that can be done.

        Raises
        ------
        StorageFull, StorageUnusable
            It cannot.
        """

    @abstractmethod
    def require_usable(self, least_mb: float) -> None:
        """Ask without writing whether files can be kept, and so many MB of them; raises as `probe` does."""

    @abstractmethod
    def room(self) -> Room:
        """Return how much room there is."""

    @abstractmethod
    def location(self, name: str) -> str:
        """Return where a person finds a file."""


@contextmanager
def _copied(store: Store, name: str) -> Iterator[LocalFile]:
    with tempfile.TemporaryDirectory(prefix="sms-") as folder:
        file = Path(folder) / require_name(name).rpartition("/")[2]
        with suppress(FileNotFoundError), store.open(name) as stored, file.open("wb") as copy:
            shutil.copyfileobj(stored, copy)
            file.chmod(0o444)
        yield file
