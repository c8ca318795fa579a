"""Plans of recordings, streams and newest frames over HTTP: as the commands have them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from support.homes import make_home
from support.over_http import app_of, served

from sms_jobs import bootstrap
from sms_jobs.bootstrap import Services
from sms_jobs.instruments.spool import SpoolHeader, SpoolWriter
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.virtual_rig.campaigns import small_plate
from sms_jobs.virtual_rig.stereo_campaigns import stereo_campaign, stereo_rig

PAIR = """
name = "pair"
cameras = [
    { name = "C1", driver = "simulated", columns = 64, rows = 64 },
    { name = "C2", driver = "simulated", columns = 64, rows = 64 },
]

[[file_channels]]
name = "load_n"
path = "load.csv"
column = "load"
unit = "kN"
stale_after_s = 10.0
"""


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with a plate before a projector, and one before two cameras whose rig is connected."""
    home = tmp_path_factory.mktemp("plans") / "home"
    make_home(home, {})
    with bootstrap.services(home) as services:
        calibration, campaign = small_plate("gauged")
        campaign = replace(campaign, processing={"gauges": {"gauge": "g1 x=0 y=0 length=60"}})
        register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
        calibration, campaign = stereo_campaign("seen", rig=stereo_rig(64, 64))
        campaign = replace(campaign, rig="pair", states=(replace(campaign.states[0], label="t0001"),))
        calibration = replace(calibration, rig=replace(calibration.rig, name="pair"))
        register_campaign(services.catalogue, services.archive, campaign, calibration, datetime.now(UTC))
        alone = replace(campaign, name="alone", views=("C1",))
        register_campaign(services.catalogue, services.archive, alone, None, datetime.now(UTC))
        file = home / "pair.toml"
        file.write_text(PAIR)
        services.stations.add(file, replace=False)
    return home


@pytest.fixture(scope="module")
def services(home: Path) -> Iterator[Services]:
    with bootstrap.services(home, "web") as opened:
        yield opened


@pytest.fixture(scope="module")
def web(services: Services) -> Iterator[httpx2.Client]:
    with served(app_of(services)) as client:
        yield client


def asked(web: httpx2.Client, path: str, status: int = 200, **body: Any) -> Any:
    answer = web.post(path, json=body)
    assert answer.status_code == status, answer.text
    return answer.json()


def planned(web: httpx2.Client) -> dict[str, str]:
    found = web.get("recordings/planned", params={"campaign": "plate"}).json()
    return {one["state"]: one["status"] for one in found}


def test_a_plan_is_made_held_moved_skipped_and_forgotten(web: httpx2.Client) -> None:
    assert web.get("recordings/planned").json() == []
    made = asked(web, "recordings/planned", 201, campaign="plate", every_s=900.0, process=True)
    assert [(one["state"], one["is_next"]) for one in made] == [("S00", True), ("S01", False)]
    assert "15 min" in made[0]["trigger"]
    assert "no worker serves" in made[0]["waits_for"]
    assert asked(web, "recordings/planned/hold", campaign="plate")["held"] == ["S00", "S01"]
    assert planned(web) == {"S00": "held", "S01": "held"}
    assert asked(web, "recordings/planned/go", campaign="plate", states=["S01"])["going"] == ["S01"]
    asked(web, "recordings/planned/move", campaign="plate", state="S01", before="S00")
    assert list(planned(web).items()) == [("S01", "planned"), ("S00", "held")]
    assert asked(web, "recordings/planned/skip", campaign="plate")["skipped"] == ["S01"]
    dropped = asked(web, "recordings/planned/drop", campaign="plate")
    assert [dropped[what] for what in ("dropped", "recorded", "running")] == [["S01", "S00"], [], []]
    assert planned(web) == {}


