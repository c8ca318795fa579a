"""A store that is a folder: names are paths below it, and links are followed as long as they stay inside."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from io import BufferedIOBase
from pathlib import Path, PurePosixPath

from typing_extensions import override

from sms_jobs.archive.place import probe, require_usable
from sms_jobs.archive.sealing import copy_file, make_folders, sealing, sync
from sms_jobs.archive.store import Capabilities, Room, Store, require_name
from sms_jobs.errors import ConfigurationError, Conflict, InvalidInput


class FolderStore(Store):
    """Files in a folder.

    Attributes
    ----------
    root
        The folder.
    """

    def __init__(self, root: Path) -> None:
        """Use a folder, which is created if it is not there.

        Raises `ConfigurationError` where there can be no such folder.
        """
        try:
            root.mkdir(parents=True, exist_ok=True)
            self.root = root.resolve()
        except (OSError, RuntimeError, ValueError) as error:
            raise ConfigurationError(
                f"there can be no archive at {root} ({getattr(error, 'strerror', error)}); correct the "
                "setting 'archive'"
            ) from error

    def path(self, name: str) -> Path:
        """Return the file of a name, links followed; raise `InvalidInput` when it is outside the folder."""
        return inside(self.root, name)

    def _own(self, name: str) -> Path:
        """Return where a name lies: its folder with links followed, its own last part as it is."""
        path = self.root / require_name(name)
        return inside(self.root, str(PurePosixPath(name).parent)) / path.name

    @property
    @override
    def where(self) -> str:
        return str(self.root)

    @property
    @override
    def capabilities(self) -> Capabilities:
        return Capabilities(hard_links=True)

    @override
    def create(self, name: str, writer: str) -> AbstractContextManager[Path]:
        return sealing(self.root, self._own(name), writer)

    @override
    def replace(self, name: str, file: Path, check: Callable[[Path], object]) -> None:
        copy_file(file, self._own(name), check)

    @override
    def size(self, name: str) -> int | None:
        file = self.path(name)
        return file.stat().st_size if file.is_file() else None

    @override
    def exists(self, name: str) -> bool:
        return os.path.lexists(self.root / require_name(name))

    @override
    def open(self, name: str) -> BufferedIOBase:
        return self.path(name).open("rb")

    @override
    def local(self, name: str) -> AbstractContextManager[Path]:
        return nullcontext(self.path(name))

    @override
    def names(self, folder: str = "") -> Iterator[str]:
        for above, inner, names in os.walk(self.path(folder) if folder else self.root):
            inner[:] = [name for name in inner if not name.startswith(".")]
            relative = Path(above).relative_to(self.root).as_posix()
            for name in names:
                yield name if relative == "." else f"{relative}/{name}"

    @override
    def move(self, name: str, to: str) -> None:
        source, target = self._own(name), self._own(to)
        make_folders(self.root, target.parent)
        if os.path.lexists(target):
            raise Conflict(f"{target} is there already and is never overwritten")
        source.replace(target)
        sync(target.parent)
        sync(source.parent)

    @override
    def delete(self, *names: str) -> None:
        files = [file for file in map(self._own, names) if file.parent.is_dir()]
        for file in files:
            file.unlink(missing_ok=True)
        for folder in {file.parent for file in files}:
            sync(folder)

    @override
    def probe(self, folder: str = "") -> None:
        probe(self.root)
        if folder:
            path = self.root / folder
            probe(next(f for f in (path, *path.parents) if f == self.root or os.path.lexists(f)))

    @override
    def require_usable(self, least_mb: float) -> None:
        require_usable(self.root, least_mb)

    @override
    def room(self) -> Room:
        disk = shutil.disk_usage(self.root)
        return Room(disk.free, disk.total)

    @override
    def location(self, name: str) -> str:
        return str(self.path(name))


def inside(root: Path, relative: str) -> Path:
    """Return the file at `relative` below `root`, links followed.

    Raises
    ------
    InvalidInput
        When the path is absolute, climbs, or leaves the root through a link.
    """
    path = (root / require_name(relative)).resolve()
    if not path.is_relative_to(root):
        raise InvalidInput(f"'{relative}' leaves the archive {root} through a link; remove that link")
    return path
