"""The `sms` command: its groups, and the options of all of them."""

from __future__ import annotations

import os
import sys
from typing import Annotated

import typer

import sms_jobs
from sms_jobs.cli.commands import Commands

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
