"""Arguments and options that commands of several subjects take, each declared once."""

from __future__ import annotations

from typing import Annotated, TypeAlias

import typer

from sms_jobs.cli import completion

Force: TypeAlias = Annotated[bool, typer.Option("--force", help="Replace a file that is there.")]
CampaignArgument: TypeAlias = Annotated[
    str, typer.Argument(help="Name of the campaign.", autocompletion=completion.campaign_names)
]
CampaignOption: TypeAlias = Annotated[
    str | None,
    typer.Option("--campaign", "-c", help="Name of the campaign.", autocompletion=completion.campaign_names),
]
JobId: TypeAlias = Annotated[
    str, typer.Argument(help="Job id, or the beginning of one.", autocompletion=completion.job_ids)
]
StoredFile: TypeAlias = Annotated[
    str, typer.Argument(help="Number or archive path of a file; see 'sms data find'.")
]
Priority: TypeAlias = Annotated[int, typer.Option(help="Higher runs earlier.", min=-100, max=100)]
NoCache: TypeAlias = Annotated[
    bool, typer.Option("--no-cache", help="Compute again what was computed before.")
]
NoWait: TypeAlias = Annotated[bool, typer.Option("--no-wait", help="Return at once.")]
Record: TypeAlias = Annotated[str | None, typer.Option(help="Record in the file; the first if not given.")]
