"""What people type to stream cameras, what they are told before, and what is refused."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from support.command import answer, inside
from support.homes import initialised

from sms_jobs import bootstrap
from sms_jobs.app.specimens import campaigns
from sms_jobs.bootstrap import Services
from sms_jobs.catalogue.tables.jobs import JobRow
from sms_jobs.errors import NotFound
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.events import typed_event
from sms_jobs.virtual_rig.campaigns import small_plate

SIDE = 1024
CAMERA = (
    f'driver = "aravis", columns = {SIDE}, rows = {SIDE}, exposure_ms = 5.0, pixel_format = "Mono8", '
    "noise_gain = 0.1, read_noise = 1.0"
)
RIG = f"""
name = "pair"
cameras = [
    {{ {CAMERA}, name = "C1", device = "one" }},
    {{ {CAMERA}, name = "C2", device = "two" }},
]
file_channels = [{{ name = "load_n", path = "load.csv", column = "load", unit = "kN" }}]
"""
FINDINGS, USAGE, NOT_FOUND = 6, 2, 3


@pytest.fixture
def services(home: Path, tmp_path: Path) -> Iterator[Services]:
    """A home with a rig of two cameras, and a campaign of fringes."""
    initialised(home)
    (tmp_path / "rig.toml").write_text(RIG)
    calibration, campaign = small_plate("fringes")
    with bootstrap.services(home) as found:
        found.stations.add(tmp_path / "rig.toml", replace=False)
        register_campaign(
            found.catalogue, found.archive, replace(campaign, rig="pair"),
            replace(calibration, rig=replace(calibration.rig, name="pair")), datetime.now(UTC),
        )  # fmt: skip
        yield found


NEW = ("coupon", "--cameras", "C1,C2", "--rig", "pair")
AROUND = ("--around", "load_n > 20kN", "--before", "5s", "--after", "3s")


def stream(services: Services, *words: str) -> Any:
    return answer("acquire", "stream", *words, "--home", str(services.settings.home))


def refused(services: Services, *words: str) -> tuple[int, str]:
    done = inside("acquire", "stream", *words, "--home", str(services.settings.home))
    return done.returncode, " ".join(done.stderr.split())


def test_a_dry_run_says_what_it_takes(services: Services) -> None:
    found = stream(services, *NEW, "--rate", "50Hz", "--for", "1h", *AROUND, "--every", "10", "--dry-run")
    both = 2 * 2 * SIDE**2  # two bytes a pixel, whatever the format
    assert (found["frames"], found["states"], found["missing"]) == (400, 40, [])
    # 5 s before the event, and 2 s for the disk.
    assert found["ring_bytes"] == 50 * (5 + 2) * both
    assert found["spool_bytes"] == (400 + 2) * both
    assert found["archived_bytes"] == (400 + 40) * both
    told = inside("acquire", "stream", *NEW, "--rate", "180Hz", "--for", "60h", "--dry-run",
                  "--home", str(services.settings.home))  # fmt: skip
    assert told.returncode == FINDINGS
    assert "the spool's disk has" in told.stderr
    with pytest.raises(Exception, match="coupon"):
        campaigns.definition(services, "coupon")  # nothing is made


def test_a_campaign_is_made_whose_reference_is_the_first_frame(services: Services) -> None:
    first = stream(services, *NEW, "--rate", "1Hz", "--for", "10s", "--no-wait")["jobs"]
    made = campaigns.definition(services, "coupon")
    assert (made.views, made.rig, [s.label for s in made.states]) == (("C1C2",), "pair", ["t0001"])
    # The second stream has labels of its own, though the first has not run.
    second = stream(services, "coupon", "--rate", "0.1Hz", "--for", "10s", *AROUND, "--no-wait")["jobs"]
    with services.catalogue.reading() as session:
        parameters = [session.get_one(JobRow, job_id).parameters for job_id in (*first, *second)]
    assert [one["number"] for one in parameters] == [1, 2]
    event = {name: parameters[1][name] for name in ("channel", "unit", "comes", "limit")}
    assert event == {"channel": "load_n", "unit": "kN", "comes": "above", "limit": 20.0}


def test_a_simulated_rig_needs_a_scene_before_a_campaign_is_made(services: Services, tmp_path: Path) -> None:
    simulated = 'name = "light"\ncameras = [{ name = "C1", driver = "simulated", columns = 64, rows = 64 }]\n'
    (tmp_path / "light.toml").write_text(simulated)
    services.stations.add(tmp_path / "light.toml", replace=False)
    new = ("coupon", "--cameras", "C1", "--rig", "light", "--rate", "10Hz", "--for", "1s")
    found = refused(services, *new)
    assert found[0] == USAGE
    assert "rig light is simulated, and campaign coupon describes no scene" in found[1]
    assert refused(services, *new, "--dry-run")[0] == FINDINGS
    with pytest.raises(NotFound, match="coupon"):
        campaigns.definition(services, "coupon")


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (
            "coupon --cameras C1,,C2 --rig pair --rate 1Hz --for 1s",
            USAGE,
            "'' cannot be the name of a sensor",
        ),
        ("coupon --cameras C1,C1 --rig pair --rate 1Hz --for 1s", USAGE, "--cameras names C1 twice"),
        (
            "coupon --cameras P1 --rig pair --rate 1Hz --for 1s",
            USAGE,
            "P1 is a projector, and streams are of",
        ),
        (
            "coupon --rate 1Hz --for 1s",
            NOT_FOUND,
            "no campaign 'coupon': create it with 'sms campaign create'",
        ),
        (
            "fringes --rate 1Hz --for 1s",
            USAGE,
            "streams are for cameras without a projector",
        ),
        ("NEW --rate 20 --for 1s", USAGE, "--rate is '20', which has no unit: write it in Hz, kHz"),
        ("NEW --rate 20Hz --for 30", USAGE, "--for is '30', which has no unit"),
        ("NEW --rate 250Hz --for 1s", USAGE, "C1 exposes for 5 ms and cannot take 250 frames a second: stay"),
        ("NEW --rate 1Hz --for 1s --before 1s", USAGE, "--before and --after go with --around"),
        ("coupon --cameras C1,C7 --rig pair --rate 1Hz --for 1s", USAGE, "the file of rig pair has no C7"),
        (
            "coupon --cameras C1,C2,C3 --rig pair --rate 1Hz --for 1s",
            USAGE,
            "give --views, such as 'C1C2 C2C3'",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(services: Services, words: str, code: int, told: str) -> None:
    found = refused(services, *words.replace("NEW", " ".join(NEW)).split())
    assert found[0] == code
    assert told in found[1]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("load_n", "which is no event: write one such as 'load_n > 20kN'"),
        ("load_n > 20", "which has no unit: write it in N, kN, MN"),
        ("load_n > 20mm", "'mm' is no unit of it"),
        ("load_n > 20kN in 1s", "only a drop is in a time"),
        ("load_n drops 0N", "every reading does: give more than 0"),
        ("strain > 1kN", "rig pair has no channel 'strain'; it has load_n"),
    ],
)
def test_an_event_that_cannot_come_is_refused(services: Services, text: str, told: str) -> None:
    found = refused(
        services, *NEW, "--rate", "1Hz", "--for", "1h", "--around", text, "--before", "1s", "--after", "1s"
    )
    assert told in found[1]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("load_n > 20kN", "load_n > 20 kN"),
        ("load_n<-3 kN", "load_n < -3 kN"),
        ("load_n drops 2000N", "load_n drops by 2 kN in 1 s"),
        ("load_n drops by 2 kN in 0.5 s", "load_n drops by 2 kN in 0.5 s"),
    ],
)
def test_an_event_is_in_the_unit_of_its_channel(text: str, said: str) -> None:
    assert str(typed_event(text, "--around").in_unit("kN")) == said
