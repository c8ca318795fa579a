"""What a campaign may say of its recordings."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from sms_jobs.kinds.recording.acquire import AcquireParameters, order
from sms_jobs.records.campaign import Subject
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.sessions import small_session


def test_channels_are_read_and_limited() -> None:
    found = AcquireParameters(channels=("load_n=3000", "temperature", "strain-1=2.5e-6")).limits()
    assert found.channels == {"load_n": 3000.0, "temperature": None, "strain-1": 2.5e-6}


def test_spheres_need_not_fill_the_image() -> None:
    session = small_session("session")
    assert order(session, Subject("session", "B01")).fills == 1.0
    assert order(session, Subject("session", "S01")).fills == 1e-4
    assert order(small_plate("plate")[1], Subject("plate", "S00")).fills == 1.0


@pytest.mark.parametrize("channels", [("load_n", "load_n=3"), ("load_n=",), ("load n",), ("load_n=-3",)])
def test_what_is_no_channel_is_refused(channels: tuple[str, ...]) -> None:
    with pytest.raises(ValidationError, match="channel"):
        AcquireParameters(channels=channels)
