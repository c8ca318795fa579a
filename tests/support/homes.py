"""Homes with a campaign in them."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import pytest

from sms_jobs import bootstrap
from sms_jobs.jobs.registration import register_campaign
from sms_jobs.virtual_rig.campaigns import small_plate


def make_home(home: Path, environment: Mapping[str, str], campaign: str = "plate") -> None:
    """Make a home with the small virtual plate in it."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in environment.items():
            patch.setenv(name, value)
        bootstrap.initialise(home)
        with bootstrap.services(home) as services:
            calibration, record = small_plate(campaign)
            register_campaign(services.catalogue, services.archive, record, calibration, datetime.now(UTC))
