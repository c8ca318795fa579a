"""Checking dataset files in a process of its own, with a time limit: a damaged one can hang or kill HDF5."""

from __future__ import annotations

import json
import resource
import select
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from sms_jobs.errors import ArchiveCorrupt, OtherFormat

START_SECONDS = 60.0
BYTES_PER_SECOND = 5e6
"""Slower than any disk that is worth keeping data on."""
MEMORY_BYTES = 6 << 30
"""More than any file within the limits of `limits` takes to be read."""

_SERVE = "from sms_jobs.archive.checking import serve; serve()"


def serve() -> None:
    """Check the files that are named on standard input, a JSON object a line; answer each with a line."""
    from sms_jobs.archive.dataset import check_dataset

    with suppress(ValueError, OSError):  # not every system has such a limit
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY_BYTES, MEMORY_BYTES))
    for line in sys.stdin:
        asked = json.loads(line)
        answer = {"code": 0, "message": ""}
        try:
            check_dataset(Path(asked["file"]), asked["where"], asked["content_hash"])
        except (ArchiveCorrupt, OtherFormat) as error:
            answer = {"code": error.exit_code, "message": str(error)}
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


class Checker:
    """Checks one file after the other, in a process that is restarted when a file has cost its life."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Checker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def check(self, file: Path, where: str, content_hash: str) -> None:
        """Check a dataset file as `check_dataset` does.

        Raises
        ------
        ArchiveCorrupt
            When the file does not have that content hash, or the check crashed or never ended.
        OtherFormat
            When it was written by a newer version.
        """
        if not file.is_file():
            raise ArchiveCorrupt(f"{where} is missing from the archive; restore it from a backup")
        limit = START_SECONDS + file.stat().st_size / BYTES_PER_SECOND
        process = self._begun()
        assert process.stdin is not None
        assert process.stdout is not None
        asked = {"file": str(file), "where": where, "content_hash": content_hash}
        process.stdin.write(json.dumps(asked).encode() + b"\n")
        process.stdin.flush()
        if not select.select([process.stdout], [], [], limit)[0]:
            self._end()
            raise ArchiveCorrupt(
                f"reading {where} did not end within {limit:.0f} s; restore it from a backup"
            )
        line = process.stdout.readline()
        if not line:
            code = process.wait()
            self._end()
            raise ArchiveCorrupt(f"reading {where} ended with code {code}; restore it from a backup")
        answer = json.loads(line)
        if answer["code"]:
            kind = OtherFormat if answer["code"] == OtherFormat.exit_code else ArchiveCorrupt
            raise kind(answer["message"])

    def _begun(self) -> subprocess.Popen[bytes]:
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-c", _SERVE], stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
        return self._process

    def _end(self) -> None:
        if self._process is None:
            return
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process = None
