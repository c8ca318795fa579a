"""A store that forgets everything when it goes: for tests, and to see what a store is."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedIOBase, BufferedReader, BytesIO
from pathlib import Path
from threading import Lock

from typing_extensions import override

from sms_jobs.archive.layout import temporary_name
from sms_jobs.archive.sealing import blaming_the_place
from sms_jobs.archive.store import Capabilities, Room, Store, require_name
from sms_jobs.errors import Conflict


class MemoryStore(Store):
    """Files in a dictionary; what reads or writes them by path has copies."""

    def __init__(self) -> None:
        self._files: dict[str, bytes] = {}
        self._one_at_a_time = Lock()

    @property
    @override
    def where(self) -> str:
        return "memory"

    @property
    @override
    def capabilities(self) -> Capabilities:
        return Capabilities()

    @override
    @contextmanager
    def create(self, name: str, writer: str) -> Iterator[Path]:
        self._refuse_taken(name)
        with tempfile.TemporaryDirectory(prefix="sms-") as folder:
            file = Path(folder) / temporary_name(name.rsplit("/", 1)[-1], writer)
            with blaming_the_place(name, self.where):
                yield file
                content = file.read_bytes()
        with self._one_at_a_time:
            self._refuse_taken(name)
            self._files[name] = content

    @override
    def replace(self, name: str, file: Path, check: Callable[[Path], object]) -> None:
        require_name(name)
        check(file)
        self._files[name] = file.read_bytes()

    @override
    def size(self, name: str) -> int | None:
        return len(self._files[name]) if self.exists(name) else None

    @override
    def exists(self, name: str) -> bool:
        return require_name(name) in self._files

    @override
    def open(self, name: str) -> BufferedIOBase:
        if not self.exists(name):
            raise FileNotFoundError(f"there is no {name} in memory")
        return BufferedReader(BytesIO(self._files[name]))

    @override
    def names(self, folder: str = "") -> Iterator[str]:
        above = f"{require_name(folder)}/" if folder else ""
        for name in list(self._files):
            inner = name.removeprefix(above).split("/")[:-1]
            if name.startswith(above) and not any(part.startswith(".") for part in inner):
                yield name

    @override
    def move(self, name: str, to: str) -> None:
        with self._one_at_a_time:
            self._refuse_taken(to)
            if not self.exists(name):
                raise FileNotFoundError(f"there is no {name} in memory")
            self._files[to] = self._files.pop(name)

    @override
    def delete(self, *names: str) -> None:
        for name in names:
            self._files.pop(require_name(name), None)

    @override
    def probe(self, folder: str = "") -> None:
        """Find nothing wrong."""

    @override
    def require_usable(self, least_mb: float) -> None:
        """Find nothing wrong."""

    @override
    def room(self) -> Room:
        disk = shutil.disk_usage(tempfile.gettempdir())
        return Room(disk.free, disk.total)

    @override
    def location(self, name: str) -> str:
        return f"memory:{require_name(name)}"

    def _refuse_taken(self, name: str) -> None:
        if self.exists(name):
            raise Conflict(f"{name} is sealed already and is never overwritten")
