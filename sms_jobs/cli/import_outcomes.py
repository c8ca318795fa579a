"""What imports of images tell, and ask: outcomes by tuple, times, the campaign that is there."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import typer

from sms_jobs.bootstrap import Services
from sms_jobs.catalogue import campaigns
from sms_jobs.cli import output
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.formats.importers.folders import LeftOut
from sms_jobs.formats.importers.inspection import Inspected
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.times import parsed_time

_FINDINGS = 6
TOLD = 20
"""Lines of a list that are shown; --json has all."""


def confirm(question: str) -> None:
    """Ask whether a guess is right, and end if it is not; where nobody can answer, say how to."""
    if not sys.stdin.isatty():
        raise InvalidInput("what was guessed has to be confirmed: look at it with --dry-run, then say --yes")
    typer.confirm(question, abort=True, err=True)


@dataclass
class Outcome:
    """What became of every tuple, in order."""

    rows: list[dict[str, Any]]
    remarks: list[str]

    @property
    def bad(self) -> bool:
        """Whether a tuple was refused."""
        return any(r["outcome"] == "refused" for r in self.rows)


def time_given(text: str | None) -> datetime | None:
    """Return the time of --recorded-at; raise `InvalidInput` for one without a zone."""
    return None if text is None else parsed_time(text, "--recorded-at")


def existing_campaign(services: Services, name: str) -> Campaign | None:
    """Return a campaign; None where there is none of that name."""
    with services.catalogue.reading() as session:
        try:
            return campaigns.definition(campaigns.campaign_row(session, name))
        except NotFound:
            return None


def row_of(one: Inspected, outcome: str, detail: str) -> dict[str, Any]:
    """Return what is told of a tuple."""
    facts = next(iter(one.facts.values()), None)
    return {
        "state": one.found.state,
        "view": one.found.view,
        "frames": len(set(one.found.files)),
        "size": None if facts is None else f"{facts.columns} x {facts.rows}",
        "outcome": outcome,
        "detail": detail,
    }


def _short(row: Mapping[str, Any]) -> str:
    """Return what a table shows of a detail; why a tuple is refused stands below it."""
    return "see below" if row["outcome"] == "refused" else row["detail"]


def tell(
    outcome: Outcome, files: Sequence[LeftOut], *, as_json: bool, dry_run: bool, campaign: str, then: str
) -> None:
    """Print what became of every tuple and which files were left out; end with 6 where one was refused."""
    counts = Counter(row["outcome"] for row in outcome.rows)
    left_out = [{"file": one.name, "why": one.why} for one in files]
    if as_json:
        output.print_json(
            {
                "campaign": campaign,
                "dry_run": dry_run,
                "tuples": outcome.rows,
                "left_out": left_out,
                "remarks": outcome.remarks,
            }
        )
    else:
        output.print_table(
            ["state", "view", "frames", "size [px]", "outcome", "detail"],
            [tuple({**row, "detail": _short(row)}.values()) for row in outcome.rows],
            empty="there is nothing to import",
        )
        for row in outcome.rows:
            if row["outcome"] == "refused":
                output.say(f"refused: {row['state']}/{row['view']}: {row['detail']}")
        for remark in outcome.remarks:
            output.say(f"note: {remark}")
        for one in left_out[:TOLD]:
            output.say(f"left out: {one['file']} {one['why']}")
        if len(left_out) > TOLD:
            output.say(f"left out: {len(left_out) - TOLD} more files; --json lists all")
        output.say(
            ", ".join(f"{n} {what}" for what, n in counts.items())
            + ("; nothing was changed" if dry_run else "")
        )
        if outcome.bad and not dry_run:
            output.say(
                "what was refused is not in the archive: mend it and import again, or leave it out by --only"
            )
        if counts["imported"]:
            output.say(f"next: sms job submit {then} --campaign {campaign}")
    if outcome.bad:
        raise typer.Exit(_FINDINGS)
