"""The `sms` command: its groups, and how errors become one sentence and an exit code."""

from __future__ import annotations

import io
import os
import sys
from typing import Annotated

import typer
from typer.exceptions import TyperException

import sms_jobs
from sms_jobs.cli import output
from sms_jobs.cli.commands import Commands
from sms_jobs.errors import SmsError

_INTERRUPTED = 130
_TRUE = frozenset({"1", "true", "t", "yes", "y", "on"})

app = typer.Typer(
    name="sms",
    cls=Commands,
    help="Archive, process and query optical shape, deformation and strain measurements.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _print_version(requested: bool) -> None:
    if requested:
        sys.stdout.write(f"sms {sms_jobs.__version__}\n")
        raise typer.Exit


@app.callback()
def _options(
    debug: Annotated[bool, typer.Option("--debug", envvar="SMS_DEBUG", help="Show tracebacks.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Hold the options of every command."""
    if debug:
        os.environ["SMS_DEBUG"] = "1"


def main() -> None:
    """Run the command line; exit codes are those of `sms_jobs.errors`."""
    for stream in (sys.stdout, sys.stderr):
        # A terminal that lacks a letter is shown its number.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        code = app(standalone_mode=False)
    except SmsError as error:
        _refuse(error, str(error), error.exit_code)
    except TyperException as error:
        if not error.format_message():
            # `sms` alone: its help has been shown.
            sys.exit(error.exit_code)
        context = getattr(error, "ctx", None)
        hint = f"; see '{context.command_path} --help'" if context is not None else ""
        _refuse(error, f"{error.format_message().rstrip('.')}{hint}", error.exit_code)
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


def _refuse(error: Exception, text: str, code: int) -> None:
    if os.environ.get("SMS_DEBUG", "").lower() in _TRUE:
        raise error
    output.say_error(text)
    sys.exit(code)


if __name__ == "__main__":
    main()
