"""`sms acquire`: record states with the instruments of a rig."""

from __future__ import annotations

import time
from collections import Counter
from datetime import UTC, datetime
from typing import Annotated

import typer
from sqlalchemy.orm import Session

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.campaigns import campaign_row, definition
from sms_jobs.catalogue.models import JobRow
from sms_jobs.cli import completion, output, recorded_states
from sms_jobs.cli.output import Home, Json
from sms_jobs.cli.waiting import unsuccessful, wait_for
from sms_jobs.errors import Conflict, InvalidInput, JobFailed
from sms_jobs.instruments.holding import Hold, HoldDetector
from sms_jobs.jobs import inquiry, lifecycle, recordings
from sms_jobs.jobs.chosen import Chosen, named, submitted
from sms_jobs.jobs.planning import PIPELINE, Request
from sms_jobs.jobs.recordings import state_value
from sms_jobs.jobs.submission import Submission, submit_to
from sms_jobs.kinds.recording.acquire import KIND
from sms_jobs.records.campaign import Campaign, LoadState
from sms_jobs.records.job import JobState

app = typer.Typer(help="Recordings: states, with the instruments of a rig.", no_args_is_help=True)
app.command("show")(recorded_states.show)

_LOOK_EVERY_S = 0.2
_FINDINGS = 6

JobId = Annotated[
    str, typer.Argument(help="Job id, or the beginning of one.", autocompletion=completion.job_ids)
]


