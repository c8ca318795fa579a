"""The process that serves the console beside a supervisor: restarted when it dies, ended with it."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

logger = logging.getLogger(__name__)

_LOOK_EVERY_S = 0.5
_SHORTEST_PAUSE_S, _LONGEST_PAUSE_S = 1.0, 60.0
_SOUND_S = 60.0
"""A process that has lived for so long is restarted without delay."""
_TO_END_S = 10.0


class WebProcess:
    """`sms serve` as a child, which lives no longer than this process does.

    Parameters
    ----------
    home
        That is served.
    listen
        Address and port.
    """

    def __init__(self, home: Path, listen: str) -> None:
        serve = ["serve", "--until-eof", "--listen", listen, "--home", str(home)]
        self._command = [sys.executable, "-P", "-m", "sms_jobs.cli.main", *serve]
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._tend, name="web", daemon=True)
        # Its end is told by the system even where this process is killed.
        self._lifeline, self._held = os.pipe()

    def start(self) -> None:
        """Begin the process, and look after it from now on."""
        self._thread.start()

    def stop(self) -> None:
        """End the process, in order if it does not take long."""
        self._closed.set()
        os.close(self._held)
        self._thread.join()
        os.close(self._lifeline)

    def _tend(self) -> None:
        pause = _SHORTEST_PAUSE_S
        while not self._closed.is_set():
            begun = time.monotonic()
            # A session of its own: Ctrl-C is for the supervisor, which ends this one last.
            process = subprocess.Popen(self._command, stdin=self._lifeline, start_new_session=True)
            while process.poll() is None and not self._closed.wait(_LOOK_EVERY_S):
                pass
            if self._closed.is_set():
                _end(process)
                return
            if time.monotonic() - begun >= _SOUND_S:
                pause = _SHORTEST_PAUSE_S
            logger.warning(
                "the console ended with exit code %d and is restarted in %.0f s", process.returncode, pause
            )
            self._closed.wait(pause)
            pause = min(2 * pause, _LONGEST_PAUSE_S)


def _end(process: subprocess.Popen[bytes]) -> None:
    try:
        process.wait(_TO_END_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
