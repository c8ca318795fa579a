"""PostgreSQL and Redis servers of a test's own, which it may kill."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import time
from pathlib import Path

import psycopg
import redis

_PATIENCE_S = 30.0


def free_port() -> int:
    """Return a port on which nobody listens."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def postgresql_programs() -> Path | None:
    """Return the folder of `initdb` and `pg_ctl`; None when they are not installed."""
    if (found := shutil.which("pg_ctl")) is not None:
        return Path(found).resolve().parent
    places = ["/opt/homebrew/opt/postgresql*", "/usr/local/opt/postgresql*", "/usr/pgsql-*"]
    places.append("/usr/lib/postgresql/*")
    candidates = [p / "bin" for place in places for p in sorted(Path("/").glob(place[1:]))]
    return next((p for p in reversed(candidates) if (p / "pg_ctl").exists()), None)


class PostgresqlServer:
    """A server in a folder of its own, which is not root's: PostgreSQL refuses to run as root."""

    def __init__(self, folder: Path, programs: Path) -> None:
        self._folder = folder
        self._programs = programs
        self._as: list[str] = []
        folder.mkdir()
        if os.geteuid() == 0:
            self._as = ["runuser", "-u", "postgres", "--"]
            shutil.chown(folder, "postgres")
        self._port = free_port()
        self.url = f"postgresql+psycopg://sms@127.0.0.1:{self._port}/postgres"
        self._run("initdb", "--username=sms", "--auth=trust", "--encoding=UTF8", "--no-locale", "--no-sync")
        self.start()

    def start(self) -> None:
        """Start it, and wait until it answers."""
        options = (
            f"-c listen_addresses=127.0.0.1 -c port={self._port} -c unix_socket_directories={self._folder}"
        )
        log = self._folder / "server.log"
        self._run("pg_ctl", "start", "--silent", "--wait", f"--log={log}", f"--options={options}")

    def crash(self) -> None:
        """End it as a power cut would."""
        self._run("pg_ctl", "stop", "--silent", "--wait", "--mode=immediate")

    def execute(self, statement: str) -> list[tuple[object, ...]]:
        """Run a statement as its owner, in a transaction of its own."""
        with psycopg.connect(host="127.0.0.1", port=self._port, user="sms", dbname="postgres") as connection:
            done = connection.execute(statement)
            return done.fetchall() if done.description else []

    def _run(self, program: str, *arguments: str) -> None:
        # Not into a pipe: the server would keep it open.
        with (self._folder.parent / f"{program}.log").open("ab") as log:
            subprocess.run(
                [*self._as, str(self._programs / program), f"--pgdata={self._folder / 'data'}", *arguments],
                check=True,
                cwd=self._folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )


class RedisServer:
    """A server in a folder of its own that keeps every message."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir()
        self._port = free_port()
        self.url = f"redis://127.0.0.1:{self._port}/0"
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    def start(self, *, empty: bool = False) -> None:
        """Start it, with what it had or without; wait until it answers."""
        data = self._folder / "data"
        if empty:
            shutil.rmtree(data)
        data.mkdir(exist_ok=True)
        command = ["redis-server", "--port", str(self._port), "--bind", "127.0.0.1", "--dir", str(data)]
        command += ["--save", "", "--appendonly", "yes", "--maxmemory-policy", "noeviction"]
        with (self._folder / "server.log").open("ab") as log:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        deadline = time.monotonic() + _PATIENCE_S
        with redis.Redis.from_url(self.url) as client:
            while True:
                try:
                    client.ping()
                except redis.exceptions.ConnectionError:
                    if time.monotonic() > deadline:
                        raise
                    time.sleep(0.05)
                else:
                    return

    def kill(self) -> None:
        """End it at once."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
