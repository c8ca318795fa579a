"""`sms calibration accept` and `withdraw`: which calibrations are used, and what for."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.calibrating import calibrations
from sms_jobs.cli import completion, output
from sms_jobs.cli.asking import Reason, because
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.shown.files import CalibrationView

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
    number: Number, campaign: Of = None, reason: Reason = None, home: Home = None, as_json: Json = False
) -> None:
    """Take a calibration into use that came from elsewhere.

    What is imported for a rig that has a calibration, or comes with a packed folder, changes nothing before
    it is accepted here. Then measurements of the rig from its time on are computed with it, but for those of
    campaigns that have calibrations of their own. Results that were computed with another one show as stale
    in 'sms job explain', and are computed again when they are submitted.

    Example: sms calibration accept 3; sms calibration accept 4 --campaign wing-fatigue
    """
    _decide(number, campaign, reason, home, as_json, in_use=True)


def withdraw(
    number: Number, campaign: Of = None, reason: Reason = None, home: Home = None, as_json: Json = False
) -> None:
    """Use a calibration no longer; it stays in the archive, with all that was computed with it.

    Example: sms calibration withdraw 3
    """
    _decide(number, campaign, reason, home, as_json, in_use=False)


def _decide(
    number: int, campaign: str | None, reason: str | None, home: Path | None, as_json: bool, *, in_use: bool
) -> None:
    with bootstrap.services(home) as services:
        done = calibrations.decide(because(services, reason), number, campaign, in_use=in_use)
    if as_json:
        output.print_json({"calibration": number, "campaign": campaign, "in_use": in_use, "new": done.new})
        return
    view = done.calibration
    whom = f"rig {view.rig}" if campaign is None else f"campaign {campaign} alone"
    if in_use:
        said = f"is used for {whom} from {output.shown(view.valid_from)} on"
    else:
        said = f"is not used for {whom}"
    output.say(f"calibration {number} {said}" + ("" if done.new else ", as before"))


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