@app.command()
def run(
    campaign: Annotated[
        str, typer.Argument(help="Name of the campaign.", autocompletion=completion.campaign_names)
    ],
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
    ask: Annotated[
        bool, typer.Option("--ask", help="Ask an operator about a doubtful set instead of keeping it.")
    ] = False,
    process: Annotated[
        bool, typer.Option("--process", help="Process each state as soon as it is recorded.")
    ] = False,
    no_wait: Annotated[bool, typer.Option("--no-wait", help="Return at once.")] = False,
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
    needs an operator. Before a pose for which an artefact is placed by hand it waits for Enter.

    Example: sms acquire run wing-fatigue --state S03 --process

    Example: sms acquire run calibration-1 --missing

    Example: sms acquire run calibration-1 --dry-run
    """
    with bootstrap.services(home) as services:
        with services.catalogue.reading() as session:
            plan = definition(campaign_row(session, campaign))
            chosen = [plan.state(label) for label in state or ()] or list(plan.states)
            if missing:
                left = {s.label for s in recordings.unrecorded(session, campaign)}
                chosen = [s for s in chosen if s.label in left]
        if dry_run:
            _rehearse(services, plan, chosen, as_json)
            return
        turns = recordings.turns(chosen)
        if not turns:
            output.say(f"every state of {campaign} is recorded, or waits; see 'sms acquire list'")
            return
        by_hand = next((t.by_hand for t in turns if t.by_hand), "")
        if no_wait and by_hand:
            raise InvalidInput(f"somebody has to be there ({by_hand}): leave out --no-wait")
        # A session is adjusted as a whole, once all of its poses are there.
        at_once, at_the_end = (process and plan.session is None), (process and plan.session is not None)
        followed = _Followed(services, as_json)
        for turn in turns:
            if turn.by_hand:
                typer.prompt(f"{turn.by_hand}; Enter records it", default="", show_default=False, err=True)
            requests = _requests(turn.labels, ask, at_once)
            done = _submitted(services, campaign, requests)
            if not as_json:
                count = done.kinds.count(KIND.name)
                output.say(f"submitted {count} recordings" + (", each to be processed" if at_once else ""))
            if no_wait:
                if as_json:
                    output.print_json({"campaign": campaign, "jobs": done.job_ids})
                return
            if not followed.succeeded(submitted(done, KIND.name)):
                break
        followed.end()
        if at_the_end:
            done = _submitted(services, campaign, [Request(PIPELINE, {}, ())])
            if not as_json:
                output.say(f"submitted {len(done.job_ids)} jobs that calibrate from all poses")


def _rehearse(services: Services, plan: Campaign, states: list[LoadState], as_json: bool) -> None:
    # Here, because nothing else of these commands needs the instruments.
    from sms_jobs.cli.dry_run import show
    from sms_jobs.jobs import dry_runs

    rig, settings = services.stations.rig(plan.rig), services.settings
    with services.catalogue.reading() as session:
        done = dry_runs.dry_run(session, rig, plan, states, settings.spool_folder, services.archive)
    show(plan.name, done, as_json)
    if done.missing:
        raise typer.Exit(_FINDINGS)


def _submitted(services: Services, campaign: str, requests: list[Request]) -> Submission:
    return submit_to(services.catalogue, campaign, requests, datetime.now(UTC))


@app.command()
def follow(
    campaign: Annotated[
        str, typer.Argument(help="Name of the campaign.", autocompletion=completion.campaign_names)
    ],
    on: Annotated[
        str | None,
        typer.Option(help="Channel of the rig: a state is recorded when it holds the state's value."),
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="How near the channel must be, in its unit.", min=0.0)
    ] = None,
    hold: Annotated[float, typer.Option(help="Seconds that it must have stayed there.", min=0.0)] = 5.0,
    every: Annotated[
        float | None, typer.Option(help="Record the next state every so many seconds instead.", min=0.0)
    ] = None,
    key: Annotated[bool, typer.Option("--key", help="Record the next state at Enter instead.")] = False,
    ask: Annotated[
        bool, typer.Option("--ask", help="Ask an operator about a doubtful set instead of keeping it.")
    ] = False,
    process: Annotated[
        bool, typer.Option("--process", help="Process each state as soon as it is recorded.")
    ] = False,
    home: Home = None,
) -> None:
    """Follow a test: record one state after the other, each when its load is held, in time, or at a key.

    Run it on the host of the rig, beside 'sms up'. It ends after the last state; started again it goes on
    with the first that is not recorded. It stops when a recording needs an operator.

    Example: sms acquire follow wing-fatigue --on load_n --tolerance 3000 --hold 10 --process

    Example: sms acquire follow wing-fatigue --every 600
    """
    if [on is not None, every is not None, key].count(True) != 1:
        raise InvalidInput("say what to wait for: one of --on CHANNEL, --every SECONDS and --key")
    if on is not None and tolerance is None:
        raise InvalidInput(f"say with --tolerance how near {on} must be to a state's value, in its unit")
    with bootstrap.services(home) as services:
        due = time.monotonic()
        while True:
            with services.catalogue.reading() as session:
                state = recordings.next_state(session, campaign)
                rig = definition(campaign_row(session, campaign)).rig
            if state is None:
                output.say(f"every state of {campaign} is recorded, or waits; see 'sms acquire list'")
                return
            if on is not None and tolerance is not None:
                load = Hold(state_value(state, on), tolerance, hold)
                output.say(
                    f"{state.label}: waiting for {on} = {load.target:g} +- {tolerance:g} for {hold:g} s"
                )
                _wait_for_hold(services, rig, on, load)
            elif every is not None:
                output.say(f"{state.label}: in {max(0.0, due - time.monotonic()):.0f} s")
                time.sleep(max(0.0, due - time.monotonic()))
                due += every
            else:
                typer.prompt(f"{state.label}: Enter records it", default="", show_default=False, err=True)
            done = _submitted(services, campaign, _requests((state.label,), ask, process))
            _follow(services, submitted(done, KIND.name), as_json=False)


def _wait_for_hold(services: Services, rig: str, channel: str, hold: Hold) -> None:
    """Return when a channel holds its value; the instruments are let go before that."""
    from sms_jobs.instruments.connection import channel_reader

    detector = HoldDetector(hold)
    with channel_reader(services.stations.rig(rig), channel) as read:
        while not detector.held(time.monotonic(), read()):
            time.sleep(_LOOK_EVERY_S)


@app.command("list")
def list_(home: Home = None, as_json: Json = False) -> None:
    """Show the recordings that run, or wait for an operator.

    Example: sms acquire list
    """
    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        found = recordings.open_recordings(session, services.settings.spool_folder)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["job", "state of the campaign", "job is", "recorded", "because"],
        [(r.job_id[:8], r.subject, r.state.value, " ".join(r.finished), r.reason) for r in found],
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
        with services.catalogue.writing() as session:
            row = _recording(session, job)
            if retake and not recordings.forget_doubtful(services.stations.spool_of(row.id)):
                raise Conflict(f"job {row.id[:8]} has no doubtful set to record again; leave out --retake")
            lifecycle.retry(session, row.id, datetime.now(UTC))
            job_id = row.id
        _follow(services, named([job_id]), as_json)


@app.command()
def abort(
    job: Annotated[str | None, typer.Argument(help="Job id; all recordings if not given.")] = None,
    home: Home = None,
) -> None:
    """Stop recordings now: stages stand still, projectors go dark. Complete frames stay.

    Example: sms acquire abort
    """
    with bootstrap.services(home) as services, services.catalogue.writing() as session:
        if job is not None:
            ids = [_recording(session, job).id]
        else:
            found = recordings.open_recordings(session, services.settings.spool_folder)
            ids = [r.job_id for r in found if r.state in (JobState.QUEUED, JobState.RUNNING)]
        stopped = [i for i in ids if lifecycle.cancel(session, i, datetime.now(UTC))]
    if not stopped:
        raise Conflict("no recording runs; nothing was stopped")
    output.say(f"stopped {', '.join(i[:8] for i in stopped)}; 'sms acquire resume' goes on")


def _requests(states: tuple[str, ...], ask: bool, process: bool) -> list[Request]:
    recording = Request(KIND.name, {"doubtful": "ask" if ask else "keep"}, states)
    return [recording, Request(PIPELINE, {}, states)] if process else [recording]


def _recording(session: Session, prefix: str) -> JobRow:
    row = inquiry.find_job(session, prefix)
    if row.kind != KIND.name:
        raise InvalidInput(f"job {row.id[:8]} is no recording but a {row.kind}; see 'sms job retry'")
    return row


def _follow(services: Services, some: Chosen, as_json: bool) -> None:
    """Wait for recordings and say what became of them; raise `JobFailed` when one did not succeed."""
    followed = _Followed(services, as_json)
    followed.succeeded(some)
    followed.end()


class _Followed:
    """Recordings that are waited for, turn by turn; people are told of each turn, programs of all."""

    def __init__(self, services: Services, as_json: bool) -> None:
        self._services = services
        self._as_json = as_json
        self._turns: list[Chosen] = []
        self._counted: Counter[str] = Counter()

    def succeeded(self, some: Chosen) -> bool:
        """Wait for some recordings, and return whether all of them succeeded."""
        counted = wait_for(self._services.catalogue, some, None, workers=self._services.settings.workers)
        self._turns.append(some)
        self._counted += Counter(counted)
        if not self._as_json:
            output.print_table(
                ["recorded", "lit", "saturated", "modulation", "verdict"],
                [(v.subject, *_words(v.statistics)) for v in self._verdicts(some)],
                empty="nothing was recorded",
            )
        return not unsuccessful(counted)

    def end(self) -> None:
        """Tell programs what became of all; raise `JobFailed` when one did not succeed."""
        if self._as_json:
            recorded = [verdict for turn in self._turns for verdict in self._verdicts(turn)]
            output.print_json({"jobs": dict(self._counted), "recorded": recorded})
        failed = unsuccessful(self._counted)
        if failed:
            with self._services.catalogue.reading() as session:
                why = inquiry.failure(session, self._turns[-1])
            raise JobFailed(f"{failed} of {self._counted.total()} recordings did not succeed; {why}")

    def _verdicts(self, some: Chosen) -> list[recordings.PairVerdict]:
        with self._services.catalogue.reading() as session:
            return recordings.verdicts(session, some)


def _words(statistics: dict[str, float]) -> tuple[str, str, str, str]:
    again = int(statistics.get("recordings", 1.0)) - 1
    lost = int(statistics.get("retaken_frames", 0.0))
    notes = [
        "doubtful" if statistics.get("doubts") else "good",
        *([f"recorded {again} times again"] if again else []),
        *([f"{lost} frames taken again"] if lost else []),
    ]
    return (
        f"{statistics.get('lit_fraction', 0.0):.0%}",
        f"{statistics.get('saturated_fraction', 0.0):.1%}",
        f"{statistics.get('modulation', 0.0):.0%}",
        ", ".join(notes),
    )