def test_levels_are_planned_held_and_forgotten(web: httpx2.Client) -> None:
    stepped = {"channel": "load_n", "each": "10kN", "tolerance": "200N", "hold_s": 10.0}
    (one,) = asked(web, "recordings/planned", 201, campaign="seen", **stepped)
    assert (one["state"], one["is_added"], one["is_next"]) == ("t0002", True, True)
    assert one["trigger"] == "load_n = any multiple of 10 +- 0.2 kN for 10 s"
    assert asked(web, "recordings/planned/hold", campaign="seen")["held"] == ["t0002"]
    assert [kept["status"] for kept in web.get("recordings/planned").json()] == ["held"]
    page = web.get(str(web.base_url).removesuffix("api/v1/") + "recordings", params={"campaign": "seen"}).text
    assert "to be added" in page
    assert 'id="change-seen-t0002"' not in page  # it is no state that could be held back alone
    assert asked(web, "recordings/planned/go", campaign="seen")["going"] == ["t0002"]
    assert asked(web, "recordings/planned/drop", campaign="seen")["dropped"] == ["t0002"]
    assert web.get("recordings/planned").json() == []


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"each": "10kN"}, "each goes with channel and tolerance"),
        ({"each": "10kN", "tolerance": "1N", "channel": "cycles", "at_cycles": [5]}, "each goes with"),
        ({"each": "10kN", "channel": "load_n"}, "channel and tolerance go together"),
        ({"each": "ten", "channel": "load_n", "tolerance": "1N"}, "each is 'ten', which is no quantity"),
        ({"every_s": 60.0, "at_cycles": [1, 2]}, "one thing to wait for"),
        ({"channel": "load_n"}, "channel and tolerance go together"),
        ({"tolerance": "500N"}, "channel and tolerance go together"),
        ({"channel": "load_n", "tolerance": "500"}, "no rig"),
        ({"at_cycles": [5, 5]}, "exceed the one before"),
        ({"every_s": 0.0}, "every_s"),
    ],
)
def test_a_plan_that_says_too_much_or_too_little_is_refused(
    web: httpx2.Client, body: dict[str, Any], words: str
) -> None:
    refused = web.post("recordings/planned", json={"campaign": "plate"} | body)
    assert refused.status_code in (404, 422), refused.text
    assert words in refused.json()["error"]
    assert planned(web) == {}


def test_a_plan_asks_for_looks_and_limits(web: httpx2.Client) -> None:
    limit = "g1.extension_mm > 500um"
    made = asked(web, "recordings/planned", 201, campaign="gauged", states=["S01"], stop_if=[limit])
    assert [one["stop_if"] for one in made] == [["g1.extension_mm > 0.5 mm"]]
    asked(web, "recordings/planned", 201, campaign="plate", look=True)
    asked(web, "recordings/planned/drop", campaign="plate")


@pytest.mark.parametrize(
    ("body", "status", "words"),
    [
        ({"campaign": "gauged", "stop_if": ["g1.extension_mm > 5"]}, 422, "has no unit"),
        ({"campaign": "gauged", "stop_if": ["g1 > 5mm"]}, 422, "stop_if is 'g1 > 5mm', which is no limit"),
        ({"campaign": "gauged", "stop_if": ["g2.x_mm < 0mm"]}, 404, "gauged has no gauge 'g2'"),
        ({"campaign": "alone", "look": True}, 422, "nobody said how large a pixel is"),
    ],
)
def test_a_look_that_cannot_be_is_refused(
    web: httpx2.Client, body: dict[str, Any], status: int, words: str
) -> None:
    before = web.get("recordings/planned", params={"campaign": body["campaign"]}).json()
    refused = web.post("recordings/planned", json=body)
    assert (refused.status_code, words in refused.json()["error"]) == (status, True), refused.text
    assert web.get("recordings/planned", params={"campaign": body["campaign"]}).json() == before


