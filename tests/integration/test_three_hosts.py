"""Three hosts by the documented commands, upgraded one after the other while they work, and lose nothing.

They are network namespaces with bare virtual environments, homes and names of their own, and reach PostgreSQL
and Redis, as `ops/compose.yaml` has them, by TLS. The archive is a folder that all of them see.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
from support.command import wait_until
from support.compose import ComposeServers, compose_servers
from support.namespaces import Computer, network

from sms_jobs import __version__
from sms_jobs.archive import Archive, FolderStore

ROOT = Path(__file__).resolve().parents[2]
NEXT = "0.1.1"
STATES = 500
"""Each is rendered and reconstructed: 1,000 jobs."""
PLAN = """
name = "plate"
rig = "virtual"

[specimen]
name = "plate"
material = "aluminium"

[sequence]
densities = [8, 7, 6]
steps = 3

{states}

[scene]
seed = 7

[scene.volume]
low_mm = [-170.0, -140.0, -60.0]
high_mm = [170.0, 140.0, 60.0]

[scene.surface]
shape = "plane"
width_mm = 300.0
height_mm = 240.0

[scene.speckle]
diameter_mm = 12.0

[[scene.sensors]]
name = "C1"
columns = 96
rows = 80
fx = 280.0
fy = 280.0
cx = 47.5
cy = 39.5
position_mm = [-350.0, 60.0, 1000.0]
target_mm = [0.0, 0.0, 0.0]

