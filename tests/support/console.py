"""Documents whose commands are run: blocks of `console`, a line with `$ ` for each, then what it prints."""

from __future__ import annotations

import doctest
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

_BLOCK = re.compile(r"^```console\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_END = "end-of-command"
_ALIKE = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@dataclass
class Command:
    """A command, which further lines with `> ` may continue, and what the document says it prints."""

    text: str
    printed: list[str] = field(default_factory=list)


def sections(document: str) -> dict[str, list[Command]]:
    """Return the commands of a Markdown text by the heading of second level that they stand under."""
    parts = re.split(r"^## (.*)$", document, flags=re.MULTILINE)
    return {
        heading: commands
        for heading, text in zip(parts[1::2], parts[2::2], strict=True)
        if (commands := [one for block in _BLOCK.findall(text) for one in _commands(block)])
    }


def _commands(block: str) -> Iterator[Command]:
    found: list[Command] = []
    for line in block.splitlines():
        if line.startswith("$ "):
            found.append(Command(line[2:]))
        elif line.startswith("> ") and not found[-1].printed:
            found[-1].text += "\n" + line[2:]
        else:
            found[-1].printed.append(line)
    return iter(found)


def alike(said: list[str], printed: str) -> bool:
    """Say whether output is what a document says: `...` stands for anything, and spaces do not count."""
    wanted = "\n".join(said) + "\n" if said else ""
    return doctest.OutputChecker().check_output(wanted, printed, _ALIKE)


class Shell:
    """A shell in a folder, in which `sms` is this program; output and errors come as one, as on a screen."""

    def __init__(self, folder: Path) -> None:
        told = {
            "COLUMNS": "120",
            "NO_COLOR": "1",
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        }
        self._process = subprocess.Popen(
            ["bash", "--norc"],
            cwd=folder,
            env={k: v for k, v in os.environ.items() if not k.startswith("SMS_")} | told,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )

    def run(self, command: str) -> str:
        """Run a command to its end, or in the background if it says so, and return what it prints."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        # Commands are not to read what follows them.
        self._process.stdin.write(f"{{ {command}\n}} < /dev/null\necho {_END}\n")
        self._process.stdin.flush()
        printed = []
        for line in self._process.stdout:
            if line == f"{_END}\n":
                return "".join(printed)
            printed.append(line)
        raise AssertionError(f"the shell ended in '{command}': {''.join(printed)}")

    def close(self) -> None:
        """End the shell and all that it has started, the service in order."""
        os.killpg(self._process.pid, signal.SIGTERM)
        self._process.communicate(timeout=60)


@contextmanager
def shell(folder: Path) -> Iterator[Shell]:
    """Return a shell, and end what it has left running."""
    made = Shell(folder)
    try:
        yield made
    finally:
        made.close()
