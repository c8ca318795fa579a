"""The program `sms`: how errors become one sentence and an exit code.

What commands consist of is imported with garbage collection off: it stays, and to look for garbage in it
again and again takes a tenth of a short command. `cli.commands` switches it on once a command is loaded.
"""

from __future__ import annotations

import gc
import io
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from sms_jobs.errors import SmsError, StorageUnusable, in_words

if TYPE_CHECKING:
    from typer.exceptions import TyperException

_INTERRUPTED = 130
_LETTERS = 100
_TRUE = frozenset({"1", "true", "t", "yes", "y", "on"})


def main() -> None:
    """Run the command line; exit codes are those of `sms_jobs.errors`."""
    _prepare_streams()
    # Nobody here has plugins for it, and to look for some in all packages takes 6 ms of every command.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    gc.disable()
    try:
        _run()
    finally:
        gc.enable()


def _run() -> None:
    import typer
    from typer.exceptions import TyperException

    from sms_jobs.cli import output
    from sms_jobs.cli.app import app

    try:
        code = app(standalone_mode=False)
        sys.stdout.flush()
    except SmsError as error:
        _refuse(error, str(error), error.exit_code)
    except TyperException as error:
        if not error.format_message():
            # `sms` alone: its help has been shown.
            sys.exit(error.exit_code)
        context = getattr(error, "ctx", None)
        hint = f"; see '{context.command_path} --help'" if context is not None else ""
        _refuse(error, f"{_told(error)}{hint}", error.exit_code)
    except (typer.Abort, KeyboardInterrupt):
        output.say("interrupted")
        sys.exit(_INTERRUPTED)
    except BrokenPipeError:
        # Whoever read our output has enough of it.
        os._exit(0)
    except Exception as error:  # noqa: BLE001 - the last line of defence against a traceback
        text = f"internal error ({type(error).__name__}: {error}); run again with 'sms --debug' and report it"
        _refuse(error, text, 1)
    sys.exit(code if isinstance(code, int) else 0)


def _told(error: TyperException) -> str:
    """Say in words of people what is wrong with a command line; of a value, which it is."""
    message = error.format_message().rstrip(".")
    found = getattr(error.__cause__, "errors", None)
    if found is None:
        return message
    first = found()[0]
    # What is no member of several says itself which it is.
    given = "" if first["type"] == "value_error" else f", not {str(first['input'])[:_LETTERS]!r}"
    return f"{in_words(message)}{given}"


class _Answers(io.TextIOWrapper):
    """Standard output, whose errors are told from those of other files, even where somebody swallows one."""

    _failure: StorageUnusable | None = None

    def write(self, text: str, /) -> int:
        """Write a text; raise `StorageUnusable` where it cannot be written."""
        with self._blamed():
            return super().write(text)

    def flush(self) -> None:
        """Write what is held back; raise `StorageUnusable` where something could not be written."""
        with self._blamed():
            super().flush()

    def drop(self) -> None:
        """Let what is still held back go nowhere: the interpreter tries to write it when it ends."""
        self._failure = None
        _lead_nowhere(self.fileno())

    @contextmanager
    def _blamed(self) -> Iterator[None]:
        if self._failure is not None:
            raise self._failure
        try:
            yield
        except BrokenPipeError:
            raise
        except OSError as error:
            self._failure = StorageUnusable(
                f"the answer cannot be written to standard output: {error.strerror}; free some space, or "
                "write it elsewhere"
            )
            raise self._failure from error


def _prepare_streams() -> None:
    """Let both streams take any letter, and have somewhere to go where whoever started us has closed them."""
    if sys.stdout is None:
        sys.stdout = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115 - for as long as this lives
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115
    # A terminal that lacks a letter is shown its number. What somebody else has put there stays as it is.
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout is sys.__stdout__:
        encoding, at_once, by_line = sys.stdout.encoding, sys.stdout.write_through, sys.stdout.line_buffering
        sys.stdout = _Answers(
            sys.stdout.detach(), encoding, "backslashreplace", line_buffering=by_line, write_through=at_once
        )
    if isinstance(sys.stderr, io.TextIOWrapper):
        sys.stderr.reconfigure(errors="backslashreplace")


def _refuse(error: Exception, text: str, code: int) -> None:
    if os.environ.get("SMS_DEBUG", "").lower() in _TRUE:
        raise error
    try:
        sys.stdout.flush()
    except StorageUnusable:
        if isinstance(sys.stdout, _Answers):
            sys.stdout.drop()
    from sms_jobs.cli import output

    try:
        output.say_error(text)
        sys.stderr.flush()
    except OSError:
        _lead_nowhere(2)  # the exit code tells it all the same
    sys.exit(code)


def _lead_nowhere(descriptor: int) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)


if __name__ == "__main__":
    main()
