"""A calibration session as a person runs it: from frames to a certified calibration, and what comes after."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from support.command import answer, service, sms
from support.sessions import small_session

from sms_jobs import bootstrap
from sms_jobs.jobs.archiving.registration import register_calibration, register_campaign
from sms_jobs.records.campaign import Campaign, Specimen
from sms_jobs.records.sensors import Calibration
from sms_jobs.virtual_rig.sessions import BEGIN

pytestmark = (
    pytest.mark.long
)  # a minute of rendering and observing; every run's demo calibrates a rig through jobs

USAGE, NOT_FOUND, CONFLICT, FINDINGS = 2, 3, 4, 6


def run(home: Path, *arguments: str) -> Any:
    return answer(*arguments, "--home", str(home))


def doubtful_session() -> Campaign:
    """Return the small session with two poses of the bar, which lie in one plane."""
    made = small_session("session")
    return replace(made, states=made.states[:5])


def plain_test(session: Campaign) -> Campaign:
    """Return a test of the session's rig, whose specimen is its board."""
    states = (replace(session.states[0], artefact=None, time=None),)
    return replace(session, name="test", specimen=Specimen("board"), states=states, session=None)


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """Measure with an older calibration, calibrate, and measure again; return the home and what was said."""
    home = tmp_path_factory.mktemp("calibration")
    assert sms("init", "--home", str(home)).returncode == 0
    session = doubtful_session()
    assert session.scene is not None
    assert session.session is not None
    assert session.session.volume is not None
    old = Calibration(session.scene.rig, session.session.volume, BEGIN - timedelta(days=1), "exact")
    with bootstrap.services(home) as services:
        register_campaign(services.catalogue, services.archive, session, None, datetime.now(UTC))
        register_campaign(services.catalogue, services.archive, plain_test(session), None, datetime.now(UTC))
        register_calibration(services.catalogue, services.archive, old, datetime.now(UTC))
    said: dict[str, Any] = {"too early": sms("calibration", "certify", "session", "--home", str(home))}
    shapes = ("job", "submit", "reconstruct", "-c", "test")
    with service(home):
        recorded = run(home, "job", "submit", "simulate", "-c", "test")["jobs"]
        jobs = run(home, "job", "submit", "simulate", "pipeline", "-c", "session")["jobs"]
        run(home, "job", "wait", *recorded)
        early = run(home, *shapes)["jobs"]
        run(home, "job", "wait", *early, *jobs)
        said["fresh"] = run(home, "job", "explain", early[0])
        said["doubted"] = sms("calibration", "certify", "session", "--home", str(home))
        said["new"] = run(home, "calibration", "certify", "session", "--despite-warnings")
        said["again"] = run(home, "calibration", "certify", "session", "--despite-warnings")
        said["stale"] = run(home, "job", "explain", early[0])
        new = run(home, *shapes)["jobs"]
        run(home, "job", "wait", *new)
        said["computed"] = [run(home, "job", "show", job) for job in new]
        same = run(home, *shapes)["jobs"]
        run(home, "job", "wait", *same)
        said["reused"] = [run(home, "job", "show", job) for job in same]
    return home, said


def test_a_calibration_with_warnings_is_not_taken_into_use_by_itself(
    done: tuple[Path, dict[str, Any]],
) -> None:
    _, said = done
    assert said["too early"].returncode == NOT_FOUND
    assert "session session has given no calibration yet" in " ".join(said["too early"].stderr.split())
    assert said["doubted"].returncode == CONFLICT
    text = " ".join(said["doubted"].stderr.split())
    assert "all spheres of the bar lie within" in text
    assert "set --despite-warnings" in text
    assert said["new"]["new"]


def test_certifying_twice_gives_the_same_number(done: tuple[Path, dict[str, Any]]) -> None:
    home, said = done
    assert said["again"] == {**said["new"], "new": False}
    assert len(run(home, "calibration", "list")) == 2


def test_results_of_an_older_calibration_are_stale_and_computed_again(
    done: tuple[Path, dict[str, Any]],
) -> None:
    _, said = done
    assert not any("stale" in sentence for sentence in said["fresh"]["explanation"])
    told = "it is stale: another calibration of the rig is valid for this state now"
    assert told in said["stale"]["explanation"]
    assert [shown["job"]["reused_from"] is None for shown in said["computed"]] == [True, True]
    assert [shown["job"]["reused_from"] is None for shown in said["reused"]] == [False, False]


def test_what_a_calibration_is_worth_is_shown(done: tuple[Path, dict[str, Any]]) -> None:
    home, said = done
    shown = run(home, "calibration", "show", str(said["new"]["calibration"]))
    assert shown["quality"]["warnings"] > 0
    assert shown["quality"]["world"] == "board frame of pose B01"
    assert "held-out bar lengths, rms [um]" in shown["quality"]


def test_two_calibrations_are_compared(done: tuple[Path, dict[str, Any]]) -> None:
    home, said = done
    number = said["new"]["calibration"]
    found = run(home, "calibration", "compare", str(3 - number), str(number))
    # Nothing is known of how well the older one was found: whether it matters is told, not whether by chance.
    assert found["comparison"]["verdict"] in ("harmless", "matters")
    assert {p["camera"] + p["projector"] for p in found["comparison"]["views"]} == {"C1P1", "C1P2"}
    assert sms("calibration", "compare", "1", "9", "--home", str(home)).returncode == NOT_FOUND


def test_a_measurement_tells_whether_its_calibration_holds(done: tuple[Path, dict[str, Any]]) -> None:
    home, _ = done
    told = sms("calibration", "check", "test/B01/C1P1", "test/B01/C1P2", "--home", str(home))
    assert told.returncode == (FINDINGS if "drifted" in told.stdout else 0)
    assert told.stdout.count("test/B01/C1P") == 2
    assert sms("calibration", "check", "test/B01", "--home", str(home)).returncode == USAGE
    assert sms("calibration", "check", "session/S01/C1P1", "--home", str(home)).returncode == NOT_FOUND
