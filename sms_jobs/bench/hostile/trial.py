"""Runs command lines in forked processes on a home of their own, and says what came of each."""

from __future__ import annotations

import importlib
import importlib.metadata
import io
import json
import os
import pkgutil
import select
import shutil
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from random import Random
from types import FrameType
from typing import Any

import sms_jobs
from sms_jobs.bench.hostile.judge import Watch, faults_of
from sms_jobs.bench.hostile.store import Store
from sms_jobs.bench.hostile.things import make_homes, make_things
from sms_jobs.bench.hostile.tries import COSTLY, SLOW, Leaf, Try, leaves, made

BATCH = 50
LONGEST_CPU_S = 10.0
LONGEST_S = 60.0
"""By the clock, on a machine that others use too."""
_PATIENCE_S = 90.0
_INTERRUPTED_AFTER_S = 0.7
_LEFT_OUT = (
    "sms_jobs.bench",
    "sms_jobs.migrations",
    "sms_jobs.instruments.cameras.",
    "sms_jobs.instruments.projectors.",
)
"""Of what is imported: what no command under trial needs, or what needs more than this program."""


class TooLongError(BaseException):
    """A command went on for longer than any may; no `except Exception` is to catch it."""


@dataclass(frozen=True)
class Outcome:
    """What came of a try."""

    batch: int
    number: int
    arguments: tuple[str, ...]
    environment: dict[str, str]
    code: int | None
    faults: tuple[str, ...]
    said: str = ""


def entry_point() -> Any:
    """Return the function that the installed command `sms` calls."""
    (found,) = importlib.metadata.entry_points(group="console_scripts", name="sms")
    return found.load()


def commands() -> tuple[Leaf, ...]:
    """Return every command of `sms`."""
    from typer.main import get_command

    from sms_jobs.cli.app import app

    return tuple(leaves(get_command(app)))


def run(store: Store, folder: Path, seed: int, batches: range) -> Iterator[Outcome]:
    """Try batches of command lines, each batch on a home of its own; the same seed gives the same."""
    known = commands()
    load_everything()
    for batch in batches:
        place = folder / f"batch-{batch}"
        place.mkdir()
        try:
            yield from _batch(store, place, seed, batch, known)
        finally:
            store.release(place)
            shutil.rmtree(place, ignore_errors=True)


def load_everything() -> None:
    """Import what commands import when they are called, so that no child has to."""
    for module in pkgutil.walk_packages(sms_jobs.__path__, "sms_jobs."):
        if not module.name.startswith(_LEFT_OUT) and not module.name.endswith("__main__"):
            importlib.import_module(module.name)


def _batch(store: Store, place: Path, seed: int, batch: int, known: tuple[Leaf, ...]) -> Iterator[Outcome]:
    rng = Random(f"{seed}/{batch}")  # noqa: S311 - what is tried can be tried again
    things = make_things(place / "things", rng)
    homes = make_homes(place / "homes", rng)
    (place / "out").mkdir()
    environment = store.lend(place)
    weights = [COSTLY if leaf.name in SLOW else 1.0 for leaf in known]
    tries = [made(leaf, rng, things, homes, "home") for leaf in rng.choices(known, weights, k=BATCH)]
    next_one = 0
    while next_one < len(tries):
        for outcome in _forked(store, place, batch, tries, next_one, environment):
            next_one = outcome.number + 1
            yield outcome


