"""`sms campaign simulate`: the experiments of the thesis on the virtual rig."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app import writing
from sms_jobs.catalogue import campaigns
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
    found = experiment_campaigns(experiment, name or experiment, "small" if small else "full")
    with bootstrap.services(home) as services:
        for calibration, campaign in found:
            register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
    facts = [
        {"campaign": campaign.name, "states": len(campaign.states), "views": list(campaign.views)}
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
            f"created campaign {campaign.name}: {len(campaign.states)} states, {', '.join(campaign.views)}; "
            f"'sms job submit simulate pipeline -c {campaign.name}' measures it"
        )


def experiment_campaigns(experiment: str, name: str, size: Size) -> tuple[Made, ...]:
    """Return the campaigns of an experiment, each with its calibration."""
    # Other commands of this group load without the virtual rig.
    from sms_jobs.virtual_rig import campaigns as tests
    from sms_jobs.virtual_rig import wing_campaigns

    if experiment == "wing-panel":
        return wing_campaigns.wing_panel(name, size)
    return (
        {
            "top-hat-bending": tests.top_hat_bending,
            "hole-and-step": tests.hole_and_step_translation,
            "tension-panel": tests.tension_panel,
            "disbond-buckling": wing_campaigns.disbond_buckling,
            "plate-and-mirror": tests.plate_and_mirror,
        }[experiment](name, size),
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
    from sms_jobs.formats.other_fields import write_point_field
    from sms_jobs.virtual_rig.exact_meshes import exact_mesh

    with bootstrap.services(home) as services, services.catalogue.reading() as session:
        defined = campaigns.definition(campaigns.campaign_row(session, campaign))
    writing.new_folder(out)
    written = []
    for state in defined.states[1:]:
        path = out / f"{state.label}.vtu"
        writing.check_new_file(path, force)
        mesh = exact_mesh(defined, state.label, step_px)
        with writing.new_file(path, force) as part:
            write_point_field(part, mesh.nodes, mesh.triangles, mesh.displacement)
        written.append({"state": state.label, "file": str(path), "nodes": len(mesh.nodes)})
    if as_json:
        output.print_json_list(written)
        return
    for one in written:
        output.say(f"wrote {one['file']}: {one['nodes']} nodes")
