"""Loads all kinds once and forks places, so that one which takes the place of another is there at once.

Started by the supervisor as `python -m sms_jobs.workers.nursery`, with the board and the lifeline as file
descriptors. Each byte of its standard input asks for a place, the first being 0; it ends with its input.
It opens nothing and starts no thread: what is forked begins clean.
"""

from __future__ import annotations

import gc
import os
import select
import signal
import sys
from contextlib import suppress

gc.disable()  # what is loaded stays: to look through it for garbage again and again is a tenth of loading it

from sms_jobs.kinds import all_kinds  # noqa: E402
from sms_jobs.workers import place, preparation  # noqa: E402
from sms_jobs.workers.board import NURSERY, Board, place_line  # noqa: E402
from sms_jobs.workers.tasks import app  # noqa: E402

_BEAT_EVERY_S = 1.0


def main() -> None:
    """Fork what is asked for, until nobody asks any more."""
    board_descriptor, lifeline = int(sys.argv[1]), int(sys.argv[2])
    # A stopped process whose parent dies is hung up on by the system, with all of its group.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    all_kinds()
    app.finalize()
    # What is there now is shared by all places for as long as no collection touches it.
    gc.collect()
    gc.freeze()
    gc.enable()
    wishes = sys.stdin.fileno()
    preparation.start(lifeline, wishes)
    board = Board(board_descriptor)
    board.enter(NURSERY, os.getpid())
    children: dict[int, int] = {}
    while board.beat(NURSERY):
        asked, _, _ = select.select([wishes], [], [], _BEAT_EVERY_S)
        requested = os.read(wishes, 256) if asked else b""
        if asked and not requested:
            return
        _bury(children)
        for line in {place_line(number) for number in requested} - set(children.values()):
            children[_fork(board, line, lifeline, wishes)] = line


def _bury(children: dict[int, int]) -> None:
    """Take leave of children that have ended, and let what compiles kernels go on where it was stopped.

    The supervisor wakes the places; of what compiles it knows nothing.
    """
    with suppress(ChildProcessError):  # there is none
        while True:
            pid, status = os.waitpid(-1, os.WNOHANG | os.WUNTRACED)
            if pid == 0:
                return
            if not os.WIFSTOPPED(status):
                children.pop(pid, None)
            elif pid not in children:
                os.kill(pid, signal.SIGCONT)


def _fork(board: Board, line: int, lifeline: int, wishes: int) -> int:
    child = os.fork()
    if child == 0:
        os.dup2(os.open(os.devnull, os.O_RDONLY), wishes)
        place.serve(board, line, lifeline)
    # It says so itself, too; one that is stopped before it could would be known to nobody.
    board.enter(line, child)
    return child


if __name__ == "__main__":
    main()
