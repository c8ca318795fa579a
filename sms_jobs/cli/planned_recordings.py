"""`sms acquire plan`: which state of a test is recorded next, and when, whether or not somebody is there."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from typing import Annotated, Any, ClassVar

import typer
from typer.core import TyperGroup

from sms_jobs import bootstrap
from sms_jobs.app.measuring import planned_recordings, quick_looks
from sms_jobs.app.measuring.planned_recordings import AtCycles, AtLevels, AtLoad, InTime, When
from sms_jobs.cli import completion, output
from sms_jobs.cli.options import CampaignArgument
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.records.gauge_limits import Look, gauge_limit
from sms_jobs.records.shown.planned_recordings import PlannedRecording
from sms_jobs.records.shown.quick_looks import GaugeLook, QuickLookView
from sms_jobs.records.subject import Subject
from sms_jobs.records.units import duration_s, time_words, typed

_LONGEST_S = 30 * 86400.0
_HOLD = "5s"
_LONGEST_HOLD_S = 86400.0
_COUNTER = "cycles"
_DIGITS = 15
_EVERY_S = 1.0
_LOOK_COLUMNS = ("quick look at", "is", "lit part", "gauges", "doubts")


class _PlanOrCommand(TyperGroup):
    """A group whose first word may be a campaign, of which recordings are planned then."""

    otherwise: ClassVar[str] = "add"
    """The command that is meant where the first word is none."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Put the command that is meant before a word that is none."""
        if args and args[0] not in self.commands:
            args = [self.otherwise, *args]
        return super().resolve_command(ctx, args)


app = typer.Typer(
    cls=_PlanOrCommand,
    help="Plans of recordings: what is recorded next, and when, with 'sms up' alone.",
    no_args_is_help=True,
)

Ask = Annotated[
    bool, typer.Option("--ask", help="Ask an operator about a doubtful set instead of keeping it.")
]
StopIf = Annotated[
    list[str] | None,
    typer.Option(
        "--stop-if",
        help="Hold the plan where the quick look at a state finds this, such as 'g1.extension_mm > 0.5mm'; "
        "can be repeated. --look is not needed then.",
    ),
]
Process = Annotated[bool, typer.Option("--process", help="Process each state as soon as it is recorded.")]
States = Annotated[
    list[str] | None,
    typer.Argument(help="Labels of states.", autocompletion=completion.state_labels, show_default=False),
]


