"""What imports of images tell, and ask: outcomes by tuple, and times."""

from __future__ import annotations

import sys
from collections import Counter
from datetime import datetime
from typing import TYPE_CHECKING

import typer

from sms_jobs.cli import output
from sms_jobs.errors import InvalidInput
from sms_jobs.records.times import parsed_time

if TYPE_CHECKING:
    from sms_jobs.app.importing.outcomes import Outcome, TupleOutcome

_FINDINGS = 6
MOST_SHOWN = 20
"""Lines of a list that are shown; --json has all."""


def confirm(question: str) -> None:
    """Ask whether a guess is right, and end if it is not; where nobody can answer, say how to."""
    if not sys.stdin.isatty():
        raise InvalidInput("what was guessed has to be confirmed: look at it with --dry-run, then say --yes")
    typer.confirm(question, abort=True, err=True)


def time_given(text: str | None) -> datetime | None:
    """Return the time of --recorded-at; raise `InvalidInput` for one without a zone."""
    return None if text is None else parsed_time(text, "--recorded-at")


def _shown(one: TupleOutcome) -> tuple[object, ...]:
    """Return what a table shows of a tuple; why it is refused stands below."""
    detail = "see below" if one.outcome == "refused" else output.with_options(one.detail)
    return (one.state, one.view, one.frames, one.size, one.outcome, detail)


def tell_outcome(outcome: Outcome, *, as_json: bool, dry_run: bool, campaign: str, then: str) -> None:
    """Print what became of every tuple and which files were left out; end with 6 where one was refused."""
    counts = Counter(one.outcome for one in outcome.tuples)
    left_out = [{"file": one.name, "why": one.why} for one in outcome.left_out]
    if as_json:
        output.print_json(
            {
                "campaign": campaign,
                "dry_run": dry_run,
                "tuples": outcome.tuples,
                "left_out": left_out,
                "remarks": outcome.remarks,
            }
        )
    else:
        output.print_table(
            ["state", "view", "frames", "size [px]", "outcome", "detail"],
            [_shown(one) for one in outcome.tuples],
            empty="there is nothing to import",
        )
        for one in outcome.tuples:
            if one.outcome == "refused":
                output.say(f"refused: {one.state}/{one.view}: {one.detail}")
        for remark in outcome.remarks:
            output.say(f"note: {remark}")
        for file in left_out[:MOST_SHOWN]:
            output.say(f"left out: {file['file']} {file['why']}")
        if len(left_out) > MOST_SHOWN:
            output.say(f"left out: {len(left_out) - MOST_SHOWN} more files; --json lists all")
        output.say(
            ", ".join(f"{n} {what}" for what, n in counts.items())
            + ("; nothing was changed" if dry_run else "")
        )
        if outcome.bad and not dry_run:
            output.say(
                "what was refused is not in the archive: correct it and import again, or omit it by --only"
            )
        if counts["imported"]:
            output.say(f"next: sms job submit {then} --campaign {campaign}")
    if outcome.bad:
        raise typer.Exit(_FINDINGS)
