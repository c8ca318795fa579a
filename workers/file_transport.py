"""Messages as files, each of them whole or not there.

Kombu's own transport over files writes a message where it is read from. One whose writer was interrupted,
found the disk full, or was merely slower than a reader, is empty then, and ends the worker that meets it.
Here a message comes into its place by a rename, and what cannot be read is dropped: it is only a doorbell,
which is rung again. The tables of who listens to whom come into their places in the same way, one after
the other; one that cannot be read is made again.
"""

from __future__ import annotations

import fcntl
import logging
from pathlib import Path
from queue import Empty
from time import monotonic
from typing import Any
from uuid import uuid4

from kombu.exceptions import ChannelError
from kombu.transport import TRANSPORT_ALIASES, filesystem
from kombu.utils.json import dumps, loads

SCHEME = "smsfiles"

logger = logging.getLogger(__name__)


class Channel(filesystem.Channel):
    """Reads and writes messages; its options are those of Kombu's channel over files."""

    def _put(self, queue: str, payload: Any, **_: Any) -> None:  # type: ignore[override]
        name = f"{round(1e3 * monotonic())}_{uuid4()}.{queue}.msg"
        _write_whole(Path(self.data_folder_out, name), payload)

    def _get(self, queue: str, timeout: float | None = None) -> Any:
        for name in sorted(path.name for path in Path(self.data_folder_in).iterdir()):
            if name.partition(".")[2] != f"{queue}.msg":
                continue
            path = Path(self.data_folder_in, name)
            try:
                text = path.read_bytes()
                path.unlink()  # whoever is first has it
            except FileNotFoundError:
                continue
            try:
                return loads(text.decode("utf-8"))
            except ValueError:
                logger.warning("message %s cannot be read and is dropped", name)
        raise Empty

    def get_table(self, exchange: str) -> list[Any]:
        """Return who listens to an exchange; nobody, where that cannot be read: they say it again."""
        try:
            bindings = loads(self._exchange_file(exchange).read_text(encoding="utf-8"))
            return [filesystem.exchange_queue_t(*one) for one in bindings]
        except FileNotFoundError:
            return []
        except (ValueError, TypeError):
            logger.warning("the table of exchange %s cannot be read and is made again", exchange)
            return []

    def _queue_bind(self, exchange: str, *binding: str | None) -> None:
        listener = filesystem.exchange_queue_t(*(part or "" for part in binding))
        table = self._exchange_file(exchange)
        self.control_folder.mkdir(exist_ok=True)
        with (self.control_folder / "lock").open("ab") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            bound = self.get_table(exchange)
            if listener not in bound:
                _write_whole(table, [listener, *bound])


def _write_whole(path: Path, content: Any) -> None:
    """Let a file come into its place by a rename; raise `ChannelError` and leave nothing where it cannot."""
    begun = path.with_name(f"{path.name}.begun")
    try:
        begun.write_text(dumps(content), encoding="utf-8")
        begun.replace(path)
    except OSError as error:
        begun.unlink(missing_ok=True)
        raise ChannelError(f"{path} cannot be written ({error.strerror})") from error


class Transport(filesystem.Transport):
    """Kombu's transport over files with that channel."""

    Channel = Channel


TRANSPORT_ALIASES[SCHEME] = f"{__name__}:Transport"