@app.command()
def add(
    campaign: CampaignArgument,
    on: Annotated[
        str | None,
        typer.Option(
            help="Channel of the rig: a state is recorded when it holds the state's value. With --at-cycles "
            "the channel that counts, 'cycles' if not given."
        ),
    ] = None,
    tolerance: Annotated[
        str | None, typer.Option(help="How near the channel must be, with its unit, such as 500N.")
    ] = None,
    each: Annotated[
        str | None,
        typer.Option(
            help="Add a state at each multiple of this, such as 10kN, that the channel of --on stays near, "
            "and record it there."
        ),
    ] = None,
    hold: Annotated[
        str | None,
        typer.Option(
            help="How long it must have stayed there, or have stood still, such as 10s; 5s if not given."
        ),
    ] = None,
    at_cycles: Annotated[
        str | None,
        typer.Option(help="Record a state at each of these numbers of cycles, such as 1000,2000,5000."),
    ] = None,
    every: Annotated[
        str | None, typer.Option(help="Record a state every 30s, 15min or 2h; the first at once.")
    ] = None,
    next_: Annotated[
        bool, typer.Option("--next", help="Record each state as soon as the one before it is recorded.")
    ] = False,
    state: Annotated[
        list[str] | None,
        typer.Option(
            "--state",
            "-s",
            help="This state; can be repeated. All that are not recorded, planned or skipped if not given.",
            autocompletion=completion.state_labels,
        ),
    ] = None,
    ask: Ask = False,
    process: Process = False,
    look: Annotated[
        bool, typer.Option("--look", help="Take a quick look at each state, seconds after it is recorded.")
    ] = False,
    stop_if: StopIf = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Plan recordings of a campaign; 'sms acquire plan CAMPAIGN ...' is the same.

    The service ('sms up') on the host of the rig makes them, one after the other, whether or not anybody is
    logged in. Of a state that is planned already it changes what is waited for. With --each the campaign is
    given its states while the test goes on, behind those that are planned, until 'sms acquire plan drop'.

    Example: sms acquire plan wing-fatigue --on load_n --tolerance 500N --hold 10s

    Example: sms acquire plan wing-fatigue --on load_n --each 10kN --tolerance 200N --hold 10s

    Example: sms acquire plan wing-fatigue --at-cycles 1000,2000,5000

    Example: sms acquire plan wing-fatigue --every 15min --process

    Example: sms acquire plan wing-fatigue --state S07 --next

    Example: sms acquire plan wing-fatigue --next --stop-if 'g1.extension_mm > 0.5mm'
    """
    when = _when(on, tolerance, hold, at_cycles, every, next_, each)
    limits = tuple(gauge_limit(text, "--stop-if") for text in stop_if or ())
    with bootstrap.services(home) as services:
        found = planned_recordings.plan(
            services,
            campaign,
            when,
            tuple(state or ()),
            ask=ask,
            process=process,
            look=Look(look or bool(limits), limits),
        )
    if isinstance(when, AtLevels) and not as_json:
        output.print_sentence(_levels_sentence(campaign, when, found))
    _tell(found, as_json)


def _levels_sentence(campaign: str, when: AtLevels, found: list[PlannedRecording]) -> str:
    """Say what a plan with levels does from now on."""
    near = f"each multiple of {when.each.number:g} {when.each.unit}".rstrip()
    stays = f" for {time_words(when.for_s)}" if when.for_s else ""
    label = next(one.state for one in found if one.is_added)
    return f"{campaign}: a new state at {near} at which {when.channel} stays{stays}; the next is {label}"


def _when(
    on: str | None,
    tolerance: str | None,
    hold: str | None,
    at_cycles: str | None,
    every: str | None,
    in_turn: bool,
    each: str | None,
) -> When:
    """Return what is waited for; raise `InvalidInput` unless it is one thing, with all that it needs."""
    at_load = on is not None and at_cycles is None
    if [at_load, at_cycles is not None, every is not None, in_turn].count(True) != 1:
        raise InvalidInput(
            "say what to wait for: one of --on CHANNEL, --at-cycles NUMBERS, --every TIME and --next"
        )
    if each is not None and not at_load:
        raise InvalidInput("--each goes with --on CHANNEL, and without --at-cycles; leave it out")
    if at_load is (tolerance is None):
        raise InvalidInput(
            f"say with --tolerance how near {on} must be to a state's value, such as 500N"
            if at_load
            else "--tolerance goes with --on CHANNEL; leave it out"
        )
    if hold is not None and (every is not None or in_turn):
        raise InvalidInput("--hold goes with --on and --at-cycles; leave it out")
    for_s = duration_s(hold or _HOLD, "--hold", 0.0, _LONGEST_HOLD_S)
    if at_cycles is not None:
        return AtCycles(_counts(at_cycles), on or _COUNTER, for_s)
    if on is not None and tolerance is not None and each is not None:
        return AtLevels(on, typed(each, "--each"), typed(tolerance, "--tolerance"), for_s)
    if on is not None and tolerance is not None:
        return AtLoad(on, typed(tolerance, "--tolerance"), for_s)
    return InTime(None if every is None else duration_s(every, "--every", 1.0, _LONGEST_S))


def _counts(text: str) -> tuple[int, ...]:
    """Return numbers of cycles, each greater than the one before; `InvalidInput` for anything else."""
    words = [word.strip() for word in text.split(",")]
    if not all(word.isascii() and word.isdigit() and len(word) <= _DIGITS for word in words):
        raise InvalidInput(
            f"--at-cycles is '{text}', and should be whole numbers with commas between, such as 1000,2000"
        )
    counts = tuple(map(int, words))
    if any(later <= earlier for earlier, later in pairwise(counts)):
        raise InvalidInput(f"--at-cycles is '{text}', and each number should exceed the one before")
    return counts


@app.command()
def show(
    campaign: Annotated[
        str | None,
        typer.Argument(help="Name of the campaign; all with something left to record if not given."),
    ] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show what is recorded next and what it waits for, and what comes after it.

    Example: sms acquire plan show wing-fatigue
    """
    with bootstrap.services(home) as services:
        found = planned_recordings.show(services, campaign)
        seen = [look for name in _campaigns(found) for look in quick_looks.show(services, name)]
    _tell(found, as_json)
    if seen and not as_json:
        output.print_table(_LOOK_COLUMNS, map(_look_row, seen), empty="")


@app.command()
def looks(campaign: CampaignArgument, home: Home = None, as_json: Json = False) -> None:
    """Show what quick looks have found: shape, gauges in mm with standard deviations, and what is doubted.

    Example: sms acquire plan looks wing-fatigue
    """
    with bootstrap.services(home) as services:
        found = quick_looks.show(services, campaign)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        _LOOK_COLUMNS, map(_look_row, found), empty="there is no quick look; see 'sms acquire plan --help'"
    )


@app.command()
def watch(campaign: CampaignArgument, home: Home = None) -> None:
    """Tell what happens to a plan until it has ended, or until Ctrl-C; the bell rings when it is stopped.

    Example: sms acquire plan watch wing-fatigue
    """
    told: dict[str, str] = {}

    def tell(about: str, words: str) -> bool:
        is_new = told.get(about) != words
        told[about] = words
        if is_new and words:
            output.print_sentence(words)
        return is_new and bool(words)

    with bootstrap.services(home) as services, suppress(KeyboardInterrupt):
        while True:
            found, seen = planned_recordings.show(services, campaign), quick_looks.show(services, campaign)
            for look in seen:
                tell(look.job_id, "" if _is_coming(look) else _look_sentence(look))
            for one in found:
                if one.is_next:
                    tell("next", f"{Subject(campaign, one.state)} is next: {one.unless_read}")
                stopped = f"{campaign} is held: {one.stopped_by}" if one.stopped_by else ""
                if tell(one.state, stopped):
                    output.answer().bell()
            if not any(one.is_next for one in found) and not any(map(_is_coming, seen)):
                return
            time.sleep(_EVERY_S)


