"""What a campaign may say of its recordings."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pydantic import ValidationError
from support.sessions import small_session

from sms_jobs.kinds.recording.acquire import AcquireParameters, order
from sms_jobs.records.subject import Subject
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign


def test_a_state_is_all_that_its_campaign_records() -> None:
    campaign = replace(small_plate("plate")[1], views=("C1P1", "C1C2", "C3"))
    assert order(campaign, Subject("plate", "S00")).views == ("C1P1", "C1", "C2", "C3")
    pair = stereo_campaign("pair")[1]
    assert order(pair, Subject("pair", "S01")).views == ("C1", "C2")
    assert order(pair, Subject("pair", "S01")).speckled
    assert not order(small_session("session"), Subject("session", "B01")).speckled


def test_how_far_apart_images_may_be_is_said_in_milliseconds() -> None:
    assert AcquireParameters().limits().apart_s == pytest.approx(0.01)
    assert AcquireParameters(apart_ms=250.0).limits().apart_s == pytest.approx(0.25)
    with pytest.raises(ValidationError, match="apart_ms"):
        AcquireParameters(apart_ms=-1.0)


def test_channels_are_read_and_limited() -> None:
    found = AcquireParameters(channels=("load_n=3000", "temperature", "strain-1=2.5e-6")).limits()
    assert found.channels == {"load_n": 3000.0, "temperature": None, "strain-1": 2.5e-6}


def test_a_channel_alone_is_a_text() -> None:
    chosen = [AcquireParameters(channels=one).channels for one in ("load_n=3000", "load_n t_c", "")]  # type: ignore[arg-type]
    assert chosen == [("load_n=3000",), ("load_n", "t_c"), ()]


def test_spheres_need_not_fill_the_image() -> None:
    session = small_session("session")
    assert order(session, Subject("session", "B01")).fills == 1.0
    assert order(session, Subject("session", "S01")).fills == 1e-4
    assert order(small_plate("plate")[1], Subject("plate", "S00")).fills == 1.0


@pytest.mark.parametrize("channels", [("load_n", "load_n=3"), ("load_n=",), ("load n",), ("load_n=-3",)])
def test_what_is_no_channel_is_refused(channels: tuple[str, ...]) -> None:
    with pytest.raises(ValidationError, match="channel"):
        AcquireParameters(channels=channels)
