"""What a rig lacks to record a campaign, as far as its file tells."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from sms_jobs.errors import InvalidInput
from sms_jobs.kinds.recording.acquire import KIND
from sms_jobs.records.views import view_of

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign
    from sms_jobs.records.optical_instruments import ImageFormat, RigFile


def lacking(rig: RigFile, campaign: Campaign, views: Iterable[str]) -> list[str]:
    """Say which sensors, channels or scene a rig lacks to record some views, or has with another image."""
    sensors = [name for view in views for name in view_of(view).sensors]
    limits = KIND.checked_parameters(campaign.processing.get(KIND.name, {})).limits()
    found = rig.lacking(sensors, _planned(rig, campaign))
    try:
        limits.require_channels(rig.name, [c.name for c in rig.serial.channels])
    except InvalidInput as error:
        found.append(str(error))
    return [*found, *lacking_scene(rig, campaign)]


def lacking_scene(rig: RigFile, campaign: Campaign) -> list[str]:
    """Say that a simulated rig has nothing to look at; nothing where it has, or is none."""
    if campaign.scene is not None or not rig.simulated:
        return []
    why = (
        f"rig {rig.name} is simulated, and campaign {campaign.name} describes no scene that it could see: "
        "name a campaign whose plan has a [scene], or a rig with real sensors"
    )
    return [why]


def _planned(rig: RigFile, campaign: Campaign) -> Sequence[ImageFormat]:
    """Return the images that a plan expects; of simulated sensors they are those of its scene."""
    if campaign.session is not None:
        return campaign.session.sensors
    return campaign.scene.rig.sensors if campaign.scene is not None and rig.simulated else ()
