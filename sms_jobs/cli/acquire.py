"""`sms acquire`: record states with the instruments of a rig."""

from __future__ import annotations

from collections import Counter
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.measuring import recordings
from sms_jobs.app.measuring.recordings import Plan, Recorded, Started
from sms_jobs.bootstrap import Services
from sms_jobs.cli import completion, output, planned_recordings, recorded_states, streams, waiting
from sms_jobs.cli import dry_run as dry_run_
from sms_jobs.cli.options import CampaignArgument, JobId, NoWait
from sms_jobs.cli.output import Home, Json
from sms_jobs.cli.planned_recordings import Ask, Process
from sms_jobs.errors import InvalidInput, JobFailed
from sms_jobs.records.job import SHORT_ID
from sms_jobs.records.sizes import number_of
from sms_jobs.records.statistic_names import (
    DOUBTS,
    LIT_FRACTION,
    MODULATION,
    RECORDINGS,
    RETAKEN_FRAMES,
    SATURATED_FRACTION,
)

app = typer.Typer(help="Recordings: states, with the instruments of a rig.", no_args_is_help=True)
app.command("show")(recorded_states.show)
app.command("stream")(streams.stream)
app.add_typer(planned_recordings.app, name="plan")

_FINDINGS = 6


@app.command()
def run(
    campaign: CampaignArgument,
    state: Annotated[
        list[str] | None,
        typer.Option(
            "--state",
            "-s",
            help="This state; can be repeated. All if not given.",
            autocompletion=completion.state_labels,
        ),
    ] = None,
    missing: Annotated[
        bool, typer.Option("--missing", help="Of these only the states that are not recorded yet.")
    ] = False,
    key: Annotated[bool, typer.Option("--key", help="Wait for Enter before each state.")] = False,
    ask: Ask = False,
    process: Process = False,
    no_wait: NoWait = False,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run",
            help="Record nothing; show how long it would take, what volume of data it makes, and what is "
            "missing for it. Exit code 6 when something is.",
        ),
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Record states, every view, and say whether the recordings can be used.

    They are recorded where the rig is connected, see 'sms rig', one after the other. Exit code 5 when one
    needs an operator. Before a pose for which an artefact is placed by hand it waits for Enter. To record
    at loads or in time, see 'sms acquire plan'.

    Example: sms acquire run wing-fatigue --state S03 --process

    Example: sms acquire run wing-fatigue --missing --key

    Example: sms acquire run calibration-1 --missing

    Example: sms acquire run calibration-1 --dry-run
    """
    with bootstrap.services(home) as services:
        plan = recordings.plan(services, campaign, state or (), missing=missing)
        if dry_run:
            _rehearse(services, plan, as_json)
            return
        turns, session = plan.turns(at_key=key), plan.campaign.session
        if not turns:
            output.say(f"every state of {campaign} is recorded, or waits; see 'sms acquire list'")
            return
        by_hand = next((t.by_hand for t in turns if t.by_hand), "")
        # Before anybody is asked to place something.
        recordings.refuse_lacking(plan.lacking)
        if no_wait and by_hand:
            raise InvalidInput(f"somebody has to be there ({by_hand}): leave out --no-wait")
        # A session is adjusted as a whole, once all of its poses are there.
        at_once, at_the_end = (process and session is None), (process and session is not None)
        followed = _Followed(as_json)
        for turn in turns:
            if turn.by_hand:
                typer.prompt(f"{turn.by_hand}; Enter records it", default="", show_default=False, err=True)
            begun = recordings.record(services, campaign, turn.labels, ask=ask, process=at_once)
            if not as_json:
                said = ", each to be processed" if at_once else ""
                output.say(f"submitted {number_of(begun.recordings, 'recording')}{said}")
            if no_wait:
                if as_json:
                    output.print_json({"campaign": campaign, "jobs": begun.job_ids})
                return
            if not followed.succeeded(services, begun):
                break
        followed.end()
        if at_the_end:
            count = recordings.process(services, campaign)
            if not as_json:
                output.say(f"submitted {number_of(count, 'job')} to calibrate from all poses")


def _rehearse(services: Services, plan: Plan, as_json: bool) -> None:
    done = recordings.rehearse(services, plan)
    dry_run_.show(plan.campaign.name, done, as_json)
    if done.missing:
        raise typer.Exit(_FINDINGS)


@app.command("list")
def list_(home: Home = None, as_json: Json = False) -> None:
    """Show the recordings that run, or wait for an operator.

    Example: sms acquire list
    """
    with bootstrap.services(home) as services:
        found = recordings.open_recordings(services)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["job", "state of the campaign", "job is", "host", "recorded", "because"],
        [
            (
                r.job_id[:SHORT_ID],
                r.subject,
                r.state.value,
                r.host,
                " ".join(r.finished) if r.here or not r.host else f"see {r.host}",
                r.reason,
            )
            for r in found
        ],
        empty="no recording runs or waits",
    )


@app.command()
def resume(
    job: JobId,
    retake: Annotated[
        bool, typer.Option("--retake", help="Record the doubtful sets again; their frames are kept too.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Go on with a recording that was interrupted: what is there is kept, the rest is recorded.

    Run it on the host of the rig, after a look at the rig and at the load.

    Example: sms acquire resume 3f2a --retake
    """
    with bootstrap.services(home) as services:
        _follow(services, recordings.resume(services, job, retake=retake), as_json)