[[scene.sensors]]
name = "P1"
columns = 128
rows = 96
fx = 320.0
fy = 320.0
cx = 63.5
cy = 47.5
position_mm = [0.0, -40.0, 1000.0]
target_mm = [0.0, 0.0, 0.0]
"""
STATE = """
[[states]]
label = "S{n:03}"
load_n = {n}
deformation = [{{ motion = "rigid", translation_mm = [0.001, 0.0, {z}] }}]
"""


class Host:
    """A host as `docs/operations.md` sets it up: checkout, environment, home and file of variables."""

    def __init__(self, computer: Computer, folder: Path) -> None:
        self.computer = computer
        self.checkout = folder / "opt"
        self.home = folder / "srv"
        self.variables = folder / "sms.env"
        self._process: subprocess.Popen[bytes] | None = None
        folder.mkdir()

    @property
    def environment(self) -> dict[str, str]:
        """What an account of its own has, and nothing else."""
        kept = {name: os.environ[name] for name in ("PATH", "LANG", "TMPDIR") if name in os.environ}
        return kept | {"HOME": str(self.home), "COLUMNS": "200", "SMS_WORKERS": "1"}

    def set_up(self, release: Path, servers: ComposeServers, archive: Path) -> None:
        """Install it and make its home."""
        subprocess.run(["git", "clone", "--quiet", str(release), str(self.checkout)], check=True)
        self._install()
        self.variables.write_text(
            f"SMS_DATABASE_URL={servers.database_url}\n"
            f"SMS_BROKER_URL={servers.broker_url}\n"
            f"SMS_ARCHIVE={archive}\n"
        )
        self.say("init", "--home", str(self.home), "--environment-file", str(self.variables))

    def upgrade(self) -> None:
        """End it in order, install what is new, and start it again."""
        self.end()
        subprocess.run(["git", "pull", "--quiet"], cwd=self.checkout, check=True)
        self._install()
        self.start()

    def start(self) -> None:
        with (self.home / "worker.log").open("ab") as log:
            self._process = subprocess.Popen(
                self._words("worker", "start"),
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )

    def end(self) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGTERM)
            self._process.wait(timeout=300)

    def has_worked(self) -> bool:
        """Tell whether it has begun a job; a command that asks the catalogue costs as much as many jobs."""
        return any(", attempt 1" in log.read_text() for log in (self.home / "logs").glob("worker-*.log"))

    def say(self, *arguments: str) -> str:
        """Return what a command of this host prints, which must succeed."""
        done = subprocess.run(
            self._words(*arguments),
            env=self.environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
        assert done.returncode == 0, f"{arguments} on {self.computer.name}: {done.stdout}{done.stderr}"
        return done.stdout

    def answer(self, *arguments: str) -> Any:
        return json.loads(self.say(*arguments, "--json").splitlines()[-1])

    def _words(self, *arguments: str) -> list[str]:
        return self.computer.words(str(self.checkout / ".venv" / "bin" / "sms"), *arguments)

    def _install(self) -> None:
        # Not in its namespace: where packages come from is no part of this.
        command = ["bash", "-c", ". ops/setup.sh; set_up requirements.lock"]
        subprocess.run(command, cwd=self.checkout, check=True)


def make_release(folder: Path) -> None:
    """Clone what is committed here; the next version is a commit that comes later."""
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("releases are made from a git checkout")
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(folder)], check=True)


def release_next(folder: Path) -> None:
    package = folder / "sms_jobs" / "__init__.py"
    package.write_text(package.read_text().replace(f'"{__version__}"', f'"{NEXT}"'))
    name = ["-c", "user.name=a test", "-c", "user.email=test@localhost"]
    subprocess.run(["git", *name, "commit", "--quiet", "--all", "-m", "Release"], cwd=folder, check=True)


@contextmanager
def hosts(folder: Path, release: Path) -> Iterator[tuple[Host, ...]]:
    """Set up three hosts; the servers stand on a fourth, in the middle."""
    with ExitStack() as stack:
        middle, *others = stack.enter_context(network("db", "one", "two", "three"))
        servers = stack.enter_context(compose_servers(middle.address, middle.words))
        made = []
        for computer in others:
            began = time.monotonic()
            host = Host(computer, folder / computer.name)
            stack.callback(host.end)
            host.set_up(release, servers, folder / "shared")
            made.append(host)
            print(f"{computer.name} is set up after {time.monotonic() - began:.0f} s")
        yield tuple(made)


def test_the_next_release_says_that_it_is_another(tmp_path: Path) -> None:
    make_release(tmp_path)
    release_next(tmp_path)
    command = [sys.executable, "-c", "import sms_jobs; print(sms_jobs.__file__, sms_jobs.__version__)"]
    said = subprocess.run(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True, check=True).stdout
    assert said.split() == [str(tmp_path / "sms_jobs" / "__init__.py"), NEXT]
    files = subprocess.run(
        ["git", "diff", "--name-only", "HEAD~"], cwd=tmp_path, stdout=subprocess.PIPE, text=True, check=True
    )
    assert files.stdout.split() == ["sms_jobs/__init__.py"]


@pytest.mark.long
def test_hosts_are_upgraded_under_load_one_after_the_other(tmp_path: Path) -> None:
    make_release(tmp_path / "release")
    with hosts(tmp_path, tmp_path / "release") as (one, two, three):
        plan = tmp_path / "plan.toml"
        states = "".join(STATE.format(n=n, z=0.001 * n) for n in range(STATES))
        plan.write_text(PLAN.format(states=states))
        one.say("campaign", "create", str(plan))
        jobs = one.answer("job", "submit", "simulate", "reconstruct", "-c", "plate")["jobs"]
        assert len(jobs) == 2 * STATES
        for host in (one, two, three):
            host.start()
        release_next(tmp_path / "release")

        def counted() -> dict[str, int]:
            found: dict[str, int] = two.answer("status")["jobs"]
            return found

        for host in (one, two, three):
            wait_until(host.has_worked, 600.0)
            before = counted()
            began = time.monotonic()
            host.upgrade()
            left = counted()
            print(f"{host.computer.name} upgraded in {time.monotonic() - began:.0f} s: {before} to {left}")
            assert left.get("queued", 0) + left.get("waiting", 0) > 0, "there was no load any more"
        # It waits for those that had not ended, and tells of them.
        assert set(one.answer("job", "wait", "-c", "plate", "--timeout", "3000")["jobs"]) == {"succeeded"}
        assert counted() == {"succeeded": len(jobs)}

        listed = one.answer("job", "list", "--limit", "2000")
        assert {job["attempts"] for job in listed} == {1}
        assert {job["reused_from"] for job in listed} == {None}
        files = one.answer("data", "find", "--limit", "5000")
        assert set(Counter((f["source"], f["subject"]) for f in files).values()) == {1}
        made_by_jobs = [f for f in files if f["source"] in ("measurement", "reconstruct")]
        assert Counter(f["source"] for f in made_by_jobs) == {"measurement": STATES, "reconstruct": STATES}
        archive = Archive(FolderStore(tmp_path / "shared"))
        by = Counter()
        for file in made_by_jobs:
            made = archive.provenance(file["path"])
            assert made is not None
            by[made.host, made.program_version] += 1
        print(dict(by))
        assert {host for host, _ in by} == {"one", "two", "three"}
        assert {version for _, version in by} == {__version__, NEXT}
        assert one.answer("archive", "verify", "--quick")["findings"] == []
        for host in (one, two, three):
            assert f"job {jobs[0]}: simulate plate/S000" in host.say("job", "logs", jobs[0])
            host.say("doctor")
