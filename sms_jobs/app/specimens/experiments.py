"""The experiments of the thesis on the virtual rig."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from sms_jobs.app import writing
from sms_jobs.app.rules import use_case
from sms_jobs.app.specimens import campaigns
from sms_jobs.bootstrap import Services
from sms_jobs.errors import InvalidInput
from sms_jobs.records.people import Right

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign
    from sms_jobs.virtual_rig.campaigns import Made, Size

EXPERIMENTS: Mapping[str, str] = {
    "top-hat-bending": "a top hat of sheet metal pushed out at its middle, two cameras, two projectors "
    "(section 5.3)",
    "hole-and-step": "a plate with a hole and a step, moved in its plane (section 4.6)",
    "tension-panel": "a flat panel of 290 mm stretched by 500, 1000 and 2000 microstrain (section 6.2)",
    "wing-panel": "a wing panel of 660 mm in tension and compression, from three positions of the rig: three "
    "campaigns (section 6.2)",
    "cracked-wing-panel": "the same at nine loads, a stringer behind it cracking on: three campaigns "
    "(section 6.2)",
    "disbond-buckling": "a stiffened panel in compression, whose stringer comes off the skin (section 6.3)",
    "buckling-panel": "the same at seven loads, with bolts, sensors, and a tie rod before it (section 6.3)",
    "plate-and-mirror": "a white plate that a mirror lights a second time (section 7.3.1)",
}


@use_case(Right.READ)
def list_experiments(_services: Services) -> dict[str, str]:
    """Return what each experiment is about, by its name."""
    return dict(EXPERIMENTS)


@use_case(Right.COMPUTE)
def simulate(services: Services, experiment: str, name: str | None, *, small: bool = False) -> list[Campaign]:
    """Create an experiment with its exact calibration: a campaign, or one for each position of the rig.

    Parameters
    ----------
    name
        Of the campaign; that of the experiment if it is None.
    small
        Cameras of 512 x 512 px instead of 1024 x 1024 px.

    Raises
    ------
    InvalidInput
        There is no such experiment.
    Conflict
        There is a campaign of that name.
    """
    from sms_jobs.jobs.archiving.registration import register_campaign

    if experiment not in EXPERIMENTS:
        raise InvalidInput(f"there is no experiment '{experiment}'; choose among {', '.join(EXPERIMENTS)}")
    made = experiment_campaigns(experiment, name or experiment, "small" if small else "full")
    for calibration, campaign in made:
        register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
    return [campaign for _, campaign in made]


def experiment_campaigns(experiment: str, name: str, size: Size) -> tuple[Made, ...]:
    """Return the campaigns of an experiment, each with its calibration."""
    # Whoever only lists the experiments does without the virtual rig.
    from sms_jobs.virtual_rig import campaigns as tests
    from sms_jobs.virtual_rig import wing_campaigns

    if experiment == "wing-panel":
        return wing_campaigns.wing_panel(name, size)
    if experiment == "cracked-wing-panel":
        return wing_campaigns.cracked_wing_panel(name, size)
    return (
        {
            "top-hat-bending": tests.top_hat_bending,
            "hole-and-step": tests.hole_and_step_translation,
            "tension-panel": tests.tension_panel,
            "disbond-buckling": wing_campaigns.disbond_buckling,
            "buckling-panel": wing_campaigns.buckling_panel,
            "plate-and-mirror": tests.plate_and_mirror,
        }[experiment](name, size),
    )


@dataclass(frozen=True)
class ExactState:
    """The file of the exact displacement of a state, at so many nodes."""

    state: str
    file: str
    nodes: int


@use_case(Right.READ)
def exact(
    services: Services, campaign: str, folder: Path, *, step_px: int = 2, force: bool = False
) -> list[ExactState]:
    """Write the exact displacement of every state but the first at the nodes of a mesh.

    Parameters
    ----------
    folder
        Made where it is not there; a file for each state.
    step_px
        Distance of the nodes in the images.
    force
        Whether files that are there are replaced.

    Raises
    ------
    NotFound
        There is no such campaign.
    InvalidInput
        It is not on the virtual rig, or is a calibration session.
    Conflict
        A file is there.
    """
    from sms_jobs.formats.other_fields import write_point_field
    from sms_jobs.virtual_rig.exact_meshes import exact_mesh

    defined = campaigns.definition(services, campaign)
    if defined.session is not None:
        raise InvalidInput(
            f"{campaign} is a calibration session: an artefact is put before the rig anew in each of its "
            "states, and is displaced in none; name a campaign of a specimen"
        )
    writing.new_folder(folder)
    written = []
    for state in defined.states[1:]:
        path = folder / f"{state.label}.vtu"
        writing.check_new_file(path, force)
        mesh = exact_mesh(defined, state.label, step_px)
        with writing.new_file(path, force) as part:
            write_point_field(part, mesh.nodes, mesh.triangles, mesh.displacement)
        written.append(ExactState(state.label, str(path), len(mesh.nodes)))
    return written
