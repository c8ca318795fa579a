"""`sms archive`: is everything there, and as it was sealed?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

import typer
from rich.progress import Progress

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.cli import completion, output
from sms_jobs.cli.output import Home, Json
from sms_jobs.jobs import verification
from sms_jobs.jobs.verification import Checked, Finding

app = typer.Typer(help="The archive: is everything there, and as it was sealed?", no_args_is_help=True)

_FINDINGS = 6


@app.command()
def verify(
    campaign: Annotated[
        str | None,
        typer.Option(
            "--campaign", "-c", help="Only files of this campaign.", autocompletion=completion.campaign_names
        ),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Look at presence and size alone.")] = False,
    after: Annotated[
        int, typer.Option(help="Go on after the file of this number, where another run ended.", min=0)
    ] = 0,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Read every file of the archive and compare it with the catalogue.

    Files that are missing, damaged, unknown to the catalogue, or left behind by a job that has ended are
    listed; the exit code is then 6. It may be interrupted, and says how to go on.

    Example: sms archive verify --campaign wing-fatigue
    """
    last = after
    findings: list[Finding] = []
    with bootstrap.services(home) as services:
        with services.catalogue.reading() as session:
            wanted = verification.extent(session, after, campaign)
        try:
            with output.byte_bar() as bar:
                for done in _checked(services, bar, wanted.size_bytes, after, campaign, quick):
                    last = done.file_id
                    if done.finding is not None:
                        findings.append(done.finding)
        except KeyboardInterrupt:
            output.say(f"interrupted; 'sms archive verify --after {last}' goes on from here")
            raise
        if campaign is None:
            findings += verification.check_unknown(services.catalogue, services.archive)
    if as_json:
        output.print_json({"checked": wanted.files, "bytes": wanted.size_bytes, "findings": findings})
    else:
        output.print_table(
            ["problem", "file", "what"],
            [(f.problem, f.path, f.detail) for f in findings],
            empty=f"{wanted.files} files, {output.size(wanted.size_bytes)}: all as they were sealed",
        )
    if findings:
        raise typer.Exit(_FINDINGS)


def _checked(
    services: Services, bar: Progress, size: int, after: int, campaign: str | None, quick: bool
) -> Iterator[Checked]:
    task = bar.add_task("verifying", total=max(size, 1))
    for done in verification.check_known(
        services.catalogue, services.archive, after=after, campaign=campaign, quick=quick
    ):
        bar.advance(task, done.size_bytes)
        yield done
