"""The servers of `ops/compose.yaml` without its containers: the same programs, arguments and certificates."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psycopg
import pytest
import redis

from support.command import wait_until
from support.missing import do_without
from support.servers import free_port, postgresql_programs

OPS = Path(__file__).resolve().parents[2] / "ops"
PASSWORD = "only-for-tests"


def service_lists(service: str) -> dict[str, list[str]]:
    """Return the items below each key of a service, whose lists are one item a line."""
    found: dict[str, list[str]] = {}
    within, key = False, ""
    for line in (OPS / "compose.yaml").read_text(encoding="utf-8").splitlines():
        assert "\t" not in line
        text = line.strip()
        if line.startswith("  ") and line[2] not in " #":
            within = text == f"{service}:"
        elif within and text.startswith("- "):
            found.setdefault(key, []).append(text[2:].strip("\"'"))
        elif within and text.endswith(":") and not text.startswith("#"):
            key = text[:-1]
    return found


@dataclass(frozen=True)
class ComposeServers:
    """The two servers, where they listen and what a client needs.

    Attributes
    ----------
    address, postgresql_port, redis_port
        Where they listen.
    authority
        Certificate of who signed theirs.
    """

    address: str
    postgresql_port: int
    redis_port: int
    authority: Path

    @property
    def database_url(self) -> str:
        """The catalogue's URL, as the documentation has it."""
        where = f"{self.address}:{self.postgresql_port}/sms"
        return f"postgresql+psycopg://sms:{PASSWORD}@{where}?sslmode=verify-full&sslrootcert={self.authority}"

    @property
    def broker_url(self) -> str:
        """The broker's URL, as the documentation has it."""
        return f"rediss://:{PASSWORD}@{self.address}:{self.redis_port}/0?ssl_ca_certs={self.authority}"


@contextmanager
def compose_servers(
    address: str = "127.0.0.1", there: Callable[..., list[str]] | None = None
) -> Iterator[ComposeServers]:
    """Run both servers, on a computer of a network if one is given; without the programs it skips."""
    programs = postgresql_programs()
    if programs is None or shutil.which("redis-server") is None:
        do_without("needs PostgreSQL and Redis: install them, or run ops/test.sh")
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    if os.geteuid() != 0:
        pytest.skip("keys are given to the accounts of the servers, which needs root")
    # Not among the folders of the tests, which are closed to the account of the server.
    folder = Path(tempfile.mkdtemp(prefix="sms-compose-"))
    place = _Place(folder, programs)
    servers = ComposeServers(address, free_port(), free_port(), folder / "authority.crt")
    started: list[subprocess.Popen[bytes]] = []
    try:
        place.prepare(address)
        for command in (place.postgresql(servers), place.redis(servers)):
            with (folder / "servers.log").open("ab") as log:
                words = command if there is None else there(*command)
                started.append(
                    subprocess.Popen(
                        words, stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=folder / "postgresql"
                    )
                )
        place.create_database(servers)
        yield servers
    finally:
        for process in started:
            process.terminate()
        for process in started:
            process.wait(timeout=60)
        shutil.rmtree(folder)


@dataclass(frozen=True)
class _Place:
    """Where the servers have their files."""

    folder: Path
    programs: Path

    def prepare(self, address: str) -> None:
        """Make what the head of the compose file makes."""
        secrets = self.folder
        subprocess.run(["bash", str(OPS / "certificates.sh"), str(secrets), address, "localhost"], check=True)
        self.folder.chmod(0o755)
        (secrets / "redis_conf").write_text(f"requirepass {PASSWORD}\n")
        (secrets / "postgresql_password").write_text(PASSWORD)
        (self.folder / "redis").mkdir()
        data = self.folder / "postgresql"
        data.mkdir()
        # A container has another number for the account of its server.
        for one in (data, secrets / "server.key"):
            shutil.chown(one, "postgres", "postgres")
        (secrets / "server.key").chmod(0o600)
        words = ["initdb", "--pgdata=data", "--username=sms", "--no-sync", "--data-checksums"]
        words += [
            "--auth-host=scram-sha-256",
            "--encoding=UTF8",
            f"--pwfile={secrets / 'postgresql_password'}",
        ]
        with (self.folder / "initdb.log").open("wb") as log:
            subprocess.run(
                ["runuser", "-u", "postgres", "--", str(self.programs / words[0]), *words[1:]],
                check=True, cwd=data, stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip

    def postgresql(self, servers: ComposeServers) -> list[str]:
        """Return the command of PostgreSQL; what the container has of itself is added."""
        words = self._here(service_lists("postgresql")["command"])
        assert words[0] == "postgres"
        more = [f"listen_addresses={servers.address}", f"port={servers.postgresql_port}"]
        more.append(f"unix_socket_directories={self.folder / 'postgresql'}")
        options = [word for option in more for word in ("-c", option)]
        program = [str(self.programs / "postgres"), "-D", str(self.folder / "postgresql" / "data")]
        return ["runuser", "-u", "postgres", "--", *program, *words[1:], *options]

    def redis(self, servers: ComposeServers) -> list[str]:
        """Return the command of Redis."""
        words = self._here(service_lists("redis")["command"])
        more = ["--tls-port", str(servers.redis_port), "--bind", servers.address]
        return [
            *words,
            *more,
            "--dir",
            str(self.folder / "redis"),
            "--unixsocket",
            str(self.folder / "r.sock"),
        ]

    def create_database(self, servers: ComposeServers) -> None:
        """Wait for both, and make the database, as the container does."""

        def connected() -> bool:
            try:
                with psycopg.connect(
                    host=str(self.folder / "postgresql"), port=servers.postgresql_port, user="sms",
                    password=PASSWORD, dbname="postgres", autocommit=True,
                ) as connection:  # fmt: skip
                    connection.execute("CREATE DATABASE sms")
                with redis.Redis(unix_socket_path=str(self.folder / "r.sock"), password=PASSWORD) as client:
                    client.ping()
            except (psycopg.OperationalError, redis.exceptions.ConnectionError):
                return False
            except psycopg.errors.DuplicateDatabase:
                return self._redis_answers()
            return True

        wait_until(connected, 60.0)

    def _redis_answers(self) -> bool:
        with redis.Redis(unix_socket_path=str(self.folder / "r.sock"), password=PASSWORD) as client:
            return bool(client.ping())

    def _here(self, words: Sequence[str]) -> list[str]:
        """Return words with the places of this machine for those of the container."""
        return [
            w.replace("/run/secrets", str(self.folder)).replace("/etc/postgresql", str(OPS)) for w in words
        ]
