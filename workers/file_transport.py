"""Messages as files, each of them whole or not there.

Kombu's own transport over files writes a message where it is read from. One whose writer was interrupted,
found the disk full, or was merely slower than a reader, is empty then, and ends the worker that meets it.
Here a message comes into its place by a rename, and what cannot be read is dropped: it is only a doorbell,
which is rung again. The same holds for the tables of who listens to whom, which are made again.
"""

from __future__ import annotations

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
        begun = Path(self.data_folder_out, f"{name}.begun")
        try:
            begun.write_text(dumps(payload), encoding="utf-8")
            begun.replace(Path(self.data_folder_out, name))
        except OSError as error:
            begun.unlink(missing_ok=True)
            raise ChannelError(f"a message for {queue} cannot be written ({error.strerror})") from error

    def _get(self, queue: str, timeout: float | None = None) -> Any:
        for name in sorted(path.name for path in Path(self.data_folder_in).iterdir()):
            if name.partition(".")[2] != f"{queue}.msg":
                continue
            taken = Path(self.data_folder_in, f"{name}.taken")
            try:
                Path(self.data_folder_in, name).rename(taken)  # whoever is first has it
            except FileNotFoundError:
                continue
            try:
                return loads(taken.read_text(encoding="utf-8"))
            except ValueError:
                logger.warning("message %s cannot be read and is dropped", name)
            finally:
                taken.unlink(missing_ok=True)
        raise Empty

    def get_table(self, exchange: str) -> list[Any]:
        """Return who listens to an exchange; nobody, while that is being written."""
        try:
            return list(super().get_table(exchange))
        except ValueError:
            return []

    def _queue_bind(self, exchange: str, *binding: Any) -> None:
        try:
            super()._queue_bind(exchange, *binding)
        except ValueError:
            logger.warning("the table of exchange %s cannot be read and is made again", exchange)
            self._exchange_file(exchange).unlink(missing_ok=True)
            super()._queue_bind(exchange, *binding)


class Transport(filesystem.Transport):
    """Kombu's transport over files with that channel."""

    Channel = Channel


TRANSPORT_ALIASES[SCHEME] = f"{__name__}:Transport"
