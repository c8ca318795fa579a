"""Campaign definitions that people write: TOML or XML text in, records out.

Nothing is taken from a file that cannot be used as a whole: unknown keys, impossible values and
contradictions are refused, in one sentence that names the file and the key.
"""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from sms_jobs.formats.campaign_tables import CampaignPlan, CampaignTable
from sms_jobs.formats.interchange.text_files import read_text
from sms_jobs.formats.interchange.xml_values import Places
from sms_jobs.formats.measurement_configuration import parse_measurement_configuration
from sms_jobs.formats.written_files import read_toml, validated


def load_campaign(path: Path) -> CampaignPlan:
    """Read a campaign file: XML where its name ends in .xml, TOML otherwise.

    Raises
    ------
    NotFound
        There is no such file.
    ConfigurationError
        It is too large, no TOML or XML, or does not describe a campaign; the message names file and key.
    """
    text = read_text(path, "campaign file")
    if path.suffix.lower() == ".xml":
        return _plan(*parse_measurement_configuration(text, str(path)), text)
    return parse_campaign(text, str(path))


def parse_campaign(text: str, source: str) -> CampaignPlan:
    """Read the text of a campaign file; `source` names it in messages.

    Raises
    ------
    ConfigurationError
        The text is no TOML or does not describe a campaign.
    """
    return _plan(*read_toml(text, source), text)


def _plan(content: dict[str, Any], places: Places, text: str) -> CampaignPlan:
    """Return what the nested table of a file defines; `places` says where in its text the values stand."""
    hint = "`sms campaign create --example` prints a valid file"
    return replace(validated(CampaignTable, content, places, hint, CampaignTable.plan), text=text)


def example_campaign() -> str:
    """Return the text of a commented, valid file: a tension test of a plate on a virtual rig."""
    return files("sms_jobs.formats").joinpath("example_campaign.toml").read_text("utf-8")


def example_session() -> str:
    """Return the text of a commented, valid file: a calibration session of a virtual rig."""
    return files("sms_jobs.formats").joinpath("example_session.toml").read_text("utf-8")


def example_stereo() -> str:
    """Return the text of a commented, valid file: a test of a curved panel before two cameras."""
    return files("sms_jobs.formats").joinpath("example_stereo.toml").read_text("utf-8")


__all__ = [
    "CampaignPlan",
    "example_campaign",
    "example_session",
    "example_stereo",
    "load_campaign",
    "parse_campaign",
]