@app.command()
def abort(
    job: Annotated[str | None, typer.Argument(help="Job id; all recordings if not given.")] = None,
    home: Home = None,
) -> None:
    """Stop recordings now: stages stand still, projectors go dark. Complete frames stay.

    Example: sms acquire abort
    """
    with bootstrap.services(home) as services:
        stopped = recordings.abort(services, job)
    output.say(f"stopped {', '.join(i[:SHORT_ID] for i in stopped)}; 'sms acquire resume' goes on")


def _follow(services: Services, begun: Started, as_json: bool) -> None:
    """Wait for recordings and say what became of them; raise `JobFailed` when one did not succeed."""
    followed = _Followed(as_json)
    followed.succeeded(services, begun)
    followed.end()


class _Followed:
    """Recordings that are waited for, turn by turn; people see each turn, programs all at the end."""

    def __init__(self, as_json: bool) -> None:
        self._as_json = as_json
        self._turns: list[Recorded] = []

    def succeeded(self, services: Services, begun: Started) -> bool:
        """Wait for some recordings, and return whether all of them succeeded."""
        with waiting.followed(stop="sms acquire abort") as tell:
            recorded = recordings.wait_for_recordings(services, begun, tell)
        self._turns.append(recorded)
        if not self._as_json:
            output.print_table(
                ["recorded", "lit", "saturated", "modulation or contrast", "verdict"],
                [(v.subject, *_words(v.statistics)) for v in recorded.verdicts],
                empty="nothing was recorded",
            )
            waiting.tell_remarks(recorded.waited.remarks)
        return not recorded.waited.failures

    def end(self) -> None:
        """Tell programs what became of all; raise `JobFailed` when one did not succeed."""
        counted = sum((Counter(turn.waited.counted) for turn in self._turns), Counter[str]())
        if self._as_json:
            recorded = [verdict for turn in self._turns for verdict in turn.verdicts]
            remarks = [one for turn in self._turns for one in turn.waited.remarks]
            told = {"jobs": dict(counted), "recorded": recorded}
            output.print_json(told | waiting.remarks_as_json(remarks))
        failed = sum(turn.waited.failures for turn in self._turns)
        if failed:
            why = self._turns[-1].waited.failure
            raise JobFailed(f"{failed} of {number_of(counted.total(), 'recording')} did not succeed; {why}")


def _words(statistics: dict[str, float]) -> tuple[str, str, str, str]:
    again = int(statistics.get(RECORDINGS, 1.0)) - 1
    lost = int(statistics.get(RETAKEN_FRAMES, 0.0))
    notes = [
        "doubtful" if statistics.get(DOUBTS) else "good",
        *([f"recorded {number_of(again, 'time')} again"] if again else []),
        *([f"{number_of(lost, 'frame')} taken again"] if lost else []),
    ]
    return (
        f"{statistics.get(LIT_FRACTION, 0.0):.0%}",
        f"{statistics.get(SATURATED_FRACTION, 0.0):.1%}",
        f"{statistics.get(MODULATION, 0.0):.0%}",
        ", ".join(notes),
    )
