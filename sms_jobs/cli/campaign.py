"""`sms campaign`: tests, their states and how they are measured."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

from sms_jobs import bootstrap
from sms_jobs.app.specimens import campaigns
from sms_jobs.cli import completion, output, simulated, specimen_frame
from sms_jobs.cli.options import CampaignArgument
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput, NotFound
from sms_jobs.records.job import SHORT_ID
from sms_jobs.records.sizes import number_of
from sms_jobs.records.units import typed

app = typer.Typer(
    help="Campaigns: a specimen, its load states, and how they are measured.", no_args_is_help=True
)
app.command("simulate")(simulated.simulate)
app.command("exact")(simulated.exact)
app.command("frame")(specimen_frame.frame)


@app.command()
def create(
    plan: Annotated[Path | None, typer.Argument(help="Test plan (TOML, or XML).", show_default=False)] = None,
    example: Annotated[
        bool, typer.Option("--example", help="Print a plan to start from, and do nothing.")
    ] = False,
    example_stereo: Annotated[
        bool,
        typer.Option("--example-stereo", help="Print the plan of a test by two cameras, and do nothing."),
    ] = False,
    example_session: Annotated[
        bool,
        typer.Option("--example-session", help="Print the plan of a calibration session, and do nothing."),
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Create a campaign, or a calibration session, from its plan.

    Example: sms campaign create --example > plan.toml; sms campaign create plan.toml
    """
    if example or example_stereo or example_session:
        asked: Literal["fringes", "stereo", "session"] = "stereo" if example_stereo else "fringes"
        sys.stdout.write(campaigns.example("session" if example_session else asked))
        return
    if plan is None:
        raise InvalidInput(
            "give the file of a test plan; 'sms campaign create --example' prints one to start from"
        )
    with bootstrap.services(home) as services:
        campaign = campaigns.create(services, plan)
    if as_json:
        output.print_json(
            {"campaign": campaign.name, "states": len(campaign.states), "views": campaign.views}
        )
        return
    if campaign.scene is not None:
        following = f"sms job submit simulate --campaign {campaign.name}"
    elif not campaign.shows_fringes:
        following = f"sms import images FOLDER --campaign {campaign.name}, or sms acquire run {campaign.name}"
    else:
        following = f"sms acquire run {campaign.name} --dry-run"
    states, views = number_of(len(campaign.states), "state"), number_of(len(campaign.views), "view")
    output.say(f"campaign {campaign.name} has {states} and {views}; next: {following}")