def _forked(
    store: Store, place: Path, batch: int, tries: list[Try], first: int, environment: dict[str, str]
) -> Iterator[Outcome]:
    """Run tries in a child from the first on; a child that falls silent is killed, and its try reported."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reading)
        try:
            _work(store, place, batch, tries, first, environment, writing)
        except BaseException as error:  # noqa: BLE001 - whatever it is, the parent reports it
            with suppress(OSError):
                os.write(writing, json.dumps({"broke": repr(error)}).encode() + b"\n")
        finally:
            os._exit(0)
    os.close(writing)
    begun = first
    ended = False
    with os.fdopen(reading, "rb", buffering=0) as stream:
        for line in _lines(stream):
            message = json.loads(line)
            if "broke" in message:
                raise RuntimeError(f"batch {batch}, try {begun}: {message['broke']}")
            begun, ended = message["number"], "faults" in message
            if ended:
                yield Outcome(
                    **message | {"arguments": tuple(message["arguments"]), "faults": tuple(message["faults"])}
                )
    with suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if not ended:
        why = "it hangs in native code" if os.WIFSIGNALED(status) else f"it ended the process ({status})"
        one = tries[begun]
        yield Outcome(batch, begun, one.arguments, dict(one.environment), None, (why,))


def _lines(stream: Any) -> Iterator[bytes]:
    """Yield lines until there are no more, or none comes for long."""
    rest = b""
    while select.select([stream], [], [], _PATIENCE_S)[0]:
        piece = stream.read(65536)
        if not piece:
            return
        *whole, rest = (rest + piece).split(b"\n")
        yield from whole


def _work(
    store: Store,
    place: Path,
    batch: int,
    tries: list[Try],
    first: int,
    environment: dict[str, str],
    pipe: int,
) -> None:
    os.chdir(place)
    os.environ.update(environment)
    main = entry_point()
    native = _NativeOutput()
    watch = Watch(place, store.open(environment))
    for number in range(first, len(tries)):
        one = tries[number]
        os.write(pipe, json.dumps({"number": number}).encode() + b"\n")
        code, said = _called(main, one)
        said += native.taken()
        faults = faults_of(one, code, said, watch)
        outcome = Outcome(
            batch,
            number,
            one.arguments,
            dict(one.environment),
            code,
            tuple(faults),
            said[-1500:] if faults else "",
        )
        os.write(pipe, json.dumps(asdict(outcome)).encode() + b"\n")


def _called(main: Any, one: Try) -> tuple[int | None, str]:
    """Call the command as the shell does; return its exit code, None without an end, and its words."""
    before = dict(os.environ)
    os.environ.update(one.environment)
    sys.argv = ["sms", *one.arguments]
    out, err = _stream(), _stream()
    sys.stdout, sys.stderr, sys.stdin = out, err, Path(os.devnull).open(encoding="utf-8")  # noqa: SIM115
    code: int | None = None
    try:
        with _alarmed(one.endless):
            main()
            code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except TooLongError:
        code = None
    except KeyboardInterrupt:
        # It came before the command had started to listen for it, or after it had ended.
        code = 130 if one.endless else 1
    except BaseException as error:  # noqa: BLE001 - nothing but an exit may leave the command
        print(f"Traceback: {type(error).__name__}: {error!r}", file=err)
        code = 1
    finally:
        said = [_read(stream) for stream in (out, err)]
        sys.stdin.close()
        sys.stdout, sys.stderr, sys.stdin = sys.__stdout__, sys.__stderr__, sys.__stdin__
        for name in os.environ.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)
    return code, "\n".join(said)


class _NativeOutput:
    """What libraries write to the process's own output, past Python."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - as long as the process
        for descriptor in (1, 2):
            os.dup2(self._file.fileno(), descriptor)

    def taken(self) -> str:
        """Return what was written since it was last asked."""
        self._file.seek(0)
        written = self._file.read()
        self._file.seek(0)
        self._file.truncate()
        return written.decode("utf-8", "backslashreplace")


def _stream() -> io.TextIOWrapper:
    """Return a stream as Python opens them for programs in UTF-8."""
    return io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True)


def _read(stream: io.TextIOWrapper) -> str:
    stream.flush()
    return stream.buffer.getvalue().decode("utf-8", "backslashreplace")  # type: ignore[attr-defined,no-any-return]


class _alarmed:  # noqa: N801 - reads as a phrase
    """Ends a command that takes too long; interrupts one that would go on for ever."""

    def __init__(self, endless: bool) -> None:
        self._endless = endless

    def __enter__(self) -> None:
        signal.signal(signal.SIGPROF, _too_long)
        signal.signal(signal.SIGALRM, _interrupt if self._endless else _too_long)
        signal.setitimer(signal.ITIMER_PROF, LONGEST_CPU_S)
        signal.setitimer(signal.ITIMER_REAL, _INTERRUPTED_AFTER_S if self._endless else LONGEST_S)

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def _too_long(_signal: int, _frame: FrameType | None) -> None:
    raise TooLongError


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt
