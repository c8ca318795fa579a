"""A scanner's server among a thousand strangers, and after its client was cut off or froze: two computers."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from support.command import SMS, sms, wait_until
from support.namespaces import Computer, network

from sms_jobs import bootstrap

pytestmark = pytest.mark.long

SCANNER = """
name = "scanner"
cameras = [{ name = "C1", driver = "simulated", columns = 128, rows = 128 }]
projectors = [{ name = "P1", driver = "simulated", columns = 256, rows = 192, settle_ms = 1.0 }]
"""
CLIENT = """
import sys, time
from pathlib import Path
from sms_jobs.instruments.clock import RealClock
from sms_jobs.instruments.scanners.keys import read_key
from sms_jobs.instruments.scanners.link import Address, ScannerLink
from sms_jobs.instruments.simulated.optics import Setting
from sms_jobs.virtual_rig.campaigns import small_plate
key, address = read_key(Path(sys.argv[2])), Address.parse(sys.argv[1])
setting = Setting(small_plate("plate")[1].scene, "S00", ())
began = time.monotonic()
link = ScannerLink(address, key, RealClock(), setting)
print(time.monotonic() - began, flush=True)
link.ask("show", projector="P1", number=-1)
print("lit", flush=True)
sys.stdin.read()
"""
STRANGERS = """
import resource, socket, sys
resource.setrlimit(resource.RLIMIT_NOFILE, (4096, 4096))
host, _, port = sys.argv[1].rpartition(":")
quiet = [socket.create_connection((host, int(port))) for _ in range(1000)]
print(len(quiet), flush=True)
sys.stdin.read()
"""


class Scanner:
    """A home with a scanner, lent by a computer."""

    def __init__(self, home: Path, computer: Computer, stack: ExitStack) -> None:
        bootstrap.initialise(home)
        (home / "scanner.toml").write_text(SCANNER)
        assert sms("rig", "add", str(home / "scanner.toml"), "--home", str(home)).returncode == 0
        self.address = f"{computer.address}:7411"
        self.key = home / "rigs" / "scanner.key"
        self._log = home / "serve.log"
        command = [*SMS, "rig", "serve", "scanner", "--listen", self.address, "--home", str(home)]
        with self._log.open("wb") as log:
            process = subprocess.Popen(computer.words(*command), stdin=subprocess.DEVNULL, stderr=log)
        stack.callback(process.wait)
        stack.callback(process.terminate)
        wait_until(lambda: "serving scanner" in self.said())

    def said(self) -> str:
        return self._log.read_text()

    def gone(self) -> int:
        """Return how many clients have been given up."""
        return len(re.findall(r"has gone \(no sign of life for 10 s\)", self.said()))


@contextmanager
def other(computer: Computer, program: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run a program on a computer meanwhile, until it has said its first word."""
    process = subprocess.Popen(
        computer.words(sys.executable, "-c", program, *arguments),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            assert pipe is not None
            pipe.close()


def line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def test_a_scanner_is_served_among_strangers_and_free_after_a_power_cut(tmp_path: Path) -> None:
    with ExitStack() as stack:
        left, hall, spare = stack.enter_context(network("left", "hall", "spare"))
        scanner = Scanner(tmp_path / "left", left, stack)
        words = (scanner.address, str(scanner.key))

        with other(spare, STRANGERS, scanner.address) as strangers:
            assert line(strangers) == "1000"
            with other(hall, CLIENT, *words) as client:
                print(f"first client, among 1,000 strangers: {float(line(client)):.2f} s")
                assert line(client) == "lit"
            wait_until(lambda: scanner.said().count("projectors are dark") == 1)
        with other(spare, STRANGERS, scanner.address) as strangers:
            assert line(strangers) == "1000"
            with other(hall, CLIENT, *words) as client:
                connected_s = float(line(client))
                print(f"next client, among 1,000 new strangers: {connected_s:.2f} s")
                assert connected_s < 1.0
                assert line(client) == "lit"
                # Frozen, with its connection open and its memory taking what comes.
                os.kill(client.pid, signal.SIGSTOP)
                began = time.monotonic()
                wait_until(lambda: scanner.gone() == 1)
                print(f"dark after a client froze: {time.monotonic() - began:.1f} s")
                assert time.monotonic() - began < 15.0
                assert scanner.said().count("projectors are dark") == 2
        with other(hall, CLIENT, *words) as client:
            assert float(line(client)) < 15.0
            assert line(client) == "lit"
            hall.unplug()
            began = time.monotonic()
            wait_until(lambda: scanner.gone() == 2)
            print(f"dark after the power of a client was cut: {time.monotonic() - began:.1f} s")
            assert time.monotonic() - began < 15.0
            with other(spare, CLIENT, *words) as next_one:
                assert float(line(next_one)) < 5.0
