"""What tells a living process from one that is gone, without anybody's clock but one's own."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace

import psutil
import pytest
from support.command import wait_until

from sms_jobs.jobs.running.origin import Origin, is_gone
from sms_jobs.jobs.running.stillness import Stillness

HERE = Origin("machine", "boot", "pid:[1]", 7)
SLEEP = [sys.executable, "-c", "import time; print(flush=True); time.sleep(60)"]
linux = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere nothing tells where a process is")


def test_what_changes_is_not_still() -> None:
    stillness: Stillness[str] = Stillness(2.0)
    assert stillness.look({"a": 1, "b": 1}, 10.0) == {"a": 0.0, "b": 0.0}
    assert stillness.look({"a": 1, "b": 2}, 11.0) == {"a": 1.0, "b": 0.0}
    assert stillness.look({"a": 1, "b": 2}, 12.5) == {"a": 2.5, "b": 1.5}
    # What was not there for a while is new.
    assert stillness.look({"b": 2}, 13.0) == {"b": 2.0}
    assert stillness.look({"a": 1}, 13.5) == {"a": 0.0}


def test_only_time_in_which_somebody_looked_counts() -> None:
    stillness: Stillness[str] = Stillness(2.0)
    stillness.look({"a": 1}, 0.0)
    # Stopped, or nothing could be read for an hour: it may have changed as often as it would.
    assert stillness.look({"a": 1}, 3600.0) == {"a": 2.0}


@linux
def test_a_process_is_gone_when_it_has_ended_and_when_another_has_its_number() -> None:
    here = Origin.own()
    assert here.boot
    with subprocess.Popen(SLEEP, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        started = round(psutil.Process(process.pid).create_time() - psutil.boot_time())
        ticks = os.sysconf("SC_CLK_TCK")
        there = replace(here, started=_started(process.pid))
        # Both round, and to different sides.
        assert abs(there.started / ticks - started) <= 2.0
        assert not is_gone(process.pid, there, here)
        assert is_gone(process.pid, replace(there, started=there.started + 1), here)
        process.send_signal(signal.SIGSTOP)
        assert not is_gone(process.pid, there, here)
        process.kill()
        # Nobody has waited for it yet.
        wait_until(lambda: psutil.Process(process.pid).status() == psutil.STATUS_ZOMBIE)
        assert is_gone(process.pid, there, here)
    assert is_gone(process.pid, there, here)


def _started(pid: int) -> int:
    with open(f"/proc/{pid}/stat") as stat:  # noqa: PTH123
        return int(stat.read().rpartition(")")[2].split()[19])


@pytest.mark.parametrize(
    "there",
    [
        replace(HERE, machine="clone"),
        replace(HERE, boot="later"),
        replace(HERE, pid_namespace="pid:[2]"),
        replace(HERE, started=0),
        Origin(),
    ],
)
def test_of_processes_elsewhere_nothing_is_known(there: Origin) -> None:
    # No process has this number anywhere.
    assert not is_gone(2**22 + 1, there, HERE)
    assert not is_gone(2**22 + 1, Origin(), Origin())


@linux
def test_a_container_on_the_same_machine_is_elsewhere() -> None:
    unshare = ["unshare", "--pid", "--fork", "--mount-proc", "--uts"]
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        pytest.skip("only root may make a name space of processes")
    say = "from sms_jobs.jobs.running.origin import Origin; o = Origin.own(); print(o.boot, o.pid_namespace)"
    done = subprocess.run([*unshare, sys.executable, "-c", say], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"no name space can be made here: {done.stderr}")
    here = Origin.own()
    boot, namespace = done.stdout.split()
    assert boot == here.boot
    assert namespace != here.pid_namespace
