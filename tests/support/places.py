"""Folders whose file system can be made read-only, and a way to PostgreSQL that can be cut."""

from __future__ import annotations

import os
import selectors
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


class SmallDisk:
    """A file system of its own, at a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def remount(self, how: str) -> bool:
        """Make it `ro` or `rw`; False when somebody writes to it just now."""
        command = ["mount", "-o", f"remount,{how}", str(self.folder)]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0


@contextmanager
def mounted(folder: Path, size: str = "60m") -> Iterator[SmallDisk]:
    """Mount a small file system at a new folder meanwhile; skip where that is not allowed."""
    folder.mkdir(parents=True)
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("only root may mount a file system")
    try:
        yield SmallDisk(folder)
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


class Wire:
    """A port that leads to a PostgreSQL server, and can be cut at a commit: before it arrives, or its answer.

    Attributes
    ----------
    port
        On loopback.
    cuts
        How often it was cut.
    """

    def __init__(self, server_port: int) -> None:
        self._server_port = server_port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self.cuts = 0
        self._cut_at: int | None = None
        self._arrives = False
        self._commits = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self, at: int, *, arrives: bool) -> None:
        """Cut the wire once, at the commit of that number from now, counted from 1."""
        self._commits, self._cut_at, self._arrives = 0, at, arrives

    def close(self) -> None:
        """Let nobody in any more."""
        self._listener.close()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._relay, args=(client,), daemon=True).start()

    def _relay(self, client: socket.socket) -> None:
        with (
            client,
            socket.create_connection(("127.0.0.1", self._server_port)) as server,
            selectors.DefaultSelector() as ready,
        ):
            ready.register(client, selectors.EVENT_READ, server)
            ready.register(server, selectors.EVENT_READ, client)
            while True:
                for key, _ in ready.select():
                    source, target = key.fileobj, key.data
                    assert isinstance(source, socket.socket)
                    try:
                        data = source.recv(1 << 16)
                        cut = source is client and b"COMMIT" in data and self._is_cut()
                        if not cut or self._arrives:
                            target.sendall(data)
                        if cut and self._arrives:
                            server.recv(1 << 16)  # it is done, and nobody hears of it
                    except OSError:
                        return
                    if not data or cut:
                        return

    def _is_cut(self) -> bool:
        self._commits += 1
        if self._commits != self._cut_at:
            return False
        self._cut_at = None
        self.cuts += 1
        return True
