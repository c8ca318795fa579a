"""Where a process is: names of machines are given twice, and numbers of processes again and again."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

_MACHINE = Path("/etc/machine-id")
_BOOT = Path("/proc/sys/kernel/random/boot_id")
_PROCESSES = Path("/proc")


@dataclass(frozen=True)
class Origin:
    """Where and when a process began; all of it unknown by default.

    Attributes
    ----------
    machine
        Its id, which a cloned machine may share.
    boot
        Id of the boot, which no two share.
    pid_namespace
        In which numbers of processes mean something: a container has one of its own.
    started
        Of the process, in clock ticks from the boot.
    """

    machine: str = ""
    boot: str = ""
    pid_namespace: str = ""
    started: int = 0

    @classmethod
    def own(cls) -> Origin:
        """Return where this process is; unknown where the system does not tell, or describes others."""
        try:
            if (_PROCESSES / "self").readlink().name != str(os.getpid()):
                return cls()  # the processes that are shown are those of another name space
            boot = _BOOT.read_text(encoding="ascii").strip()
            namespace = str((_PROCESSES / "self" / "ns" / "pid").readlink())
            started = started_at(os.getpid())
        except (OSError, ValueError):
            return cls()
        machine = _MACHINE.read_text(encoding="ascii").strip() if _MACHINE.is_file() else ""
        return cls(machine, boot, namespace, started or 0)

    def sees(self, other: Origin) -> bool:
        """Whether numbers of processes mean the same here and there."""
        here, there = ((one.machine, one.boot, one.pid_namespace) for one in (self, other))
        return here == there and bool(self.boot and self.pid_namespace and other.started)


def is_gone(pid: int, there: Origin, here: Origin) -> bool:
    """Tell whether a process is gone for certain: it would have to be where this one is, and is not."""
    try:
        return here.sees(there) and started_at(pid) != there.started
    except (OSError, ValueError):
        return False


def started_at(pid: int) -> int | None:
    """Return when a process started, in clock ticks from the boot; None when there is none."""
    try:
        line = (_PROCESSES / str(pid) / "stat").read_text(encoding="ascii", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        if _nobody_has(pid):
            return None
        raise
    # The name in brackets may hold anything, and what comes after begins with the third field.
    state, *fields = line.rpartition(")")[2].split()
    return None if state in "ZX" else int(fields[18])


def _nobody_has(pid: int) -> bool:
    # Processes of other accounts may be hidden.
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        pass
    return False
