"""`sms campaign simulate`: the experiments of the thesis on the virtual rig."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput
from sms_jobs.jobs.registration import register_campaign

if TYPE_CHECKING:
    from sms_jobs.virtual_rig.campaigns import Made, Size

EXPERIMENTS: Mapping[str, str] = {
    "top-hat-bending": "a top hat of sheet metal pushed out at its middle, two cameras, two projectors "
    "(section 5.3)",
    "hole-and-step": "a plate with a hole and a step, moved in its plane (section 4.6)",
    "tension-panel": "a flat panel of 290 mm stretched by 500, 1000 and 2000 microstrain (section 6.2)",
    "wing-panel": "a wing panel of 660 mm in tension and compression, from three positions of the rig: three "
    "campaigns (section 6.2)",
    "disbond-buckling": "a stiffened panel in compression, whose stringer comes off the skin (section 6.3)",
    "plate-and-mirror": "a white plate that a mirror lights a second time (section 7.3.1)",
}


def simulate(
    experiment: Annotated[
        str | None,
        typer.Argument(
            help="What to simulate; all are listed if not given.",
            autocompletion=lambda incomplete: [name for name in EXPERIMENTS if name.startswith(incomplete)],
        ),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="Of the campaign; that of the experiment if not given.")
    ] = None,
    small: Annotated[
        bool, typer.Option("--small", help="Cameras of 512 x 512 px instead of 1024 x 1024 px.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Create an experiment of the thesis on the virtual rig, with its exact calibration.

    Example: sms campaign simulate tension-panel; sms job submit simulate pipeline -c tension-panel --wait
    """
    if experiment is None:
        listed = [{"experiment": key, "about": about} for key, about in EXPERIMENTS.items()]
        if as_json:
            output.print_json_list(listed)
        else:
            output.print_table(["experiment", "about"], [tuple(one.values()) for one in listed], empty="")
        return
    if experiment not in EXPERIMENTS:
        raise InvalidInput(f"there is no experiment '{experiment}'; choose among {', '.join(EXPERIMENTS)}")
    found = _made(experiment, name or experiment, "small" if small else "full")
    with bootstrap.services(home) as services:
        for calibration, campaign in found:
            register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
    facts = [
        {"campaign": campaign.name, "states": len(campaign.states), "pairs": list(campaign.pairs)}
        for _, campaign in found
    ]
    if as_json:
        # One campaign as it always was; several positions of the rig as a list of them.
        if len(facts) == 1:
            output.print_json(facts[0])
        else:
            output.print_json_list(facts)
        return
    for _, campaign in found:
        output.say(
            f"created campaign {campaign.name}: {len(campaign.states)} states, {', '.join(campaign.pairs)}; "
            f"'sms job submit simulate pipeline -c {campaign.name}' measures it"
        )


def _made(experiment: str, name: str, size: Size) -> tuple[Made, ...]:
    """Return the campaigns of an experiment, each with its calibration."""
    # Other commands of this group load without the virtual rig.
    from sms_jobs.virtual_rig import campaigns, wing_campaigns

    if experiment == "wing-panel":
        return wing_campaigns.wing_panel(name, size)
    return (
        {
            "top-hat-bending": campaigns.top_hat_bending,
            "hole-and-step": campaigns.hole_and_step_translation,
            "tension-panel": campaigns.tension_panel,
            "disbond-buckling": wing_campaigns.disbond_buckling,
            "plate-and-mirror": campaigns.plate_and_mirror,
        }[experiment](name, size),
    )
