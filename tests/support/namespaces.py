"""Computers on a network of their own: network namespaces, joined by a bridge in one more.

They share files and processors with this machine, and nothing else: each has interfaces, ports and a name of
its own. Nothing reaches them from outside, nor they anything outside.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

_NETWORK = "10.213.7"


@dataclass(frozen=True)
class Computer:
    """A namespace with an address.

    Attributes
    ----------
    name
        Which it calls itself.
    namespace
        Which `ip netns` calls it.
    address
        On the network.
    """

    name: str
    namespace: str
    address: str

    def words(self, *command: str) -> list[str]:
        """Return a command that runs another one there."""
        inside = ["unshare", "--uts", "sh", "-c", 'hostname "$0"; exec "$@"', self.name, *command]
        return ["ip", "netns", "exec", self.namespace, *inside]

    def run(
        self, *command: str, environment: Mapping[str, str] | None = None, timeout: float = 300.0
    ) -> subprocess.CompletedProcess[str]:
        """Run a command there to its end."""
        return subprocess.run(
            self.words(*command),
            capture_output=True,
            text=True,
            timeout=timeout,
            env=os.environ | dict(environment or {}),
            stdin=subprocess.DEVNULL,
            check=False,
        )

    def unplug(self) -> None:
        """Cut it off: nothing arrives, and nobody is told."""
        _ip("-n", self.namespace, "link", "set", "eth0", "down")


@contextmanager
def network(*names: str) -> Iterator[tuple[Computer, ...]]:
    """Return computers that reach each other, the first in the middle; without root the test is skipped."""
    if os.geteuid() != 0 or shutil.which("ip") is None or shutil.which("unshare") is None:
        pytest.skip("network namespaces need root, and the programs ip (iproute2) and unshare")
    mark = f"sms{os.getpid()}"
    computers = tuple(
        Computer(name, f"{mark}-{name}", f"{_NETWORK}.{number}") for number, name in enumerate(names, 1)
    )
    made: list[str] = []
    try:
        for computer in computers:
            added = subprocess.run(
                ["ip", "netns", "add", computer.namespace], capture_output=True, text=True, check=False
            )
            if added.returncode:
                pytest.skip(f"network namespaces cannot be made here: {added.stderr.strip()}")
            made.append(computer.namespace)
        _join(computers)
        yield computers
    finally:
        for namespace in made:
            _ip("netns", "del", namespace)


def _join(computers: Sequence[Computer]) -> None:
    middle, *others = computers
    _ip("-n", middle.namespace, "link", "add", "eth0", "type", "bridge")
    for number, computer in enumerate(others):
        view = ["type", "veth", "peer", "name", "eth0", "netns", computer.namespace]
        _ip("-n", middle.namespace, "link", "add", f"port{number}", *view)
        _ip("-n", middle.namespace, "link", "set", f"port{number}", "master", "eth0", "up")
    for computer in computers:
        _ip("-n", computer.namespace, "addr", "add", f"{computer.address}/24", "dev", "eth0")
        for interface in ("lo", "eth0"):
            _ip("-n", computer.namespace, "link", "set", interface, "up")


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True)
