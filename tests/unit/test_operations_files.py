"""Units, compose file and runbook: as far as they can be tried without the machines that they are for."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.compose import service_lists
from support.documents import complaint

ROOT = Path(__file__).resolve().parents[2]
OPS = ROOT / "ops"
UNITS = sorted(p for p in (OPS / "systemd").iterdir())
TEXTS = [ROOT / "README.md", OPS / "runbook.md", ROOT / "docs" / "operations.md"]


def test_every_script_that_is_named_exists() -> None:
    for file in TEXTS:
        for name in re.findall(r"\bops/[\w./@-]*\w", file.read_text(encoding="utf-8")):
            assert (ROOT / name).exists(), f"{file.name} names {name}"


@pytest.mark.parametrize("script", ["backup.sh", "certificates.sh", "restore.sh"])
def test_a_script_says_how_it_is_used(script: str) -> None:
    done = subprocess.run(["bash", str(OPS / script)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"usage: bash ops/{script}")
    assert subprocess.run(["bash", "-n", str(OPS / script)], check=False).returncode == 0


def test_the_servers_are_for_this_machine_unless_told_and_lose_nothing() -> None:
    postgresql, cache = service_lists("postgresql"), service_lists("redis")
    assert postgresql["ports"] == ["${SMS_ADDRESS:-127.0.0.1}:5432:5432"]
    assert cache["ports"] == ["${SMS_ADDRESS:-127.0.0.1}:6379:6379"]
    arguments = " ".join(cache["command"])
    assert "--appendonly yes" in arguments
    assert "--maxmemory-policy noeviction" in arguments
    assert "--port 0 --tls-port 6379" in arguments  # tests/integration/test_compose_servers.py tries the rest
    for server in (postgresql, cache):
        assert len(server["volumes"]) == 1
    text = (OPS / "compose.yaml").read_text(encoding="utf-8")
    assert "POSTGRES_PASSWORD_FILE: /run/secrets/postgresql_password" in text
    assert not re.search(r"POSTGRES_PASSWORD:|--requirepass|network_mode|trust", text)
    assert "secrets/" in (ROOT / ".gitignore").read_text(encoding="utf-8")


def test_the_compose_file_is_understood_by_docker() -> None:
    docker = shutil.which("docker")
    if docker is None or subprocess.run([docker, "compose", "version"], capture_output=True).returncode:
        pytest.skip("docker compose is not installed")
    done = subprocess.run(
        [docker, "compose", "-f", str(OPS / "compose.yaml"), "config", "--quiet"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def settings(unit: Path) -> dict[str, list[str]]:
    """Return what a unit sets; a key may come several times."""
    found: dict[str, list[str]] = {}
    for line in unit.read_text(encoding="utf-8").splitlines():
        if line and line[0] not in "#[":
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


@pytest.mark.parametrize("unit", [u for u in UNITS if u.suffix == ".service"], ids=lambda p: p.name)
def test_a_unit_takes_no_more_than_it_needs(unit: Path) -> None:
    found = settings(unit)
    assert found["User"] == ["sms"]
    assert found["NoNewPrivileges"] == ["yes"]
    assert found["ProtectSystem"] == ["strict"]
    assert found["CapabilityBoundingSet"] == [""]
    # Numba writes machine code while it runs.
    assert "MemoryDenyWriteExecute" not in found
    assert not any("URL=" in value for value in found["Environment"])
    (start,) = found["ExecStart"]
    program, *words = (word for word in start.split() if word != "$OPTIONS")
    if program.endswith("/sms"):
        assert complaint(shlex.join(words)) == ""
        assert words[:1] in (["up"], ["metrics"]) or words[:2] in (
            ["worker", "start"],
            ["rig", "serve"],
            ["serve"],
        )
    # Without it a home whose database is elsewhere would be taken for one with a database of its own.
    assert "/etc/sms/sms.env" in found["EnvironmentFile"]
    if {"up", "start", "serve"} & set(words):
        # Rigs: serial ports, and the socket of a display, which PrivateTmp alone would hide.
        assert {"dialout", "video"} <= set(found["SupplementaryGroups"][0].split())
        assert found["BindReadOnlyPaths"] == ["-/tmp/.X11-unix"]
    if {"up", "start"} & set(words):
        # Jobs may take 10 minutes to finish; systemd must not kill them before the supervisor would.
        assert (found["KillMode"], found["TimeoutStopSec"]) == (["mixed"], ["11min"])
        assert found["Restart"] == ["always"]


def test_the_options_that_the_console_is_documented_with_are_some_of_the_command() -> None:
    unit = OPS / "systemd" / "sms-web.service"
    given = re.findall(r"^# OPTIONS=(.*)$", unit.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(given) == 2
    for options in given:
        assert complaint(f"serve {options}") == ""
    found = settings(unit)
    # Without options it answers on this machine alone, and a service that dies comes back.
    assert "OPTIONS=" in found["Environment"]
    assert found["Restart"] == ["always"]


def test_a_worker_serves_the_rigs_of_its_host() -> None:
    found = settings(OPS / "systemd" / "sms-worker@.service")
    assert "QUEUES=cpu,io,acquisition,rigs" in found["Environment"]


def test_systemd_understands_the_units(tmp_path: Path) -> None:
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("systemd is not installed")
    for unit in UNITS:
        text = unit.read_text(encoding="utf-8")
        # It looks whether the programs are there.
        text = text.replace("/opt/sms/.venv/bin/sms", sys.executable).replace("/opt/sms", str(ROOT))
        name = unit.name.replace("@.", "@left.")
        (tmp_path / name).write_text(text, encoding="utf-8")
    done = subprocess.run(
        [analyze, "verify", "--man=no", *map(str, sorted(tmp_path.iterdir()))],
        capture_output=True,
        text=True,
        check=False,
    )
    ours = [line for line in done.stderr.splitlines() if "sms" in line]
    assert ours == []
