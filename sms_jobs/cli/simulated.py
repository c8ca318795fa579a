"""`sms campaign simulate` and `exact`: the experiments of the thesis on the virtual rig."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.specimens import experiments
from sms_jobs.app.specimens.experiments import EXPERIMENTS
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json
from sms_jobs.records.sizes import number_of


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
    with bootstrap.services(home) as services:
        made = experiments.simulate(services, experiment, name, small=small)
    facts = [
        {"campaign": campaign.name, "states": len(campaign.states), "views": list(campaign.views)}
        for campaign in made
    ]
    if as_json:
        # One campaign as it always was; several positions of the rig as a list of them.
        if len(facts) == 1:
            output.print_json(facts[0])
        else:
            output.print_json_list(facts)
        return
    for campaign in made:
        output.say(
            f"created campaign {campaign.name}: {number_of(len(campaign.states), 'state')}, "
            f"{', '.join(campaign.views)}; 'sms job submit simulate pipeline -c {campaign.name}' measures it"
        )


def exact(
    campaign: Annotated[str, typer.Argument(help="Name of a campaign on the virtual rig.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the files, one a state.")],
    step_px: Annotated[int, typer.Option(help="Distance of the nodes in the images, px.", min=1, max=64)] = 2,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there.")] = False,
    home: Home = None,
    as_json: Json = False,
) -> None:
    """Write the exact displacement of every state at the nodes of a mesh, as a calculation would give it.

    Example: sms campaign exact hat --out model; sms data compare-states hat --with 'model/{state}.vtu'
    """
    with bootstrap.services(home) as services:
        written = experiments.exact(services, campaign, out, step_px=step_px, force=force)
    if as_json:
        output.print_json_list(written)
        return
    for one in written:
        output.say(f"wrote {one.file}: {number_of(one.nodes, 'node')}")
