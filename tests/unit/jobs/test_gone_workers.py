"""A worker whose process is gone is not shown as alive until its beats are late."""

from __future__ import annotations

import os
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

from support.command import answer, inside
from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.jobs.running import recovery
from sms_jobs.jobs.running.origin import Origin


def test_a_killed_service_is_missed_at_once_on_its_own_machine(home: Path) -> None:
    initialised(home)
    at = ("--home", str(home))
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    with bootstrap.services(home) as services, services.catalogue.writing() as session:
        recovery.register_worker(
            session, "killed", "here", ended.pid, ["cpu"], 1, datetime.now(UTC), origin=Origin.own()
        )
    assert answer("worker", "list", *at) == []
    assert "none; start one with 'sms up'" in inside("status", *at).stdout
    assert "no worker is alive: 0 jobs wait for one" in inside("doctor", *at).stdout

    # Of processes elsewhere only the beats tell; of one that lives they are believed.
    with bootstrap.services(home) as services, services.catalogue.writing() as session:
        recovery.register_worker(session, "far", "there", ended.pid, ["cpu"], 1, datetime.now(UTC))
        recovery.register_worker(
            session, "alive", "here", os.getpid(), ["cpu"], 1, datetime.now(UTC), origin=Origin.own()
        )
    assert {one["id"] for one in answer("worker", "list", *at)} == {"far", "alive"}
    assert "far on there, alive on here" in inside("status", *at).stdout