@app.command("add-state")
def add_state(
    campaign: CampaignArgument,
    label: Annotated[str, typer.Argument(help="Of the new state, such as S12.")],
    load: Annotated[
        str | None, typer.Option(help="As it is planned, with its unit, such as 20kN.", show_default=False)
    ] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Give a campaign one more state behind its own, while its test goes on.

    What is recorded stays as it is, and so does the test plan that the campaign was made from.

    Example: sms campaign add-state wing-fatigue S12 --load 20kN
    """
    load_n = None if load is None else typed(load, "--load").in_unit("N", "--load")
    with bootstrap.services(home) as services:
        found = campaigns.add_state(services, campaign, label, load_n)
    if as_json:
        output.print_json({"campaign": campaign, "state": label, "states": len(found.states)})
    else:
        states = number_of(len(found.states), "state")
        output.say(f"campaign {campaign} has {states}; 'sms acquire plan' plans the new one")


@app.command("add-view")
def add_view(
    campaign: CampaignArgument,
    view: Annotated[str, typer.Argument(help="A camera with a projector or with others, or alone: C2P1.")],
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Let a campaign be measured by a camera or a projector more, while its test goes on.

    It sees the states that are still to be recorded, and those of which there are frames of it. Unless these
    are all, it measures shape and no displacement, since nobody knows what it would have seen at rest.

    Example: sms campaign add-view wing-fatigue C2P1
    """
    with bootstrap.services(home) as services:
        found = campaigns.add_view(services, campaign, view)
    unseen = found.unseen(view)
    if as_json:
        output.print_json({"campaign": campaign, "views": list(found.views), "unseen": list(unseen)})
        return
    output.say(f"campaign {campaign} is measured by {', '.join(found.views)}")
    if unseen:
        output.say(
            f"{view} has no frames of {', '.join(unseen)}: it measures shape from now on, and no "
            "displacement; bring these frames in and say this again where there are any"
        )


@app.command("list")
def list_(
    limit: Annotated[int, typer.Option(help="At most so many, the newest.", min=1, max=100_000)] = 50,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show campaigns, the newest first.

    Example: sms campaign list --limit 200
    """
    with bootstrap.services(home) as services:
        found = campaigns.list_campaigns(services, limit)
    if as_json:
        output.print_json_list(found.newest)
        return
    output.print_table(
        ["campaign", "specimen", "rig", "states", "views", "created", "jobs"],
        [
            (
                r.campaign,
                r.specimen,
                r.rig,
                r.states,
                r.views,
                r.created_at,
                ", ".join(f"{n} {s}" for s, n in r.jobs.items()),
            )
            for r in found.newest
        ],
        empty="there is no campaign yet; see 'sms campaign create --help'",
    )
    if found.total > len(found.newest):
        output.say(f"the newest {len(found.newest)} of {found.total} campaigns; --limit shows more")


@app.command()
def show(
    name: Annotated[str, typer.Argument(autocompletion=completion.campaign_names)],
    plan: Annotated[
        bool, typer.Option("--plan", help="Print the test plan that it was made from, letter by letter.")
    ] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show a campaign's states and views.

    Example: sms campaign show wing-fatigue; sms campaign show wing-fatigue --plan > again.toml
    """
    with bootstrap.services(home) as services:
        found = campaigns.show(services, name)
    if plan and not as_json:
        if found.plan is None:
            raise NotFound(f"campaign {name} was made by a program, not from a test plan")
        output.print_text(found.plan)
        return
    campaign = found.campaign
    if as_json:
        output.print_json(
            {
                "campaign": found.stored,
                "created_at": found.created_at,
                "plan": found.plan,
                "jobs": found.jobs,
            }
        )
        return
    sequence = campaign.sequence
    words = f"{sequence.in_words}, {number_of(sequence.frames, 'frame')}"
    fringes = {"fringes": words} if campaign.shows_fringes else {}
    output.print_facts(
        {
            "campaign": campaign.name,
            "specimen": campaign.specimen.name,
            "rig": campaign.rig + ("" if campaign.scene is None else " (virtual)"),
            "views": ", ".join(campaign.views),
            **fringes,
            "created": found.created_at,
            "jobs": ", ".join(f"{n} {s}" for s, n in found.jobs.items()),
        }
    )
    output.print_table(
        ["state", "load [N]", "displacement [mm]", "time", "channels"],
        [
            (
                s.label,
                s.known_load_n,
                s.known_displacement_mm,
                found.times.get(s.label),
                ", ".join(f"{k}={v:g}" for k, v in s.channels.items()),
            )
            for s in campaign.states
        ],
        empty="",
    )


@app.command()
def matrix(
    name: Annotated[str, typer.Argument(autocompletion=completion.campaign_names)],
    state: Annotated[
        list[str] | None,
        typer.Option("--state", "-s", help="Only of this state; can be repeated. Of all if not given."),
    ] = None,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Show what there is of each state, view and kind, whether it still holds, and why it does not.

    Example: sms campaign matrix wing-fatigue --json
    """
    # Which loads what jobs and files consist of.
    from sms_jobs.app.specimens import campaign_matrix

    with bootstrap.services(home) as services:
        found = campaign_matrix.matrix(services, name, state or ())
        found = campaign_matrix.in_order(found, campaigns.definition(services, name))
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["state", "view", "kind", "condition", "why", "file", "job"],
        [(c.state, c.view, c.kind, c.condition, c.why, c.file, (c.job or "")[:SHORT_ID]) for c in found],
        empty=f"nothing of {name} is measured or computed yet; see 'sms job submit --help'",
    )
