"""A display that nobody sees: an X server in memory, whose pixels can be read."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from support.missing import do_without

COLUMNS, ROWS = 320, 200


@dataclass(frozen=True)
class Display:
    """The server's address, and where it keeps its screen."""

    name: str
    framebuffer: Path

    def grab(self) -> NDArray[Any]:
        """Return what is on the screen, (rows, columns, red green blue), as the X server has it."""
        content = self.framebuffer.read_bytes()
        # The X window dump: a header of 32-bit numbers, colours of 12 bytes each, then lines of blue, green,
        # red and a byte that is not used.
        header = struct.unpack(">25I", content[:100])
        size, columns, rows, order, bits, line, colours = (header[i] for i in (0, 4, 5, 7, 11, 12, 19))
        assert (columns, rows, order, bits) == (COLUMNS, ROWS, 0, 32)
        start = size + 12 * colours
        pixels = np.frombuffer(content, np.uint8, rows * line, start).reshape(rows, line)
        return pixels[:, : 4 * columns].reshape(rows, columns, 4)[:, :, 2::-1]


@contextmanager
def display(folder: Path) -> Iterator[Display]:
    """Start an X server without a screen; without one, skip, or fail where CI=true."""
    server = shutil.which("Xvfb")
    if server is None:
        reason = "needs the X server Xvfb: run ops/test.sh, or install the package xvfb"
        do_without(reason, insist=sys.platform == "linux")
    read, write = os.pipe()
    screen = f"{COLUMNS}x{ROWS}x24"
    words = [server, "-displayfd", str(write), "-screen", "0", screen, "-fbdir", str(folder)]
    with subprocess.Popen(
        [*words, "-noreset", "-nolisten", "tcp"],
        pass_fds=[write],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as process:
        os.close(write)
        try:
            with os.fdopen(read) as told:
                number = told.readline().strip()  # when it is ready; empty when it ended
            assert number, "Xvfb did not start"
            yield Display(f":{number}", folder / "Xvfb_screen0")
        finally:
            process.terminate()
