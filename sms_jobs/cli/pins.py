"""`sms data pin`, `unpin` and `pins`: files that no policy removes."""

from __future__ import annotations

from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.holdings import files
from sms_jobs.cli import output
from sms_jobs.cli.options import StoredFile
from sms_jobs.cli.output import Home, Json


def pin(
    file: StoredFile,
    reason: Annotated[str, typer.Option(help="Why it is kept.")] = "",
    home: Home = None,
) -> None:
    """Keep a file, and all that it was computed from, whatever `sms archive gc` is asked to remove.

    Example: sms data pin 17 --reason "figure 4 of the paper"
    """
    with bootstrap.services(home) as services:
        view = files.pin(services, file, reason)
    output.say(f"file {view.id} is pinned")


def unpin(file: StoredFile, home: Home = None) -> None:
    """Let a policy decide about a file again.

    Example: sms data unpin 17
    """
    with bootstrap.services(home) as services:
        view = files.unpin(services, file)
    output.say(f"file {view.id} is not pinned any more")


def pins(home: Home = None, as_json: Json = False) -> None:
    """Show the files that are pinned, and why.

    Example: sms data pins
    """
    with bootstrap.services(home) as services:
        found = files.pins(services)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["file", "path", "reason", "since"],
        [(p.file_id, p.path, p.reason, p.pinned_at) for p in found],
        empty="no file is pinned",
    )
