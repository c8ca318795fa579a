"""Signs of life in memory that a supervisor shares with its processes.

A line for the nursery and one for each place: the process that is there, and how often it has said that it
is well. The numbers mean nothing but that they change.
"""

from __future__ import annotations

import mmap
import os
import struct
import tempfile

_LINE = struct.Struct("=qq")
_DRAINING = 0
"""Where one byte tells the places to end after what they run; the lines follow."""
_HEAD = 16
NURSERY = 0
"""Its line."""


class Board:
    """The memory, opened by its file descriptor.

    Parameters
    ----------
    descriptor
        As `new_board` returned it, here or in the process that has passed it on.
    """

    def __init__(self, descriptor: int) -> None:
        self._memory = mmap.mmap(descriptor, os.fstat(descriptor).st_size)

    def enter(self, line: int, pid: int) -> None:
        """Give a line to a process."""
        _LINE.pack_into(self._memory, _at(line), pid, 0)

    def beat(self, line: int) -> bool:
        """Give a sign of life; False when the line is another's now."""
        pid, beats = self.read(line)
        if pid != os.getpid():
            return False
        _LINE.pack_into(self._memory, _at(line), pid, beats + 1)
        return True

    def read(self, line: int) -> tuple[int, int]:
        """Return the process of a line and how often it has beaten; the process is 0 where there was none."""
        pid, beats = _LINE.unpack_from(self._memory, _at(line))
        return pid, beats

    def clear(self, line: int) -> None:
        """Let a line belong to nobody."""
        _LINE.pack_into(self._memory, _at(line), 0, 0)

    def drain(self) -> None:
        """Ask all places to end after what they run."""
        self._memory[_DRAINING] = 1

    @property
    def draining(self) -> bool:
        """Whether they are asked to."""
        return self._memory[_DRAINING] == 1


def place_line(number: int) -> int:
    """Return the line of a place; the first place is 0."""
    return NURSERY + 1 + number


def new_board(places: int) -> int:
    """Return the file descriptor of a board with lines for the nursery and so many places."""
    with tempfile.TemporaryFile() as file:
        # Written, so that there is room for it for good.
        file.write(bytes(_at(place_line(places))))
        file.flush()
        return os.dup(file.fileno())


def _at(line: int) -> int:
    return _HEAD + line * _LINE.size
