"""`sms calibration accept` and `withdraw`: which calibrations are used, and what for."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.calibrating import calibrations
from sms_jobs.app.calibrating.calibrations import Decision
from sms_jobs.cli import completion, output
from sms_jobs.cli.asking import PasswordStdin, Reason, because, confirming
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.shown.files import CalibrationView, DecisionView

Number = Annotated[int, typer.Argument(help="Number of a calibration; see 'sms calibration list'.")]
Of = Annotated[
    str | None,
    typer.Option(
        "--campaign",
        "-c",
        help="Only for this campaign, in place of all calibrations of its rig.",
        autocompletion=completion.campaign_names,
    ),
]


def accept(
    number: Number,
    campaign: Of = None,
    reason: Reason = None,
    password_stdin: PasswordStdin = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Take a calibration into use that came from elsewhere.

    What is imported for a rig that has a calibration, or comes with a packed folder, changes nothing before
    it is accepted here. Then measurements of the rig from its time on are computed with it, but for those of
    campaigns that have calibrations of their own. Results that were computed with another one show as stale
    in 'sms job explain', and are computed again when they are submitted. Whoever has a password here is asked
    for it.

    Example: sms calibration accept 3; sms calibration accept 4 --campaign wing-fatigue
    """
    done = _decided(number, campaign, reason, password_stdin, home, in_use=True)
    _tell(done, campaign, as_json, in_use=True)


def withdraw(
    number: Number,
    campaign: Of = None,
    reason: Reason = None,
    password_stdin: PasswordStdin = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Use a calibration no longer; it stays in the archive, with all that was computed with it.

    Whoever has a password here is asked for it.

    Example: sms calibration withdraw 3
    """
    done = _decided(number, campaign, reason, password_stdin, home, in_use=False)
    _tell(done, campaign, as_json, in_use=False)


def _decided(
    number: int,
    campaign: str | None,
    reason: str | None,
    password_stdin: bool,
    home: Path | None,
    *,
    in_use: bool,
) -> Decision:
    with bootstrap.services(home) as services:
        return confirming(
            because(services, reason),
            password_stdin,
            lambda who: calibrations.decide(who, number, campaign, in_use=in_use),
        )


def _tell(done: Decision, campaign: str | None, as_json: bool, *, in_use: bool) -> None:
    view = done.calibration
    if as_json:
        output.print_json({"calibration": view.id, "campaign": campaign, "in_use": in_use, "new": done.new})
        return
    whom = f"rig {view.rig}" if campaign is None else f"campaign {campaign} alone"
    said = f"is used for {whom}{since(view.valid_from)}" if in_use else f"is not used for {whom}"
    output.say(f"calibration {view.id} {said}" + ("" if done.new else ", as before"))


def since(valid_from: datetime | None) -> str:
    """Say from when on a calibration is valid; nothing where nobody knows."""
    return "" if valid_from is None else f" from {output.shown(valid_from)} on"


def in_words(one: DecisionView) -> tuple[str, str]:
    """Say in words what was decided about a calibration: for whom, and by whom."""
    whom = f"campaign {one.campaign}" if one.campaign else "its rig"
    who = "".join((f" by {one.by}" if one.by else "", f": {one.reason}" if one.reason else ""))
    done = "accepted" if one.in_use else "withdrawn"
    return f"{done} for {whom}", f"{output.shown(one.at)}{who}"


def used_for(view: CalibrationView) -> str:
    """Say in words what a calibration is used for."""
    if view.in_use:
        return ", ".join(["its rig", *view.campaigns])
    return ", ".join(view.campaigns) or "nothing: inactive"


def tell_inactive(views: Iterable[CalibrationView]) -> None:
    """Name the calibrations that nothing is computed with, and say how one is taken into use."""
    numbers = [view.id for view in views if view.inactive]
    if numbers:
        many = len(numbers) > 1
        output.say(
            f"calibration{'s' * many} {', '.join(map(str, numbers))} {'are' if many else 'is'} inactive; "
            f"'sms calibration accept {numbers[0]}' takes {'the first' if many else 'it'} into use"
        )