def test_quick_looks_are_told(web: httpx2.Client) -> None:
    assert web.get("recordings/looks", params={"campaign": "plate"}).json() == []  # nobody has asked for one
    assert web.get("recordings/looks", params={"campaign": "nothing"}).status_code == 404
    assert web.get("recordings/looks").status_code == 422


def test_what_a_stream_takes_is_told_and_a_stream_is_begun_and_listed(web: httpx2.Client) -> None:
    stream = {"campaign": "seen", "rate_hz": 10.0, "for_s": 3.0}
    told = asked(web, "streams/rehearsal", **stream)
    assert (told["cameras"], told["frames"], told["states"], told["missing"]) == (["C1", "C2"], 30, 30, [])
    event = {"around": "load_n > 2kN", "before_s": 1.0, "after_s": 1.0}
    assert asked(web, "streams/rehearsal", **stream, **event)["frames"] == 20
    begun = asked(web, "streams", 201, **stream)
    assert begun["recordings"] == 1
    listed = web.get("jobs", params={"kind": "stream"}).json()
    assert [one["id"] for one in listed] == begun["jobs"]
    assert [one["job_id"] for one in web.get("recordings").json()] == begun["jobs"]
    assert asked(web, "recordings/abort", job=begun["jobs"][0])["stopped"] == begun["jobs"]


@pytest.mark.parametrize(
    ("body", "status", "words"),
    [
        ({"campaign": "plate"}, 422, "without a projector"),
        ({"campaign": "none"}, 404, "no campaign 'none'"),
        ({"before_s": 1.0}, 422, "give them with around"),
        ({"around": "load_n > 2"}, 422, "around"),
        ({"around": "load_n jumps", "before_s": 1.0}, 422, "which is no event"),
        ({"cameras": ["C1"]}, 422, "has the cameras C1, C2"),
        ({"rate_hz": 0.0}, 422, "rate_hz"),
    ],
)
def test_a_stream_that_cannot_be_is_refused(
    web: httpx2.Client, body: dict[str, Any], status: int, words: str
) -> None:
    for path in ("streams", "streams/rehearsal"):
        refused = web.post(path, json={"campaign": "seen", "rate_hz": 10.0, "for_s": 3.0} | body)
        assert (refused.status_code, words in refused.json()["error"]) == (status, True), refused.text


def test_the_newest_frame_is_told_and_drawn(web: httpx2.Client, services: Services) -> None:
    (job, *_) = asked(web, "recordings", 201, campaign="plate", states=["S00"])["jobs"]
    nothing = web.get(f"recordings/{job}/frame")
    assert (nothing.status_code, "no frame of recording" in nothing.json()["error"]) == (404, True)
    about = {"full_scale": 200, "channels": {"load_n": 12.5}}
    header = SpoolHeader(datetime(2026, 5, 4, 10, 0, tzinfo=UTC), 48, 64, "uint8", 41, about)
    spool = services.stations.spool_of(job)
    spool.mkdir(parents=True)
    with SpoolWriter(spool / "C1P1.001.frames", header) as file:
        image = np.zeros((48, 64), np.uint8)
        image[:12] = 200
        file.append(0, 0.25, image)
    told = web.get(f"recordings/{job[:8]}/frame").json()
    assert (told["view"], told["number"], told["frames"], told["sealed"]) == ("C1P1", 1, 41, False)
    assert told["saturated_fraction"] == 0.25  # 12 of 48 rows
    assert told["channels"] == {"load_n": 12.5}
    assert told["taken_at"].startswith("2026-05-04T10:00:00.25")
    drawn = web.get(f"recordings/{job}/frame.png")
    assert (drawn.headers["Content-Type"], drawn.content[:4]) == ("image/png", b"\x89PNG")
    (other, *_) = asked(web, "jobs", campaign="plate", kinds=["simulate"])["jobs"]
    refused = web.get(f"recordings/{other}/frame")
    assert (refused.status_code, "is no recording but a simulate" in refused.json()["error"]) == (422, True)