def _is_coming(look: QuickLookView) -> bool:
    return look.looked_at is None and not look.doubts


def _campaigns(found: list[PlannedRecording]) -> list[str]:
    return list(dict.fromkeys(one.campaign for one in found))


def _look_sentence(look: QuickLookView) -> str:
    about, *cells = _look_row(look)
    return "; ".join([f"quick look at {about}", *(str(cell) for cell in cells if cell)])


def _look_row(look: QuickLookView) -> tuple[str, ...]:
    shape = "" if look.valid_fraction is None else f"shape of {look.valid_fraction:.0%}"
    read = [_gauge_words(gauge) for gauge in look.gauges]
    if look.gauges_lost:
        read.append(f"{look.gauges_lost} without a value")
    about = str(Subject(look.campaign, look.state, look.view))
    return about, look.status, shape, "; ".join(read), look.doubts


def _gauge_words(gauge: GaugeLook) -> str:
    moved = ", ".join(f"{value:.3f}" for value in (gauge.x_mm, gauge.y_mm, gauge.z_mm))
    longer = f"{gauge.extension_mm:+.3f} +- {gauge.extension_sigma_mm:.3f}"
    return f"{gauge.name} longer by {longer}, moved by {moved} mm"


@app.command()
def hold(campaign: CampaignArgument, states: States = None, home: Home = None) -> None:
    """Hold the plan back, or some of its states; those behind them wait, too. What is being recorded goes on.

    Example: sms acquire plan hold wing-fatigue
    """
    with bootstrap.services(home) as services:
        held = planned_recordings.hold(services, campaign, tuple(states or ()))
    output.say(f"held back: {_listed(held)}; 'sms acquire plan go {campaign}' lets them go on")


@app.command()
def go(campaign: CampaignArgument, states: States = None, home: Home = None) -> None:
    """Let what was held back go on.

    Example: sms acquire plan go wing-fatigue
    """
    with bootstrap.services(home) as services:
        going = planned_recordings.go(services, campaign, tuple(states or ()))
    output.say(f"goes on: {_listed(going)}")


@app.command()
def skip(campaign: CampaignArgument, states: States = None, home: Home = None) -> None:
    """Leave states out of the plan, the next one if none is named; the plan goes on with the one behind.

    Example: sms acquire plan skip wing-fatigue S05
    """
    with bootstrap.services(home) as services:
        skipped = planned_recordings.skip(services, campaign, tuple(states or ()))
    output.say(f"skipped: {_listed(skipped)}")


@app.command()
def move(
    campaign: CampaignArgument,
    state: Annotated[
        str,
        typer.Argument(help="The state that is moved.", autocompletion=completion.state_labels),
    ],
    before: Annotated[
        str | None,
        typer.Option(help="It comes before this state.", autocompletion=completion.state_labels),
    ] = None,
    last: Annotated[bool, typer.Option("--last", help="It comes last.")] = False,
    home: Home = None,
) -> None:
    """Let a planned state come before another one, or last.

    Example: sms acquire plan move wing-fatigue S09 --before S04
    """
    if (before is not None) is last:
        raise InvalidInput("say where it is to come: one of --before STATE and --last")
    with bootstrap.services(home) as services:
        planned_recordings.move(services, campaign, state, before)
    output.say(f"{state} comes {'last' if before is None else f'before {before}'}")


@app.command()
def drop(campaign: CampaignArgument, states: States = None, home: Home = None) -> None:
    """Forget the plan of a campaign, or some of its states. What was recorded stays, and what runs goes on.

    Example: sms acquire plan drop wing-fatigue
    """
    with bootstrap.services(home) as services:
        done = planned_recordings.drop(services, campaign, tuple(states or ()))
    output.say(f"forgotten: {_listed(done.forgotten)}")
    if done.recorded:
        output.say(f"recorded, and stays: {_listed(done.recorded)}")
    if done.running:
        output.say(f"being recorded, and goes on: {_listed(done.running)}")


def _listed(states: Sequence[str]) -> str:
    return ", ".join(states) or "nothing"


def _tell(found: list[PlannedRecording], as_json: bool) -> None:
    if as_json:
        output.print_json_list(found)
        return
    for one in found:
        if one.is_next:
            output.print_sentence(f"{Subject(one.campaign, one.state)} is next: {one.waits_for}")
    output.print_table(
        ["campaign", "state", "waits for", "is", "due", "note"],
        [(r.campaign, r.state, r.trigger, r.status, r.due_at, r.note) for r in found],
        empty="nothing is planned; see 'sms acquire plan --help'",
    )
